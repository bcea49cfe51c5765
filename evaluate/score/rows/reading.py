"""Rows of rollouts, checked: each by itself, and against those of the same episode or rollout."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import FormatError, InterferenceError, InvalidOptionError
from robomme_interference_data.evaluate.run.log import RunHeader
from robomme_interference_data.evaluate.systems import name_system
from robomme_interference_data.schema.rollouts import FINAL, Status
from robomme_interference_data.schema.shifts import NO_SHIFT

from .files import Part, find_sources, read_file, system_of
from .values import DEFAULTS, Row, parse, shifted

_SHOWN = 10  # so many bad rows are named; the others are counted

_SUCCESS = {str(one): one == Status.SUCCESS for one in FINAL} | {str(Status.ERROR): None}
_EPISODE = ("simulator", "family", "split", "episode")
_ROLLOUT = ("system", "condition", "model_seed", *_EPISODE)


@dataclass(frozen=True)
class Rows:
    """Rows that passed every check, in the order of their files.

    Attributes:
        rows: The rows.
        sources: The files that were read (see `files.find_sources`).
        revisions: Simulator to the revision of its buffer set, where rows name one.
        unpinned: Simulator and system of rows that name no revision, as released ones.
        retrieval: Simulator and system to the retrieval steps in front of it, if there are any.
        refusals: The first bad rows that were left out: place and reason.
        refused: How many were.
    """

    rows: tuple[Row, ...]
    sources: Mapping[Path, RunHeader | None]
    revisions: Mapping[str, str] = field(default_factory=dict)
    unpinned: frozenset[tuple[str, str]] = frozenset()
    retrieval: Mapping[tuple[str, str], str] = field(default_factory=dict)
    refusals: tuple[str, ...] = ()
    refused: int = 0

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Row]:
        return iter(self.rows)

    def names(self, column: str) -> list[Any]:
        """Return the values of a column, each once and sorted."""
        return sorted({getattr(row, column) for row in self.rows})

    def by(self, column: str) -> dict[Any, list[Row]]:
        """Return the rows of each value of a column, by value, sorted."""
        found = defaultdict[Any, list[Row]](list)
        for row in self.rows:
            found[getattr(row, column)].append(row)
        return dict(sorted(found.items()))


def read_rows(paths: Sequence[Path], system: str | None = None, lenient: bool = False) -> Rows:
    """Read rows from folders of runs and files, and check each of them.

    Args:
        paths: Folders of runs, and `.jsonl`, `.parquet` and `.csv` files.
        system: Name of the system of rows that name none; else that in the name of an exported
            file.
        lenient: Leave bad rows out, and count them. Of equal rows of one rollout the first stays,
            of rows that contradict each other none.
    """
    sources = find_sources(paths)
    checks = _Checks()
    for path, run in sources.items():
        name = system_of(path) if system is None else system
        if name is not None:
            name_system(name)
        part = read_file(path, Row._fields, name is not None)
        checks.add(path, part, name, None if run is None else path.parent)
    checks.check_together()
    refusals = checks.refusals()
    if refusals and not lenient:
        lines = [f"{len(refusals):,} bad row{'s' * (len(refusals) > 1)}:", *refusals[:_SHOWN]]
        if more := len(refusals) - _SHOWN:
            lines += [f"… and {more:,} more"] * (more > 0)
        raise FormatError("\n".join(lines), "Mend them, or leave them out with lenient=True.")
    rows = tuple(checks.sound.values())
    cells = {(row.simulator, row.system, row.revision) for row in rows}
    unpinned = frozenset((simulator, one) for simulator, one, revision in cells if revision is None)
    pinned = {(simulator, one) for simulator, one, revision in cells if revision is not None}
    revisions = {simulator: revision for simulator, _, revision in cells if revision is not None}
    for simulator, one in sorted(pinned & unpinned):  # protocol, rule 5
        raise InvalidOptionError(
            f"some rows of {one} in {simulator} are of the buffer set with revision "
            f"{revisions[simulator]}, others name no revision, as released rows do",
            "Their histories may differ: score the files apart, or compare them.",
        )
    steps = {(row.simulator, row.system, row.retrieval_model) for row in rows}
    retrieval = {
        cell: ", ".join(str(step) for *_, step in group)
        for cell, group in groupby(sorted(s for s in steps if s[-1]), lambda one: one[:2])
    }
    shown = tuple(refusals[:_SHOWN])
    return Rows(rows, sources, revisions, unpinned, retrieval, shown, len(refusals))


class _Checks:
    """All rows, and the reason against each bad one, by number of the file and line in it.

    Attributes:
        sound: The rows that passed every check so far.
    """

    def __init__(self) -> None:
        self.sound: dict[tuple[int, int], Row] = {}
        self._paths: list[Path] = []
        self._reasons: dict[tuple[int, int], str] = {}

    def add(self, path: Path, part: Part, system: str | None, run: Path | None) -> None:
        """Add the rows of a file, each checked by itself; videos are relative to `run`."""
        number, count = len(self._paths), len(part.lines)
        self._paths.append(path)
        default = {**dict.fromkeys(Row._fields), **DEFAULTS, "system": system}
        columns, wrong = list[Sequence[Any]](), dict[int, str]()
        for name in Row._fields:
            if name in part.columns:
                columns.append(_parsed(name, part.columns[name], run, wrong))
            else:
                columns.append([default[name]] * count)
        rows = map(Row._make, zip(*columns, strict=True))
        for place, (line, row) in enumerate(zip(part.lines, rows, strict=True)):
            if place not in wrong and row.success is not _SUCCESS[row.status]:
                shown = "(empty)" if row.success is None else row.success
                wrong[place] = f"success {shown} contradicts status {row.status!r}"
            if place in wrong:
                self._reasons[number, line] = wrong[place]
            elif row.shift == NO_SHIFT:
                self.sound[number, line] = row
            else:
                simulator = shifted(row.simulator, row.shift)
                self.sound[number, line] = row._replace(simulator=simulator)
        self._reasons |= {(number, line): reason for line, reason in part.malformed.items()}

    def check_together(self) -> None:
        """Check rows against others."""
        self._check_alike("revision", ("simulator",), "rows of different buffer sets do not mix")
        for name in ("difficulty", "seed", "chance"):
            self._check_alike(name, _EPISODE, "an episode has one")
        self._check_repeats()

    def refusals(self) -> list[str]:
        """Return place and reason of each bad row, in the order of the files."""
        return [f"{self._place(row)}: {reason}" for row, reason in sorted(self._reasons.items())]

    def _place(self, row: tuple[int, int]) -> str:
        path = self._paths[row[0]]
        return f"{path}, {'row' if path.suffix.lower() == '.parquet' else 'line'} {row[1]}"

    def _refuse(self, row: tuple[int, int], reason: str) -> None:
        del self.sound[row]
        self._reasons[row] = reason

    def _check_alike(self, name: str, of: Sequence[str], why: str) -> None:
        """Compare a value with that of the first row with the same values in other columns."""
        rows = self.sound.values()
        keys, values = map(attrgetter(*of), rows), map(attrgetter(name), rows)
        first: dict[Any, Any] = {}
        wrong = [
            (place, f"{name} {value!r} beside {first[key]!r}: {why}")
            for place, key, value in zip(self.sound, keys, values, strict=True)
            if value is not None and value != first.setdefault(key, value)
        ]
        for place, reason in wrong:
            self._refuse(place, reason)

    def _check_repeats(self) -> None:
        """Leave one row of each rollout, and none where its rows contradict each other."""
        key: Callable[[Row], Any] = attrgetter(*_ROLLOUT)
        groups = defaultdict[Any, list[tuple[int, int]]](list)
        for place, row in self.sound.items():
            groups[key(row)].append(place)
        for numbers in groups.values():
            if len(numbers) == 1:
                continue
            first, *others = numbers
            contradicted = len({self.sound[number].status for number in numbers}) > 1
            more = "; its rows contradict each other" * contradicted
            if contradicted:
                self._refuse(first, f"the same rollout as {self._place(others[0])}{more}")
            for number in others:
                self._refuse(number, f"the same rollout as {self._place(first)}{more}")


def _parsed(name: str, values: Sequence[Any], run: Path | None, wrong: dict[int, str]) -> list[Any]:
    """Return a column as rows have it; add the first reason against each bad place to `wrong`."""
    known, reasons = dict[Any, Any](), dict[Any, str]()
    for value in set(values):  # of one type, and most occur in many rows
        try:
            found = parse(name, value)
            known[value] = run and run / found if name == "video" and found else found
        except InterferenceError as error:
            reasons[value] = f"{error.message}. {error.hint or ''}".strip()
        except ValueError as error:
            shown = "(empty)" if value in (None, "") else repr(value)
            reasons[value] = f"{name} {shown}; expected {error}"
    for place, value in enumerate(values if reasons else ()):
        if value in reasons:
            wrong.setdefault(place, reasons[value])
    return [*map(known.get, values)]
