"""Rows of rollouts, checked: each by itself, and against those of the same episode or rollout."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import BadRowsError, InterferenceError, InvalidOptionError
from robomme_interference_data.evaluate.run.log import RunHeader
from robomme_interference_data.evaluate.systems import name_system
from robomme_interference_data.schema.rollouts import Status

from .files import RawRow, find_sources, read_file, system_of
from .values import DEFAULTS, Row, parse, shifted

_SHOWN = 10  # so many bad rows are named; the others are counted

_EPISODE = ("simulator", "family", "episode_split", "episode")
_ROLLOUT = ("system", "condition", "model_seed", *_EPISODE)


@dataclass(frozen=True)
class Rows:
    """Rows that passed every check, in the order of their files.

    Attributes:
        rows: The rows.
        sources: The files that were read (see `files.find_sources`).
        revisions: Simulator to the revision of its split, where rows name one.
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
        default = {**dict.fromkeys(Row._fields), **DEFAULTS, "system": name}
        parser = _Parser(default, path.parent if run is not None else None)
        for raw in read_file(path, Row._fields, name is not None):
            checks.add(path, raw, parser)
    checks.check_together()
    refusals = checks.refusals()
    if refusals and not lenient:
        lines = [f"{len(refusals):,} bad row{'s' * (len(refusals) > 1)}:", *refusals[:_SHOWN]]
        if more := len(refusals) - _SHOWN:
            lines += [f"… and {more:,} more"] * (more > 0)
        raise BadRowsError("\n".join(lines), "Mend them, or leave them out with lenient=True.")
    rows = tuple(checks.sound.values())
    cells = {(row.simulator, row.system, row.revision) for row in rows}
    unpinned = frozenset((simulator, one) for simulator, one, revision in cells if revision is None)
    pinned = {(simulator, one) for simulator, one, revision in cells if revision is not None}
    revisions = {simulator: revision for simulator, _, revision in cells if revision is not None}
    for simulator, one in sorted(pinned & unpinned):  # protocol, rule 5
        raise InvalidOptionError(
            f"some rows of {one} in {simulator} are of the split with revision "
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


class _Parser:
    """Makes rows of a file's values; the folder of its run is what videos are relative to."""

    def __init__(self, default: Mapping[str, Any], run: Path | None):
        self._default, self._run = default, run
        # Most values occur in many rows. True and 1 are equal, and not the same.
        self._parse = lru_cache(maxsize=1 << 16, typed=True)(self._parsed)

    def row(self, values: Mapping[str, Any]) -> Row:
        """Return the row; a ValueError or an InterferenceError tells what is wrong."""
        given = {name: self._parse(name, values[name]) for name in Row._fields if name in values}
        row = Row(**{**self._default, **given})
        expected = None if row.status == Status.ERROR else row.status == Status.SUCCESS
        if row.success is not expected:
            shown = "(empty)" if row.success is None else row.success
            raise ValueError(f"success {shown} contradicts status {row.status!r}")
        return row._replace(simulator=shifted(row.simulator, row.shift))

    def _parsed(self, name: str, value: Any) -> Any:
        try:
            parsed = parse(name, value)
        except InterferenceError as error:
            raise ValueError(f"{error.message}. {error.hint or ''}".strip()) from None
        except ValueError as error:
            shown = "(empty)" if value in (None, "") else repr(value)
            raise ValueError(f"{name} {shown}; expected {error}") from None
        if name == "video":
            return self._run / parsed if parsed and self._run else None
        return parsed


class _Checks:
    """All rows, and the reason against each bad one.

    Attributes:
        sound: Number of a row, in the order of the files, to the row.
    """

    def __init__(self) -> None:
        self.sound: dict[int, Row] = {}
        self._places: list[tuple[Path, int]] = []
        self._reasons: dict[int, str] = {}

    def add(self, path: Path, raw: RawRow, parser: _Parser) -> None:
        """Add a row of a file."""
        number = len(self._places)
        self._places.append((path, raw.line))
        try:
            if isinstance(raw.values, str):
                raise ValueError(raw.values)
            self.sound[number] = parser.row(raw.values)
        except ValueError as error:
            self._reasons[number] = str(error)

    def check_together(self) -> None:
        """Check rows against others."""
        self._check_alike("revision", ("simulator",), "rows of different splits do not mix")
        for name in ("difficulty", "seed", "chance"):
            self._check_alike(name, _EPISODE, "an episode has one")
        self._check_repeats()

    def refusals(self) -> list[str]:
        """Return place and reason of each bad row, in the order of the files."""
        return [f"{self._place(number)}: {why}" for number, why in sorted(self._reasons.items())]

    def _place(self, number: int) -> str:
        path, line = self._places[number]
        return f"{path}, {'row' if path.suffix.lower() == '.parquet' else 'line'} {line}"

    def _refuse(self, number: int, reason: str) -> None:
        del self.sound[number]
        self._reasons[number] = reason

    def _check_alike(self, name: str, of: Sequence[str], why: str) -> None:
        """Compare a value with that of the first row with the same values in other columns."""
        key, value = attrgetter(*of), attrgetter(name)
        first: dict[Any, Any] = {}
        for number, row in [*self.sound.items()]:
            if (own := value(row)) is not None and own != (
                known := first.setdefault(key(row), own)
            ):
                self._refuse(number, f"{name} {own!r} beside {known!r}: {why}")

    def _check_repeats(self) -> None:
        """Leave one row of each rollout, and none where its rows contradict each other."""
        key: Callable[[Row], Any] = attrgetter(*_ROLLOUT)
        groups = defaultdict[Any, list[int]](list)
        for number, row in self.sound.items():
            groups[key(row)].append(number)
        for numbers in groups.values():
            first, *others = numbers
            contradicted = len({self.sound[number].status for number in numbers}) > 1
            more = "; its rows contradict each other" * contradicted
            if contradicted:
                self._refuse(first, f"the same rollout as {self._place(others[0])}{more}")
            for number in others:
                self._refuse(number, f"the same rollout as {self._place(first)}{more}")
