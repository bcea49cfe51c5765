"""All rows of a scoring, checked, eight bytes each."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import BadRowsError, InvalidOptionError
from robomme_interference_data.evaluate.score.batches import Batch
from robomme_interference_data.evaluate.score.check import (
    BITS,
    REFUSED,
    Checker,
    episode_group,
    field,
    pack,
)
from robomme_interference_data.evaluate.score.columns import flags
from robomme_interference_data.evaluate.score.read import Source, find_sources, read_batches
from robomme_interference_data.evaluate.systems import SYSTEMS, name_system

__all__ = ["Refusal", "Rollouts", "read_rollouts"]

_SHOWN = 10
"""So many bad rows are named; the others are counted."""

_STEP = 2**18
_STATUS_BITS = np.uint64(BITS["status"])


@dataclass(frozen=True)
class Refusal:
    """A row that was refused: its file, its line (of a CSV, or row of a parquet file), why."""

    path: Path
    line: int
    reason: str

    def __str__(self) -> str:
        return f"{_place(self.path, self.line)}: {self.reason}"


@dataclass(frozen=True)
class Rollouts:
    """Rows that passed every check.

    Attributes:
        packed: One number a row, sorted, no two of the same rollout, `(N,) uint64` (see `check`).
        simulators: Names by code, sorted.
        systems: Names by code, in the order of tables.
        model_seeds: Seeds by code, ascending.
        difficulty: Code by episode, −1 unknown; see `Rollouts.difficulty_of`.
        seeds: Seed of the scene by episode, −1 unknown, likewise.
        revisions: Simulator to the revision of its split, where rows name one.
        unpinned: Simulator and system of rows that name no revision, as released ones.
        videos: Packed row, its status left out, to the video of it.
        sources: The files that were read.
        refusals: The first bad rows that were skipped.
        refused: How many were.
    """

    packed: NDArray[np.uint64]
    simulators: tuple[str, ...]
    systems: tuple[str, ...]
    model_seeds: tuple[int, ...]
    difficulty: NDArray[np.int8]
    seeds: NDArray[np.int64]
    revisions: dict[str, str]
    unpinned: frozenset[tuple[str, str]]
    videos: dict[int, Path]
    sources: tuple[Source, ...]
    refusals: tuple[Refusal, ...] = ()
    refused: int = 0

    def difficulty_of(self, simulator: int, episodes: NDArray[np.int64]) -> NDArray[np.int8]:
        """Return the difficulty code of each packed episode (family, split, index), −1 unknown."""
        packed = episodes.astype(np.uint64) << np.uint64(BITS["model_seed"] + BITS["status"])
        family, split = field(packed, "family"), field(packed, "episode_split")
        group = episode_group(simulator, family, split)
        index = field(packed, "episode")
        known = np.full(len(episodes), -1, np.int8)
        inside = (index < self.difficulty.shape[1]) & (group < len(self.difficulty))
        known[inside] = self.difficulty[group[inside], index[inside]]
        return known


class _Reader:
    """Collects packed rows in reading order, and remembers where each stands."""

    def __init__(self, lenient: bool):
        self.lenient = lenient
        self.chunks: list[NDArray[np.uint64]] = []
        self.starts: list[tuple[int, Path, Batch]] = []  # row number, its file, its batch
        self.refusals: list[Refusal] = []
        self.refused = 0
        self.videos: list[tuple[int, Path]] = []
        self.rows = 0

    def read(self, source: Source, checker: Checker) -> None:
        for batch in read_batches(source):
            packed, reasons = checker.pack(batch, source)
            for line, reason in batch.malformed:
                self.refuse(source.path, line, reason)
            for row in sorted(reasons):
                # Lines are worked out for those that are shown.
                line = batch.line(row) if len(self.refusals) < _SHOWN else 0
                self.refuse(source.path, line, reasons[row])
            self.give_up_if_strict()
            self.starts.append((self.rows, source.path, replace(batch, columns={})))
            if "video" in batch.columns and source.folder is not None:
                video = batch.columns["video"]
                for row in np.flatnonzero(flags(video.is_valid())).tolist():
                    self.videos.append((self.rows + row, source.folder / video[row].as_py()))
            self.chunks.append(packed)
            self.rows += batch.rows

    def joined(self) -> NDArray[np.uint64]:
        """Return all rows in one array; the chunks go as they are copied."""
        packed, start = np.empty(self.rows, np.uint64), 0
        self.chunks.reverse()
        while self.chunks:
            chunk = self.chunks.pop()
            packed[start : start + len(chunk)] = chunk
            start += len(chunk)
        return packed

    def refuse(self, path: Path, line: int, reason: str) -> None:
        self.refused += 1
        if len(self.refusals) < _SHOWN:
            self.refusals.append(Refusal(path, line, reason))

    def give_up_if_strict(self) -> None:
        if self.refused and not self.lenient:
            more = self.refused - len(self.refusals)
            lines = [str(refusal) for refusal in self.refusals]
            lines += [f"… and {more:,} more so far"] if more else []
            raise BadRowsError(
                "\n".join([f"{self.refused:,} bad row{'s' * (self.refused > 1)}:", *lines]),
                "Mend them, or leave them out with --lenient.",
            )

    def where(self, row: int) -> tuple[Path, int]:
        """Return file and line of a row by its number."""
        place = np.searchsorted([start for start, _, _ in self.starts], row, side="right") - 1
        start, path, batch = self.starts[int(place)]
        return path, batch.line(row - start)

    def refuse_duplicates(self, packed: NDArray[np.uint64]) -> NDArray[np.uint64]:
        """Return the rows, sorted: one of each rollout, none where its rows contradict each other.

        So what stays does not depend on the order of files.
        """
        ordered = np.sort(packed)
        ordered = ordered[: np.searchsorted(ordered, REFUSED)]
        if not any(
            (np.diff(ordered[start : start + _STEP + 1] >> _STATUS_BITS) == 0).any()
            for start in range(0, len(ordered), _STEP)
        ):
            return ordered
        keys = packed >> _STATUS_BITS
        order = np.argsort(keys, kind="stable")
        order = order[packed[order] != REFUSED]
        begins = np.diff(keys[order], prepend=REFUSED) != 0
        group = np.cumsum(begins) - 1
        first = order[begins][group]
        contradicted = np.zeros(int(begins.sum()), bool)
        contradicted[group[packed[order] != packed[first]]] = True
        refused = ~begins | contradicted[group]
        kept = np.sort(packed[order[~refused]])
        other = np.where(begins, np.roll(order, -1), first)
        found = np.stack([order, other, contradicted[group]], axis=1)[refused]
        for row, same, differs in sorted(found.tolist()):
            more = "; its rows contradict each other" if differs else ""
            path, line = self.where(row)
            self.refuse(path, line, f"the same rollout as {_place(*self.where(same))}{more}")
        self.give_up_if_strict()
        return kept


def read_rollouts(
    paths: Sequence[Path], system: str | None = None, lenient: bool = False
) -> Rollouts:
    """Read rows from files and folders of runs, and check each of them.

    Memory grows by 8 bytes a row, twice that while rows are sorted.

    Args:
        paths: Folders of runs, CSVs and parquet files.
        system: Name of the system of rows that name none.
        lenient: Skip and count bad rows.

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
    sources = find_sources(paths, with_system=system is not None)
    checker, reader = Checker(system), _Reader(lenient)
    for source in sources:
        reader.read(source, checker)
    _check_revisions(checker)
    packed = reader.joined()
    orders = {
        "simulator": _ranks(checker.simulators, lambda name: name),
        "system": _ranks(checker.systems, _table_order),
        "model_seed": _ranks(checker.model_seeds, lambda seed: seed),
    }
    _recode(packed, orders)
    videos = [(packed[row], path) for row, path in reader.videos]
    packed = reader.refuse_duplicates(packed)
    by_name = np.argsort(orders["simulator"])
    return Rollouts(
        packed,
        tuple(sorted(checker.simulators)),
        tuple(sorted(checker.systems, key=_table_order)),
        tuple(sorted(checker.model_seeds)),
        _regrouped(checker.difficulty, by_name),
        _regrouped(checker.seeds, by_name),
        dict(sorted(checker.revisions.items())),
        frozenset((checker.simulators[s], checker.systems[n]) for s, n in checker.unpinned),
        _kept_videos(videos, packed),
        tuple(sources),
        tuple(reader.refusals),
        reader.refused,
    )


