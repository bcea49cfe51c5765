"""Rows of rollouts, checked: each by itself, and against those of the same episode or rollout."""

import math
import re
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.conditions import parse_condition
from robomme_interference_data.constants import (
    DIFFICULTIES,
    FAMILIES,
    MAX_STEPS,
    PROTOCOL_VERSION,
    SPLITS,
)
from robomme_interference_data.errors import (
    BadRowsError,
    InterferenceError,
    InvalidOptionError,
    UnknownNameError,
    nearest,
)
from robomme_interference_data.evaluate.score.sources import (
    COLUMNS,
    Codes,
    Part,
    Source,
    find_sources,
    read_part,
)
from robomme_interference_data.evaluate.systems import name_system
from robomme_interference_data.records import FINAL, Status
from robomme_interference_data.simulators.registry import SIMULATORS

__all__ = ["RELEASED_SIMULATOR", "Rows", "read_rows"]

RELEASED_SIMULATOR = "robomme"
"""The simulator of rows that name none."""

_SHOWN = 10
"""So many bad rows are named; the others are counted."""

_WHOLE = re.compile(r"([0-9]{1,18})(?:\.0+)?")
_SIMULATOR = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._:-]{0,127}")
"""Names of files hold it, so no `/`. A simulator of one's own is `module:function` in rows."""

_WORDS: dict[str, bool | None] = {"": None, "none": None, "nan": None}
_WORDS |= dict.fromkeys(("1", "true", "1.0"), True) | dict.fromkeys(("0", "false", "0.0"), False)
_EPISODE = ("simulator", "family", "episode_split", "episode")
_ROLLOUT = ("system", "condition", "model_seed", *_EPISODE)


@dataclass(frozen=True)
class Rows:
    """N rows that passed every check, in the order of their files.

    Attributes:
        codes: Column to the place of each row's value in `values`, `(N,) int64`.
        values: Column to its distinct values; None is an empty cell.
        source: Place of each row's file in `sources`, `(N,) int64`.
        sources: The files that were read.
        revisions: Simulator to the revision of its split, where rows name one.
        unpinned: Simulator and system of rows that name no revision, as released ones.
        refusals: The first bad rows that were left out: place and reason.
        refused: How many were.
    """

    codes: dict[str, Codes]
    values: dict[str, list[Any]]
    source: Codes
    sources: tuple[Source, ...]
    revisions: dict[str, str] = field(default_factory=dict)
    unpinned: frozenset[tuple[str, str]] = frozenset()
    refusals: tuple[str, ...] = ()
    refused: int = 0

    def __len__(self) -> int:
        return len(self.source)

    def names(self, column: str) -> list[Any]:
        """Return the values of a column that occur, sorted."""
        return sorted(self.values[column][code] for code in np.unique(self.codes[column]))

    def list(self, column: str) -> list[Any]:
        """Return the value of each row."""
        values = self.values[column]
        return [values[code] for code in self.codes[column].tolist()]

    def places(self, column: str, order: Sequence[Any]) -> Codes:
        """Return the place of each row's value among others, −1 for none, `(N,) int64`."""
        at = {value: place for place, value in enumerate(order)}
        return np.array([at.get(one, -1) for one in self.values[column]], np.int64)[
            self.codes[column]
        ]

    def numbers(self, column: str) -> Codes:
        """Return the number of each row, −1 for none, `(N,) int64`."""
        values = [-1 if one is None else one for one in self.values[column]]
        return np.array(values, np.int64)[self.codes[column]]

    def chosen(self, rows: NDArray[Any]) -> "Rows":
        """Return some of the rows: their numbers, or a flag for each."""
        codes = {name: found[rows] for name, found in self.codes.items()}
        return replace(self, codes=codes, source=self.source[rows])


