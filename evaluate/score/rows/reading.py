"""Rows of rollouts, checked: each by itself, and against those of the same episode or rollout."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robomme_interference_data.constants import RECORDINGS
from robomme_interference_data.errors import (
    FormatError,
    InterferenceError,
    InvalidOptionError,
    counted,
)
from robomme_interference_data.evaluate.systems import FACT_COLUMNS, SYSTEMS
from robomme_interference_data.schema.rollouts import FINAL, Status, success_of
from robomme_interference_data.schema.shifts import NO_SHIFT

from .files import find_sources, read_file
from .row_format import FileColumns
from .stated import ScenesOf, notes_on, of_other_scenes, scenes_of, with_stated
from .values import DEFAULTS, Row, parse, shifted

if TYPE_CHECKING:
    from robomme_interference_data.evaluate.run.log import RunHeader

_SHOWN = 10  # bad rows that are listed; the others are counted

_SUCCESS = {str(status): success_of(status) for status in FINAL}
_EPISODE = ("simulator", "family", "split", "episode")
_ROLLOUT = ("system", "condition", "training_seed", "model_seed", *_EPISODE)


@dataclass(frozen=True)
class CheckedRows:
    """Rows that passed every check, in the order of their files.

    Attributes:
        rows: The rows.
        sources: The files that were read (see `files.find_sources`).
        revisions: Simulator to the revision of its buffer set, where rows name one.
        without_revision: Simulator and system of rows that name no revision, such as released ones,
            and of evaluations by other programs whose scenes are not known to be the same.
        scenes: What decides the scenes of evaluations by other programs.
        notes: What readers must know of them.
        bad_reasons: The first bad rows that were left out: location and reason.
        bad_count: The number of bad rows.
    """

    rows: tuple[Row, ...]
    sources: "Mapping[Path, RunHeader | None]"
    revisions: Mapping[str, str] = field(default_factory=dict)
    without_revision: frozenset[tuple[str, str]] = frozenset()
    scenes: ScenesOf = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    bad_reasons: tuple[str, ...] = ()
    bad_count: int = 0

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Row]:
        return iter(self.rows)

    def names(self, column: str) -> list[Any]:
        """Return the distinct values of a column, sorted."""
        return sorted({getattr(row, column) for row in self.rows})


def read_rows(
    paths: Sequence[Path],
    systems: Sequence[str] = (),
    lenient: bool = False,
    model_seeds: Sequence[int] = (),
) -> CheckedRows:
    """Read rows from folders of runs and files, and check each of them.

    Args:
        paths: Folders of runs, and files of one of `files.FORMATS`.
        systems: System of files that name none, for all or for each in their order; by default the
            one in the name of a released or exported file.
        model_seeds: Seeds of files that name none, likewise.
        lenient: Leave bad rows out, and count them. Of identical rows of one rollout the first is
            kept, of rows that contradict each other none.
    """
    sources = find_sources(paths)
    parts = {path: read_file(path, Row._fields) for path in sources}
    parts = with_stated(parts, systems, model_seeds)
    checks = _Checks()
    for path, run in sources.items():
        checks.add(path, parts[path], None if run is None else path.parent)
    checks.check_alike("revision", ("simulator",), "rows of different buffer sets do not mix")
    for column in ("difficulty", "seed", "chance"):
        checks.check_alike(column, _EPISODE, "an episode has one")
    checks.check_facts()
    checks.check_repeats()
    bad_reasons = [
        f"{checks.locate(at)}: {reason}" for at, reason in sorted(checks.reasons.items())
    ]
    if bad_reasons and not lenient:
        lines = [f"{counted(len(bad_reasons), 'bad row')}:", *bad_reasons[:_SHOWN]]
        if len(bad_reasons) > _SHOWN:
            lines.append(f"… and {len(bad_reasons) - _SHOWN:,} more")
        raise FormatError("\n".join(lines), "Correct them, or leave them out with lenient=True.")
    rows = tuple(checks.sound.values())
    cells = {(row.simulator, row.system, row.revision) for row in rows}
    without_revision = frozenset(
        (simulator, name) for simulator, name, revision in cells if not revision
    )
    scenes = scenes_of(parts)
    same_scenes = scenes.keys() - of_other_scenes(scenes)
    revisions = {simulator: revision for simulator, _, revision in cells if revision}
    for simulator, name, revision in sorted(cells - {(*cell, None) for cell in without_revision}):
        if (simulator, name) in without_revision:  # protocol, rule 5
            raise InvalidOptionError(
                f"some rows of {name} in {simulator} have the revision {revision} of a buffer "
                "set, others name no revision, like released rows",
                "Their histories may differ: score the files separately, or compare them.",
            )
    shown = tuple(bad_reasons[:_SHOWN])
    return CheckedRows(
        rows,
        sources,
        revisions,
        without_revision - same_scenes,
        scenes,
        tuple(notes_on(parts, scenes)),
        shown,
        len(bad_reasons),
    )


_Location = tuple[int, int]
"""Number of the file, and line in it."""


class _Checks:
    """The rows that passed every check so far (`sound`), and why others did not (`reasons`)."""

    def __init__(self) -> None:
        self.sound: dict[_Location, Row] = {}
        self.reasons: dict[_Location, str] = {}
        self._paths: list[Path] = []

    def add(self, path: Path, part: FileColumns, run: Path | None) -> None:
        """Add the rows of a file, checking each by itself; videos are relative to `run`."""
        number = len(self._paths)
        self._paths.append(path)
        default = {**dict.fromkeys(Row._fields), **DEFAULTS}
        wrong: dict[int, str] = {}
        columns = [
            _parsed(name, part.columns[name], run, wrong)
            if name in part.columns
            else [default[name]] * len(part.lines)
            for name in Row._fields
        ]
        rows = map(Row._make, zip(*columns, strict=True))
        if "policy" not in part.columns:
            rows = map(_with_known_facts, rows)
        for at, (line, row) in enumerate(zip(part.lines, rows, strict=True)):
            if at not in wrong and (contradiction := _contradiction(row)):
                wrong[at] = contradiction
            if at in wrong:
                self.reasons[number, line] = wrong[at]
            elif row.shift == NO_SHIFT:
                self.sound[number, line] = row
            else:
                simulator = shifted(row.simulator, row.shift)
                self.sound[number, line] = row._replace(simulator=simulator)
        self.reasons |= {(number, line): reason for line, reason in part.malformed.items()}

    def locate(self, row: _Location) -> str:
        """Return where a row is, for messages."""
        path = self._paths[row[0]]
        return f"{path}, {'line' if path.suffix.lower() in ('.csv', '.jsonl') else 'row'} {row[1]}"

    def check_alike(
        self, name: str, group: Sequence[str], why: str, *, none_counts: bool = False
    ) -> None:
        """Leave out rows whose value differs from the most frequent one of the same group.

        None is an unknown value, which fits all others, unless it counts.
        """
        rows = self.sound.values()
        keys, values = [*map(attrgetter(*group), rows)], [*map(attrgetter(name), rows)]
        counts = defaultdict[Any, Counter[Any]](Counter)
        for key, value in zip(keys, values, strict=True):
            if none_counts or value is not None:
                counts[key][value] += 1
        usual = {key: count.most_common(1)[0][0] for key, count in counts.items()}
        self._leave_out(
            (at, f"{name} {value!r} beside {usual[key]!r}: {why}")
            for at, key, value in zip(self.sound, keys, values, strict=True)
            if (none_counts or value is not None) and value != usual[key]
        )

    def check_facts(self) -> None:
        """Leave out rows whose facts differ from the most frequent ones of their system.

        Rows of several seeds may be of different weights.
        """
        for column in FACT_COLUMNS:
            group = ["system", "simulator"]
            if column == "policy_id":
                group += ["training_seed", "model_seed"]
            self.check_alike(column, group, "a system has one", none_counts=True)

    def check_repeats(self) -> None:
        """Keep one row of each rollout, and none where its rows contradict each other."""
        groups = defaultdict[Any, list[_Location]](list)
        for at, key in zip(
            self.sound, map(attrgetter(*_ROLLOUT), self.sound.values()), strict=True
        ):
            groups[key].append(at)
        for locations in [group for group in groups.values() if len(group) > 1]:
            first, *repeats = locations
            contradicted = len({self.sound[at].status for at in locations}) > 1
            reason = "the same rollout as {}"
            if contradicted:
                reason += "; its rows contradict each other"
                self._leave_out([(first, reason.format(self.locate(repeats[0])))])
            self._leave_out((at, reason.format(self.locate(first))) for at in repeats)

    def _leave_out(self, rows: Iterable[tuple[_Location, str]]) -> None:
        for at, reason in list(rows):
            del self.sound[at]
            self.reasons[at] = reason


def _with_known_facts(row: Row) -> Row:
    """Return a row that has nothing but the name of its system, with the facts of that name."""
    if row.system not in SYSTEMS:
        return row
    facts = SYSTEMS[row.system].facts
    known = {name: getattr(facts, name) for name in FACT_COLUMNS}
    if row.retrieval is not None:  # a released column
        known["retrieval"] = row.retrieval
    return row._replace(**known)


def _contradiction(row: Row) -> str:
    """Return which columns of a row contradict each other; empty if none do."""
    if row.success is not _SUCCESS[row.status]:
        shown = "(empty)" if row.success is None else row.success
        return f"success {shown} contradicts status {row.status!r}"
    offline = row.simulator == RECORDINGS
    if row.status != Status.ERROR and (row.status == Status.MEASURED) is not offline:
        return f"status {row.status!r} contradicts simulator {row.simulator!r}"
    if row.status == Status.MEASURED and row.action_l1 is None:
        return f"action_l1 (empty) contradicts status {row.status!r}"
    return ""


def _parsed(name: str, values: Sequence[Any], run: Path | None, wrong: dict[int, str]) -> list[Any]:
    """Return a column's parsed values; add the first reason against each bad row to `wrong`."""
    parsed, reasons = dict[Any, Any](), dict[Any, str]()
    for value in set(values):  # of one type, and most occur in many rows
        try:
            known = parse(name, value)
            parsed[value] = run and run / known if name == "video" and known else known
        except InterferenceError as error:
            reasons[value] = f"{error.message}. {error.hint or ''}".strip()
        except ValueError as error:
            shown = "(empty)" if value in (None, "") else repr(value)
            reasons[value] = f"{name} {shown}; expected {error}"
    for at, value in enumerate(values if reasons else ()):
        if value in reasons:
            wrong.setdefault(at, reasons[value])
    return [*map(parsed.get, values)]
