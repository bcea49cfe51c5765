"""Rows of rollouts, checked: each by itself, and against those of the same episode or rollout."""

import re
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
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

_EPISODE = ("simulator", "family", "episode_split", "episode")
_ROLLOUT = ("system", "condition", "model_seed", *_EPISODE)

_NAMES = {"family": FAMILIES, "episode_split": SPLITS, "difficulty": DIFFICULTIES}
_NAMES["status"] = tuple(map(str, FINAL))
_NUMBERS = {
    **dict.fromkeys(("episode", "model_seed", "seed"), (0, 10**18 - 1)),  # as in episode ids
    "steps": (0, MAX_STEPS),
    "protocol_version": (PROTOCOL_VERSION, PROTOCOL_VERSION),
}
_WORDS = dict.fromkeys(("1", "true", "1.0"), True) | dict.fromkeys(("0", "false", "0.0"), False)
_FRACTIONS = {name for name in COLUMNS if name.endswith("_fraction")}
_OPTIONAL = {"seed", "difficulty", "steps", "success", "video", "retrieval_model", *_FRACTIONS}

_WHOLE = re.compile(r"([0-9]{1,18})(?:\.0+)?")  # programs save some whole numbers as floats
_SIMULATOR = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._:-]{0,127}")
"""Names of files hold it, so no `/`. A simulator of one's own is `module:function` in rows."""


@dataclass(frozen=True)
class Rows:
    """N rows that passed every check, in the order of their files.

    Attributes:
        codes: Column to the place of each row's value in `values`, `(N,) int64`.
        values: Column to its distinct values; None is an empty cell. Videos are paths.
        sources: The files that were read (see `sources.find_sources`).
        revisions: Simulator to the revision of its split, where rows name one.
        unpinned: Simulator and system of rows that name no revision, as released ones.
        refusals: The first bad rows that were left out: place and reason.
        refused: How many were.
    """

    codes: dict[str, Codes]
    values: dict[str, list[Any]]
    sources: Mapping[Path, Mapping[str, Any] | None]
    revisions: dict[str, str] = field(default_factory=dict)
    unpinned: frozenset[tuple[str, str]] = frozenset()
    refusals: tuple[str, ...] = ()
    refused: int = 0

    def __len__(self) -> int:
        return len(self.codes["status"])

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
        places = np.array([at.get(one, -1) for one in self.values[column]], np.int64)
        return places[self.codes[column]]

    def chosen(self, rows: NDArray[Any]) -> "Rows":
        """Return some of the rows: their numbers, or a flag for each."""
        return replace(self, codes={name: codes[rows] for name, codes in self.codes.items()})


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
        FormatError: A file cannot be read, or lacks columns; see `sources.read_part`.
    """
    if system is not None:
        name_system(system)
    reader, sources = _Reader(system), find_sources(paths)
    for path, header in sources.items():
        reader.add(read_part(path, system is not None), in_run=header is not None)
    rows = reader.checked()
    if rows.refused and not lenient:
        more = rows.refused - len(rows.refusals)
        lines = [f"{rows.refused:,} bad row{'s' * (rows.refused > 1)}:", *rows.refusals]
        lines += [f"… and {more:,} more"] if more else []
        raise BadRowsError("\n".join(lines), "Mend them, or leave them out with --lenient.")
    named = {*zip(*(rows.list(name) for name in ("simulator", "system", "revision")), strict=True)}
    unpinned = frozenset((simulator, one) for simulator, one, revision in named if revision is None)
    revisions = {simulator: revision for simulator, _, revision in named if revision is not None}
    for simulator, one, revision in named:
        if revision is not None and (simulator, one) in unpinned:  # protocol, rule 5
            raise InvalidOptionError(
                f"some rows of {one} in {simulator} are of the split with revision {revision}, "
                "others name no revision, as released rows do",
                "Their histories may differ: score the files apart, or compare them.",
            )
    return replace(rows, sources=sources, revisions=revisions, unpinned=unpinned)


class _Reader:
    """Joins the rows of files, and notes the first reason against each bad one."""

    def __init__(self, system: str | None):
        self._default = {
            **{"simulator": RELEASED_SIMULATOR, "system": system, "episode_split": "test"},
            **{"model_seed": 0, "protocol_version": PROTOCOL_VERSION},
        }
        self._parts: list[Part] = []
        self._starts = [0]  # of parts
        self._codes: dict[str, list[Codes]] = {name: [np.zeros(0, np.int64)] for name in COLUMNS}
        self._places: dict[str, dict[Any, int]] = {name: {} for name in COLUMNS}
        self._reasons: dict[int, str] = {}

    def add(self, part: Part, in_run: bool) -> None:
        """Take the rows of a file, and judge each value by itself."""
        start = self._starts[-1]
        for name in COLUMNS:
            default = np.zeros(part.count, np.int64), [self._default.get(name)]
            codes, values = part.columns.get(name, default)
            known, reasons = np.full(len(values), -1, np.int64), {}
            for code, value in enumerate(values):
                try:
                    parsed = _parsed(name, value) if name in part.columns else value
                    if name == "video" and parsed:  # its path is from the run's folder
                        parsed = part.path.parent / parsed if in_run else None
                    known[code] = self._places[name].setdefault(parsed, len(self._places[name]))
                except InterferenceError as error:
                    reasons[code] = f"{error.message}. {error.hint or ''}".strip()
                except ValueError as error:
                    reasons[code] = f"{name} {_shown(value)}; expected {error}"
            self._codes[name].append(known[codes])
            for row in np.flatnonzero(known[codes] < 0).tolist():
                self._reasons.setdefault(start + row, reasons[int(codes[row])])
        self._parts.append(part)
        self._starts.append(start + part.count)

    def checked(self) -> Rows:
        """Return the rows that are sound, beside each other too, and what is against the others."""
        rows = Rows(
            {name: np.concatenate(codes) for name, codes in self._codes.items()},
            {name: list(places) for name, places in self._places.items()},
            {},
        )
        self._check_success(rows)
        self._check_alike(rows, "revision", ("simulator",), "rows of different splits do not mix")
        for name in ("difficulty", "seed"):
            self._check_alike(rows, name, _EPISODE, "an episode has one")
        self._check_repeats(rows)
        found = [(*self._where(row), reason) for row, reason in self._reasons.items()]
        for number, part in enumerate(self._parts):
            found += [(number, line, reason) for line, reason in part.malformed]
        refusals = [f"{self._place(n, line)}: {reason}" for n, line, reason in sorted(found)]
        rows = rows.chosen(self._sound(rows))
        return replace(rows, refusals=tuple(refusals[:_SHOWN]), refused=len(refusals))

    def _sound(self, rows: Rows) -> Codes:
        sound = np.ones(len(rows), bool)
        sound[list(self._reasons)] = False
        return np.flatnonzero(sound)

    def _where(self, row: int) -> tuple[int, int]:
        """Return the number of a row's file, and its line there."""
        number = bisect_right(self._starts, row) - 1
        return number, self._parts[number].line(row - self._starts[number])

    def _place(self, number: int, line: int) -> str:
        path = self._parts[number].path
        return f"{path}, {'row' if path.suffix.lower() == '.parquet' else 'line'} {line}"

    def _check_success(self, rows: Rows) -> None:
        pairs = product(*(enumerate(rows.values[name]) for name in ("status", "success")))
        for (status, name), (success, given) in pairs:
            if given is not (None if name == Status.ERROR else name == Status.SUCCESS):
                found = (rows.codes["status"] == status) & (rows.codes["success"] == success)
                for row in np.flatnonzero(found).tolist():
                    reason = f"success {_shown(given)} contradicts status {name!r}"
                    self._reasons.setdefault(row, reason)

    def _check_alike(self, rows: Rows, name: str, of: Sequence[str], why: str) -> None:
        """Hold a value against that of the first row with the same values in other columns."""
        values = rows.values[name]
        sound = self._sound(rows)
        sound = sound[rows.places(name, [None])[sound] < 0]
        codes = rows.codes[name][sound]
        _, first, group = np.unique(_joint(rows, of, sound), return_index=True, return_inverse=True)
        for at in np.flatnonzero(codes != codes[first][group]).tolist():
            found, known = (values[code] for code in (codes[at], codes[first][group][at]))
            self._reasons[int(sound[at])] = f"{name} {found!r} beside {known!r}: {why}"

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
            more = "; its rows contradict each other" if contradicted[at] else ""
            place = self._place(*self._where(int(other[at])))
            self._reasons[int(sound[at])] = f"the same rollout as {place}{more}"