def read_rows(paths: Sequence[Path], system: str | None = None, lenient: bool = False) -> Rows:
    """Read rows from folders of runs and files, and check each of them.

    Args:
        paths: Folders of runs, and `.jsonl`, `.parquet` and `.csv` files.
        system: Name of the system of rows that name none.
        lenient: Leave bad rows out, and count them. Of equal rows of one rollout the first stays,
            of rows that contradict each other none.

    Raises:
        BadRowsError: A row is bad: unknown family, condition, status or system, numbers out of
            range, a success that contradicts the status, the same rollout twice, rows of
            different splits, or an episode with two seeds or difficulties.
        InvalidIdError, UnknownNameError: `system` is no name of a system; see `name_system`.
        InvalidOptionError: Some rows of a system name the revision of their split, others none.
        MissingFileError: There is no such file.
        FormatError: A file cannot be read, lacks columns, or has some of a type that does not fit.
    """
    if system is not None:
        name_system(system)
    sources = find_sources(paths)
    reader = _Reader(system)
    for source in sources:
        reader.add(source, read_part(source, with_system=system is not None))
    rows, refusals = reader.rows()
    if refusals and not lenient:
        more = len(refusals) - _SHOWN
        shown = [*refusals[:_SHOWN], *([f"… and {more:,} more"] if more > 0 else [])]
        raise BadRowsError(
            "\n".join([f"{len(refusals):,} bad row{'s' * (len(refusals) > 1)}:", *shown]),
            "Mend them, or leave them out with --lenient.",
        )
    shown = tuple(refusals[:_SHOWN])
    unpinned = _unpinned(rows)
    return replace(rows, unpinned=unpinned, refusals=shown, refused=len(refusals))


def _unpinned(rows: Rows) -> frozenset[tuple[str, str]]:
    """Return simulator and system of rows that name no revision.

    Rows of one system whose histories may differ are not joined (protocol, rule 5).
    """
    named = rows.places("revision", [None]) < 0
    names = [rows.values[column] for column in ("simulator", "system")]
    sizes = (*map(len, names), 2)
    codes = (rows.codes["simulator"], rows.codes["system"], named.astype(int))
    pairs = np.unravel_index(np.unique(np.ravel_multi_index(codes, sizes)), sizes)
    found = [
        (names[0][one], names[1][other], known)
        for one, other, known in zip(*(part.tolist() for part in pairs), strict=True)
    ]
    unpinned = {(one, other) for one, other, known in found if not known}
    for one, other, known in sorted(found):
        if known and (one, other) in unpinned:
            raise InvalidOptionError(
                f"some rows of {other} in {one} are of the split with revision "
                f"{rows.revisions[one]}, others name no revision, as released rows do",
                "Their histories may differ: score the files apart, or compare them.",
            )
    return frozenset(unpinned)


