"""Checks of rows: each by itself, and against those of the same episode, system or rollout."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

from robomme_interference_data.constants import RECORDINGS
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.evaluate.systems import FACT_COLUMNS, SYSTEMS
from robomme_interference_data.schema.rollouts import FINAL, Status, success_of
from robomme_interference_data.schema.shifts import NO_SHIFT

from .row_format import FileColumns
from .values import DEFAULTS, Row, parse, shifted

_EPISODE = ("simulator", "family", "split", "episode")
_ROLLOUT = ("system", "condition", "training_seed", "model_seed", *_EPISODE)
_SUCCESS = {str(status): success_of(status) for status in FINAL}

_Location = tuple[int, int]
"""Number of the file, and line in it."""


class Checks:
    """The rows that passed every check so far (`sound`), and why others did not."""

    def __init__(self) -> None:
        self.sound: dict[_Location, Row] = {}
        self._reasons: dict[_Location, str] = {}
        self._paths: list[Path] = []

    def add(self, path: Path, contents: FileColumns, run: Path | None) -> None:
        """Add the rows of a file, checking each by itself; videos are relative to `run`."""
        number = len(self._paths)
        self._paths.append(path)
        default = {**dict.fromkeys(Row._fields), **DEFAULTS}
        wrong: dict[int, str] = {}
        columns = [
            _parsed(name, contents.columns[name], run, wrong)
            if name in contents.columns
            else [default[name]] * len(contents.lines)
            for name in Row._fields
        ]
        rows = map(Row._make, zip(*columns, strict=True))
        if "policy" not in contents.columns:
            rows = map(_with_known_facts, rows)
        for at, (line, row) in enumerate(zip(contents.lines, rows, strict=True)):
            if at not in wrong and (contradiction := _contradiction(row)):
                wrong[at] = contradiction
            if at in wrong:
                self._reasons[number, line] = wrong[at]
            elif row.shift == NO_SHIFT:
                self.sound[number, line] = row
            else:
                simulator = shifted(row.simulator, row.shift)
                self.sound[number, line] = row._replace(simulator=simulator)
        self._reasons |= {(number, line): reason for line, reason in contents.malformed.items()}

    def _locate(self, row: _Location) -> str:
        """Return where a row is, for messages."""
        path = self._paths[row[0]]
        return f"{path}, {'line' if path.suffix.lower() in ('.csv', '.jsonl') else 'row'} {row[1]}"

    def bad_reasons(self) -> list[str]:
        """Return location and reason of each bad row, in the order of files and lines."""
        return [f"{self._locate(at)}: {reason}" for at, reason in sorted(self._reasons.items())]

    def check_together(self) -> None:
        """Leave out rows that do not fit the others, after all files are added."""
        self._check_alike("revision", ("simulator",), "rows of different buffer sets do not mix")
        for column in ("difficulty", "ability", "seed", "chance"):
            self._check_alike(column, _EPISODE, "an episode has one")
        self._check_facts()
        # Last, because a row that was left out repeats none.
        self._check_repeats()

    def _check_alike(
        self, name: str, group: Sequence[str], why: str, *, none_counts: bool = False
    ) -> None:
        """Leave out rows whose value differs from the most frequent one of the same group.

        None is an unknown value, which fits all others, unless it counts.
        """
        rows = self.sound.values()
        values = [*map(attrgetter(name), rows)]
        if len({*values}) < 2:  # as most columns of a file
            return
        keys = [*map(attrgetter(*group), rows)]
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

    def _check_facts(self) -> None:
        """Leave out rows whose facts differ from the most frequent ones of their system.

        Rows of several seeds may be of different weights.
        """
        for column in FACT_COLUMNS:
            group = ["system", "simulator"]
            if column == "policy_id":
                group += ["training_seed", "model_seed"]
            self._check_alike(column, group, "a system has one", none_counts=True)

    def _check_repeats(self) -> None:
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
                self._leave_out([(first, reason.format(self._locate(repeats[0])))])
            self._leave_out((at, reason.format(self._locate(first))) for at in repeats)

    def _leave_out(self, rows: Iterable[tuple[_Location, str]]) -> None:
        for at, reason in list(rows):
            del self.sound[at]
            self._reasons[at] = reason


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