def _joint(rows: Rows, columns: Sequence[str], chosen: Codes) -> Codes:
    """Return one number for what some rows have in several columns."""
    sizes = tuple(max(1, len(rows.values[name])) for name in columns)
    return np.ravel_multi_index(tuple(rows.codes[name][chosen] for name in columns), sizes)


# --- values ------------------------------------------------------------------------------------


def _parsed(name: str, value: Any) -> Any:
    """Return a value of a column as rows have it.

    Raises:
        InterferenceError, ValueError: It is none; the latter says what was expected.
    """
    text = "" if value is None or value != value else str(value)  # noqa: PLR0124 - NaN
    if name in _OPTIONAL and text.lower() in ("", "nan", "none"):
        return None
    if name in _NUMBERS:
        match = _WHOLE.fullmatch(text)
        if not match or not _NUMBERS[name][0] <= int(match[1]) <= _NUMBERS[name][1]:
            raise ValueError("a whole number from {} to {}".format(*_NUMBERS[name]))
        return int(match[1])
    if name in _NAMES:
        # Released rows call a timeout what it is before the last step.
        text = str(Status.TIMEOUT) if text == Status.ONGOING else text
        if text not in _NAMES[name]:
            raise InvalidOptionError.one_of(name, text, _NAMES[name])
    elif name in _CHECKS:
        _CHECKS[name](text)
    elif name == "revision" and not text:
        raise ValueError("the revision of a split")
    elif name == "success":
        if text.lower() not in _WORDS:
            raise ValueError("1, 0, true, false or nothing")
        return _WORDS[text.lower()]
    return float(text) if name in _FRACTIONS else text


def _check_simulator(name: str) -> None:
    if name not in SIMULATORS and name.lower() in SIMULATORS:
        raise UnknownNameError(f"there is no simulator {name!r}", nearest(name, SIMULATORS))
    if not _SIMULATOR.fullmatch(name):
        raise ValueError("up to 128 letters, digits, '.', '_', '-' and ':'")


_CHECKS = {"system": name_system, "condition": parse_condition, "simulator": _check_simulator}


def _shown(value: Any) -> str:
    return "(empty)" if value is None else repr(value)