class _Reader:
    """Joins the rows of files, and notes the first reason against each bad one."""

    def __init__(self, system: str | None):
        self._default = {
            **{"simulator": RELEASED_SIMULATOR, "system": system, "episode_split": "test"},
            **{"model_seed": 0, "protocol_version": PROTOCOL_VERSION},
        }
        self._parts: list[tuple[Source, Part]] = []
        self._codes: dict[str, list[Codes]] = {name: [] for name in COLUMNS}
        self._places: dict[str, dict[Any, int]] = {name: {} for name in COLUMNS}
        self._starts = [0]  # of parts
        self._reasons: dict[int, str] = {}

    def add(self, source: Source, part: Part) -> None:
        """Take the rows of a file, and judge each value by itself."""
        for name in COLUMNS:
            places = self._places[name]
            if name not in part.columns:
                code = places.setdefault(self._default.get(name), len(places))
                self._codes[name].append(np.full(part.count, code, np.int64))
                continue
            codes, values = part.columns[name]
            known, reasons = np.full(len(values), -1, np.int64), {}
            for code, value in enumerate(values):
                try:
                    parsed = _PARSERS[name](value)
                    known[code] = places.setdefault(parsed, len(places))
                except InterferenceError as error:
                    reasons[code] = f"{error.message}. {error.hint or ''}".strip()
                except ValueError as error:
                    reasons[code] = f"{name} {_shown(value)}; expected {error}"
            self._codes[name].append(known[codes])
            for row in np.flatnonzero(known[codes] < 0).tolist():
                self._reasons.setdefault(self._starts[-1] + row, reasons[int(codes[row])])
        self._parts.append((source, part))
        self._starts.append(self._starts[-1] + part.count)

    def rows(self) -> tuple[Rows, list[str]]:
        """Return the rows that are sound, beside each other too, and what is against the others."""
        empty = np.zeros(0, np.int64)
        rows = Rows(
            {name: np.concatenate([empty, *found]) for name, found in self._codes.items()},
            {name: list(places) for name, places in self._places.items()},
            np.repeat(np.arange(len(self._parts)), [part.count for _, part in self._parts]),
            tuple(source for source, _ in self._parts),
        )
        self._check_success(rows)
        revisions = self._check_revisions(rows)
        self._check_scenes(rows)
        self._check_repeats(rows)
        found = [(*self._where(row), reason) for row, reason in self._reasons.items()]
        for number, (_, part) in enumerate(self._parts):
            found += [(number, line, reason) for line, reason in part.malformed]
        refusals = [
            f"{self._parts[number][0].place(line)}: {reason}"
            for number, line, reason in sorted(found)
        ]
        return replace(rows.chosen(self._sound(rows)), revisions=revisions), refusals

    def _sound(self, rows: Rows) -> Codes:
        sound = np.ones(len(rows), bool)
        sound[list(self._reasons)] = False
        return np.flatnonzero(sound)

    def _where(self, row: int) -> tuple[int, int]:
        """Return the file of a row by its number, and its line there."""
        number = bisect_right(self._starts, row) - 1
        return number, self._parts[number][1].line(row - self._starts[number])

    def _check_success(self, rows: Rows) -> None:
        sound = self._sound(rows)
        names, given = rows.values["status"], rows.values["success"]
        status, success = (rows.codes[name][sound] for name in ("status", "success"))
        expected = [None if one == Status.ERROR else one == Status.SUCCESS for one in names]
        fits = np.array([[one is other for other in given] for one in expected], bool)
        for at in np.flatnonzero(~fits[status, success]).tolist():
            self._reasons[int(sound[at])] = (
                f"success {_shown(given[success[at]])} contradicts status {names[status[at]]!r}"
            )

    def _check_revisions(self, rows: Rows) -> dict[str, str]:
        """Return the one revision of each simulator: that of its first row."""
        sound = self._sound(rows)
        names, known = rows.values["revision"], {}
        simulator, revision = (rows.codes[name][sound] for name in ("simulator", "revision"))
        for code, name in enumerate(rows.values["simulator"]):
            here = np.flatnonzero((simulator == code) & (revision != _code(names, None)))
            if not len(here):
                continue
            known[name] = names[revision[here[0]]]
            for at in here[revision[here] != revision[here[0]]].tolist():
                self._reasons[int(sound[at])] = (
                    f"revision {names[revision[at]]!r} beside {known[name]!r}: rows of different "
                    "splits do not mix"
                )
        return dict(sorted(known.items()))

    def _check_scenes(self, rows: Rows) -> None:
        """Hold seed and difficulty against what the first row of the same episode says."""
        for name in ("difficulty", "seed"):
            sound, values = self._sound(rows), rows.values[name]
            sound = sound[rows.codes[name][sound] != _code(values, None)]
            codes = rows.codes[name][sound]
            key = _joint(rows, _EPISODE, sound)
            _, first, group = np.unique(key, return_index=True, return_inverse=True)
            for at in np.flatnonzero(codes != codes[first][group]).tolist():
                self._reasons[int(sound[at])] = (
                    f"{name} {values[codes[at]]!r} differs from that of other rows of the same "
                    "episode"
                )

    def _check_repeats(self, rows: Rows) -> None:
        """Leave one row of each rollout, and none where its rows contradict each other.

        So what a score says does not depend on the order of files.
        """
        sound = self._sound(rows)
        key = _joint(rows, _ROLLOUT, sound)
        order = np.argsort(key, kind="stable")
        sound, begins = sound[order], np.diff(key[order], prepend=-1) != 0
        group = np.cumsum(begins) - 1
        first, status = sound[begins][group], rows.codes["status"]
        contradicted = np.isin(group, group[status[sound] != status[first]])
        other = np.where(begins, np.roll(sound, -1), first)
        for at in np.flatnonzero(~begins | contradicted).tolist():
            number, line = self._where(int(other[at]))
            more = "; its rows contradict each other" if contradicted[at] else ""
            place = self._parts[number][0].place(line)
            self._reasons[int(sound[at])] = f"the same rollout as {place}{more}"