def _place(path: Path, line: int) -> str:
    return f"{path}, {'row' if path.suffix.lower() == '.parquet' else 'line'} {line}"


def _check_revisions(checker: Checker) -> None:
    """Refuse to join, as one system's, rows whose histories may differ (protocol, rule 5)."""
    for simulator, system in sorted(checker.pinned & checker.unpinned):
        name = checker.simulators[simulator]
        raise InvalidOptionError(
            f"some rows of {checker.systems[system]} in {name} are of the split with revision "
            f"{checker.revisions[name]}, others name no revision, as released rows do",
            "Their histories may differ: score the files apart, or compare them.",
        )


def _kept_videos(
    videos: Sequence[tuple[np.uint64, Path]], packed: NDArray[np.uint64]
) -> dict[int, Path]:
    """Return the videos of rows that stayed; of a rollout's several the first by path."""
    rows = np.array([row for row, _ in videos], np.uint64)
    kept = np.searchsorted(packed, rows, "left") < np.searchsorted(packed, rows, "right")
    there = [videos[place] for place in np.flatnonzero(kept).tolist()]
    return {int(row >> _STATUS_BITS): path for row, path in sorted(there, reverse=True)}


def _table_order(system: str) -> tuple[int, str]:
    known = list(SYSTEMS)
    return (known.index(system) if system in SYSTEMS else len(known), system)


def _ranks(values: Sequence[Any], key: Callable[[Any], Any]) -> NDArray[np.int64]:
    """Return the place of each value among the sorted values."""
    order = sorted(range(len(values)), key=lambda index: key(values[index]))
    ranks = np.zeros(len(values), np.int64)
    ranks[order] = np.arange(len(values))
    return ranks


def _regrouped[T: np.generic](known: NDArray[T], order: NDArray[np.int64]) -> NDArray[T]:
    """Return what is known of episodes with the simulators in another order."""
    if not len(order):
        return known
    return known.reshape(len(order), -1, known.shape[1])[order].reshape(known.shape)


def _recode(packed: NDArray[np.uint64], ranks: Mapping[str, NDArray[np.int64]]) -> None:
    """Replace codes in reading order by ranks, so that the order of files makes no difference."""
    changed = {name: rank for name, rank in ranks.items() if (np.diff(rank) != 1).any()}
    if not changed:
        return
    for start in range(0, len(packed), _STEP):
        part = packed[start : start + _STEP]
        sound = part != REFUSED
        codes = {name: field(part[sound], name) for name in BITS}
        codes |= {name: rank[codes[name]] for name, rank in changed.items()}
        part[sound] = pack(**codes)
