"""Rows of rollouts, checked: each by itself, and against those of the same episode or rollout."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, groupby, product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import PROTOCOL_VERSION
from robomme_interference_data.errors import BadRowsError, InterferenceError, InvalidOptionError
from robomme_interference_data.evaluate.run.log import RunHeader
from robomme_interference_data.evaluate.systems import name_system
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.shifts import NO_SHIFT

from .sources import (
    COLUMNS,
    Codes,
    Part,
    find_sources,
    read_part,
    system_of,
)
from .values import parsed, shifted, shown

RELEASED_SIMULATOR = "robomme"
"""The simulator of rows that name none."""

_SHOWN = 10  # so many bad rows are named; the others are counted

_EPISODE = ("simulator", "family", "episode_split", "episode")
_ROLLOUT = ("system", "condition", "model_seed", *_EPISODE)


@dataclass(frozen=True)
class Rows:
    """N rows that passed every check, in the order of their files.

    Attributes:
        codes: Column to the place of each row's value in `values`, `(N,) int64`.
        values: Column to its distinct values; None is an empty cell. Videos are paths.
        sources: The files that were read (see `sources.find_sources`).
        revisions: Simulator to the revision of its split, where rows name one.
        unpinned: Simulator and system of rows that name no revision, as released ones.
        retrieval: Simulator and system to the retrieval steps in front of it, if there are any.
        refusals: The first bad rows that were left out: place and reason.
        refused: How many were.
    """

    codes: dict[str, Codes]
    values: dict[str, list[Any]]
    sources: Mapping[Path, RunHeader | None]
    revisions: dict[str, str] = field(default_factory=dict)
    unpinned: frozenset[tuple[str, str]] = frozenset()
    retrieval: Mapping[tuple[str, str], str] = field(default_factory=dict)
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

    def by(self, column: str) -> dict[Any, "Rows"]:
        """Return the rows of each value of a column, by value, sorted."""
        places = self.places(column, names := self.names(column))
        return {name: self.chosen(places == place) for place, name in enumerate(names)}


def read_rows(paths: Sequence[Path], system: str | None = None, lenient: bool = False) -> Rows:
    """Read rows from folders of runs and files, and check each of them.

    Args:
        paths: Folders of runs, and `.jsonl`, `.parquet` and `.csv` files.
        system: Name of the system of rows that name none; else that in the name of an exported
            file.
        lenient: Leave bad rows out, and count them. Of equal rows of one rollout the first stays,
            of rows that contradict each other none.

    Raises:
        BadRowsError: A row is bad (docs/score.md says what that is).
        InvalidIdError, UnknownNameError: `system` is no name of a system; see `name_system`.
        InvalidOptionError: Some rows of a system name the revision of their split, others none.
        MissingFileError: There is no such file.
        FormatError: A file cannot be read, or lacks columns; see `sources.read_part`.
    """
    sources = find_sources(paths)
    systems = [system_of(path) if system is None else system for path in sources]
    for name in systems:
        if name is not None:
            name_system(name)
    parts = [read_part(path, one is not None) for path, one in zip(sources, systems, strict=True)]
    rows = _Joined(parts, [run is not None for run in sources.values()], systems).checked()
    if rows.refused and not lenient:
        lines = [f"{rows.refused:,} bad row{'s' * (rows.refused > 1)}:", *rows.refusals]
        if more := rows.refused - len(rows.refusals):
            lines.append(f"… and {more:,} more")
        raise BadRowsError("\n".join(lines), "Mend them, or leave them out with --lenient.")
    named = {*zip(*(rows.list(name) for name in ("simulator", "system", "revision")), strict=True)}
    unpinned = frozenset((simulator, one) for simulator, one, revision in named if revision is None)
    revisions = {simulator: revision for simulator, _, revision in named if revision is not None}
    pinned = {(simulator, one) for simulator, one, revision in named if revision is not None}
    for simulator, one in sorted(pinned & unpinned):  # protocol, rule 5
        raise InvalidOptionError(
            f"some rows of {one} in {simulator} are of the split with revision "
            f"{revisions[simulator]}, others name no revision, as released rows do",
            "Their histories may differ: score the files apart, or compare them.",
        )
    names = ("simulator", "system", "retrieval_model")
    steps = sorted({one for one in zip(*map(rows.list, names), strict=True) if one[-1] is not None})
    retrieval = {
        cell: ", ".join(step for *_, step in group)
        for cell, group in groupby(steps, lambda one: one[:2])
    }
    return replace(
        rows, sources=sources, revisions=revisions, unpinned=unpinned, retrieval=retrieval
    )


class _Joined:
    """The rows of files, and the first reason against each bad one."""

    def __init__(
        self, parts: Sequence[Part], in_run: Sequence[bool], systems: Sequence[str | None]
    ):
        self._parts, self._in_run, self._systems = parts, in_run, systems
        self._starts = [0, *accumulate(part.count for part in parts)]
        self._reasons: dict[int, str] = {}
        self._default = {
            **{"simulator": RELEASED_SIMULATOR, "episode_split": "test"},
            **{"shift": NO_SHIFT, "model_seed": 0, "protocol_version": PROTOCOL_VERSION},
        }
        self._rows = Rows({}, {}, {})
        for name in COLUMNS:
            places: dict[Any, int] = {}
            codes = [self._judged(name, number, places) for number in range(len(parts))]
            self._rows.codes[name] = np.concatenate([np.zeros(0, np.int64), *codes])
            self._rows.values[name] = list(places)
        self._tell_shifts_apart()

    def _judged(self, name: str, number: int, places: dict[Any, int]) -> Codes:
        """Judge the values of a column of one file, each by itself; −1 for a bad one."""
        part, start = self._parts[number], self._starts[number]
        if name not in part.columns:
            default = self._systems[number] if name == "system" else self._default.get(name)
            return np.full(part.count, places.setdefault(default, len(places)))
        codes, values = part.columns[name]
        known, reasons = np.full(len(values), -1, np.int64), {}
        for code, value in enumerate(values):
            try:
                found = parsed(name, value)
                if name == "video" and found:  # its path is from the run's folder
                    found = part.path.parent / found if self._in_run[number] else None
                known[code] = places.setdefault(found, len(places))
            except InterferenceError as error:
                reasons[code] = f"{error.message}. {error.hint or ''}".strip()
            except ValueError as error:
                reasons[code] = f"{name} {shown(value)}; expected {error}"
        for row in np.flatnonzero(known[codes] < 0).tolist():
            self._reasons.setdefault(start + row, reasons[int(codes[row])])
        return known[codes]

    def _tell_shifts_apart(self) -> None:
        """Let rows under a shift be of a simulator of their own, such as `tabletop+light:2`."""
        codes, values = self._rows.codes, self._rows.values
        places: dict[str, int] = {}
        named = [
            places.setdefault(shifted(*pair), len(places))
            for pair in product(values["simulator"], values["shift"])
        ]
        given, shift = codes["simulator"], codes["shift"]
        joint = np.array([*named, -1])[given * len(values["shift"]) + shift]
        codes["simulator"] = np.where((given < 0) | (shift < 0), -1, joint)
        values["simulator"] = list(places)

    def checked(self) -> Rows:
        """Return the rows that are sound, beside each other too, and what is against the others."""
        self._check_success()
        self._check_alike("revision", ("simulator",), "rows of different splits do not mix")
        for name in ("difficulty", "seed", "chance"):
            self._check_alike(name, _EPISODE, "an episode has one")
        self._check_repeats()
        found = [(*self._where(row), reason) for row, reason in self._reasons.items()]
        for number, part in enumerate(self._parts):
            found += [(number, line, reason) for line, reason in part.malformed]
        refusals = [f"{self._place(n, line)}: {reason}" for n, line, reason in sorted(found)]
        rows = self._rows.chosen(self._sound())
        return replace(rows, refusals=tuple(refusals[:_SHOWN]), refused=len(refusals))

    def _sound(self) -> Codes:
        sound = np.ones(len(self._rows), bool)
        sound[list(self._reasons)] = False
        return np.flatnonzero(sound)

    def _where(self, row: int) -> tuple[int, int]:
        """Return the number of a row's file, and its line there."""
        number = bisect_right(self._starts, row) - 1
        return number, self._parts[number].line(row - self._starts[number])

    def _place(self, number: int, line: int) -> str:
        path = self._parts[number].path
        return f"{path}, {'row' if path.suffix.lower() == '.parquet' else 'line'} {line}"

    def _joint(self, columns: Sequence[str], chosen: Codes) -> Codes:
        """Return one number for what some rows have in several columns."""
        codes, values = self._rows.codes, self._rows.values
        sizes = [max(1, len(values[name])) for name in columns]
        return np.ravel_multi_index([codes[name][chosen] for name in columns], sizes)

    def _check_success(self) -> None:
        codes, values = self._rows.codes, self._rows.values
        pairs = product(*(enumerate(values[name]) for name in ("status", "success")))
        for (status, name), (success, given) in pairs:
            if given is not (None if name == Status.ERROR else name == Status.SUCCESS):
                found = (codes["status"] == status) & (codes["success"] == success)
                for row in np.flatnonzero(found).tolist():
                    reason = f"success {shown(given)} contradicts status {name!r}"
                    self._reasons.setdefault(row, reason)

    def _check_alike(self, name: str, of: Sequence[str], why: str) -> None:
        """Hold a value against that of the first row with the same values in other columns."""
        values, sound = self._rows.values[name], self._sound()
        sound = sound[self._rows.places(name, [None])[sound] < 0]
        codes = self._rows.codes[name][sound]
        _, first, group = np.unique(self._joint(of, sound), return_index=True, return_inverse=True)
        for at in np.flatnonzero(codes != codes[first][group]).tolist():
            found, known = (values[code] for code in (codes[at], codes[first][group][at]))
            self._reasons[int(sound[at])] = f"{name} {found!r} beside {known!r}: {why}"

    def _check_repeats(self) -> None:
        """Leave one row of each rollout, and none where its rows contradict each other."""
        sound = self._sound()
        key = self._joint(_ROLLOUT, sound)
        order = np.argsort(key, kind="stable")
        sound, begins = sound[order], np.diff(key[order], prepend=-1) != 0
        group = np.cumsum(begins) - 1
        first, status = sound[begins][group], self._rows.codes["status"]
        contradicted = np.isin(group, group[status[sound] != status[first]])
        other = np.where(begins, np.roll(sound, -1), first)
        for at in np.flatnonzero(~begins | contradicted).tolist():
            more = "; its rows contradict each other" if contradicted[at] else ""
            place = self._place(*self._where(int(other[at])))
            self._reasons[int(sound[at])] = f"the same rollout as {place}{more}"