def _joint(rows: Rows, columns: Sequence[str], chosen: Codes) -> Codes:
    """Return one number for what some rows have in several columns."""
    sizes = tuple(max(1, len(rows.values[name])) for name in columns)
    return np.ravel_multi_index(tuple(rows.codes[name][chosen] for name in columns), sizes)


def _code(values: Sequence[Any], value: Any) -> int:
    return values.index(value) if value in values else -1


# --- values ------------------------------------------------------------------------------------


def _shown(value: Any) -> str:
    return "(empty)" if value is None else repr(value)


def _simulator(value: Any) -> str:
    name = str(value or "")
    if name not in SIMULATORS and name.lower() in SIMULATORS:
        raise UnknownNameError(f"there is no simulator {name!r}", nearest(name, SIMULATORS))
    if not _SIMULATOR.fullmatch(name):
        raise ValueError("up to 128 letters, digits, '.', '_', '-' and ':'")
    return name


def _named(column: str, known: Sequence[str], *, optional: bool = False) -> Callable[[Any], Any]:
    def parse(value: Any) -> str | None:
        if optional and not value:
            return None
        if value not in known:
            raise InvalidOptionError.one_of(column, str(value or ""), known)
        return str(value)

    return parse


def _status(value: Any) -> str:
    # The released rows call a timeout what it is before the last step.
    return str(_named("status", FINAL)("timeout" if value == Status.ONGOING else value))


def _success(value: Any) -> bool | None:
    word = str(value).lower()
    if word not in _WORDS:
        raise ValueError("1, 0, true, false or nothing")
    return _WORDS[word]


def _revision(value: Any) -> str:
    if not value:
        raise ValueError("the revision of a split")
    return str(value)


def _protocol(value: Any) -> int:
    if whole_number(value) != PROTOCOL_VERSION:
        raise ValueError(PROTOCOL_VERSION)
    return PROTOCOL_VERSION


def _whole(most: int | None = None, *, optional: bool = False) -> Callable[[Any], Any]:
    def parse(value: Any) -> int | None:
        if optional and (value is None or value != value):  # noqa: PLR0124 - NaN
            return None
        number = whole_number(value)
        if number is None or (most is not None and number > most):
            raise ValueError("a whole number from 0" + (f" to {most}" if most else ""))
        return number

    return parse


def whole_number(value: Any) -> int | None:
    """Return a number of a column as an integer, None where it is no whole number from 0 to 10¹⁸.

    Programs save whole numbers beside missing ones as floats, so `630000.0` is one.
    """
    if isinstance(value, str):
        match = _WHOLE.fullmatch(value)
        return int(match[1]) if match else None
    if isinstance(value, bool) or value is None or not 0 <= value < 10**18 or value % 1 != 0:
        return None
    return int(value)


def _fraction(value: Any) -> float | None:
    try:
        number = math.nan if value in (None, "") else float(value)
    except ValueError:
        raise ValueError("a number") from None
    return None if math.isnan(number) else number


def _text(value: Any) -> str | None:
    return None if value is None else str(value)


_PARSERS: dict[str, Callable[[Any], Any]] = {
    **dict.fromkeys(COLUMNS, _fraction),
    "system": lambda value: name_system(str(value or "")).name,
    "simulator": _simulator,
    "revision": _revision,
    "family": _named("family", FAMILIES),
    "condition": lambda value: parse_condition(str(value or "")).name,
    "episode_split": _named("episode_split", SPLITS),
    "episode": _whole(),
    "model_seed": _whole(),
    "protocol_version": _protocol,
    "seed": _whole(optional=True),
    "difficulty": _named("difficulty", DIFFICULTIES, optional=True),
    "status": _status,
    "success": _success,
    "steps": _whole(MAX_STEPS, optional=True),
    "video": _text,
    "retrieval_model": _text,
}
