"""What each system did on each episode under each condition."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DEFAULT_K, FAMILIES, SPLITS
from robomme_interference_data.evaluate.rows import NO_HISTORY, condition_rank
from robomme_interference_data.evaluate.score.check import BITS, STATUSES, field, pack
from robomme_interference_data.evaluate.score.columns import distinct
from robomme_interference_data.evaluate.score.grid import Grid
from robomme_interference_data.evaluate.score.rollouts import Rollouts
from robomme_interference_data.evaluate.systems import SYSTEMS
from robomme_interference_data.ids import EpisodeId, condition_name

__all__ = [
    "Expected",
    "Outcomes",
    "SUCCESS",
    "episode_id",
    "episodes_of",
    "expected_episodes",
    "families_of",
    "outcomes_of",
]

SUCCESS, ERROR = STATUSES.index("success"), STATUSES.index("error")
TEST_EPISODES = 50
_EPISODE_BITS = BITS["family"] + BITS["episode_split"] + BITS["episode"]
_EPISODE_SHIFT = BITS["model_seed"] + BITS["status"]
_SYSTEM_SHIFT = BITS["condition"] + _EPISODE_BITS + _EPISODE_SHIFT
_FAMILY_SHIFT = _EPISODE_BITS - BITS["family"]
_INDEX = 2 ** BITS["episode"]


@dataclass(frozen=True)
class Outcomes:
    """One system in one simulator: C conditions, E episodes.

    Attributes:
        simulator: Name of the simulator.
        system: Name of the system.
        conditions: Their names, in the order of tables.
        episodes: Packed family, split and index, ascending, `(E,) int64` (see `episode_id`).
        difficulty: Code of each episode, −1 unknown, `(E,) int8`.
        counts: Rollouts by condition, episode and status, `(C, E, 4) int32`; more than one where
            there are repeats with other model seeds.
        repeats: Status of the two rollouts with the lowest model seeds that count, −1 for none,
            `(2, C, E) int8`.
        lowest: Place of the lowest of these model seeds, −1 for none, `(C, E) int32`.
        packed: Rows of each condition, sorted, `(N,) uint64` (see `check`).
    """

    simulator: str
    system: str
    conditions: tuple[str, ...]
    episodes: NDArray[np.int64]
    difficulty: NDArray[np.int8]
    counts: NDArray[np.int32]
    repeats: NDArray[np.int8]
    lowest: NDArray[np.int32]
    packed: tuple[NDArray[np.uint64], ...]

    @cached_property
    def scored(self) -> NDArray[np.int64]:
        """Rollouts that count, errors left out, `(C, E) int64`."""
        return self.counts[..., :ERROR].sum(axis=-1, dtype=np.int64)

    @cached_property
    def rates(self) -> NDArray[np.float64]:
        """Mean success of the repeats, NaN where nothing counts, `(C, E) float64`."""
        with np.errstate(invalid="ignore"):
            return self.counts[..., SUCCESS] / self.scored

    @cached_property
    def whole(self) -> NDArray[np.bool_]:
        """Whether an episode counts with every model seed of the condition, `(C, E) bool`."""
        seeds = [np.count_nonzero(np.bincount(field(p, "model_seed"))) for p in self.packed]
        return self.scored == np.array(seeds)[:, None]

    @property
    def families(self) -> NDArray[np.int64]:
        """Place of each episode's family in `FAMILIES`, `(E,) int64`."""
        return families_of(self.episodes)

    def complete(self, condition: str, expected: "Expected") -> bool:
        """Whether exactly the expected episodes count, with every model seed of the condition."""
        place = self.conditions.index(condition)
        counts = self.scored[place] > 0
        exactly = np.array_equal(self.episodes[counts], expected.episodes)
        return exactly and bool(self.whole[place][counts].all())

    def filled(self, conditions: Sequence[str]) -> "Outcomes":
        """Return the same with these conditions, among them all it has: in new ones nothing ran."""
        old = [conditions.index(condition) for condition in self.conditions]
        counts = np.zeros((len(conditions), *self.counts.shape[1:]), np.int32)
        counts[old] = self.counts
        packed = dict(zip(self.conditions, self.packed, strict=True))
        parts = tuple(packed.get(condition, np.zeros(0, np.uint64)) for condition in conditions)
        repeats = np.full((2, *counts.shape[:2]), -1, np.int8)
        repeats[:, old] = self.repeats
        lowest = np.full(counts.shape[:2], -1, np.int32)
        lowest[old] = self.lowest
        return replace(
            self,
            conditions=tuple(conditions),
            counts=counts,
            repeats=repeats,
            lowest=lowest,
            packed=parts,
        )

    def column(self, condition: str, episodes: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the rates under a condition at the given packed episodes, NaN where none."""
        found = np.full(len(episodes), np.nan)
        if condition in self.conditions:
            _, there, at = np.intersect1d(
                self.episodes, episodes, assume_unique=True, return_indices=True
            )
            found[at] = self.rates[self.conditions.index(condition)][there]
        return found

    def once(self, condition: str, episodes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether just one rollout counts under a condition, at each of the episodes."""
        counts = self.scored[self.conditions.index(condition)] == 1
        return np.isin(episodes, self.episodes[counts], assume_unique=True)

    def rows(self, condition: str, episodes: NDArray[np.int64]) -> NDArray[np.uint64]:
        """Return the packed rows of some episodes under a condition, errors left out."""
        rows = self.packed[self.conditions.index(condition)]
        chosen = np.isin(episodes_of(rows), episodes) & (field(rows, "status") != ERROR)
        return rows[chosen]


def families_of(episodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the place in `FAMILIES` of each packed episode's family, `(E,) int64`."""
    return episodes >> _FAMILY_SHIFT


def episode_id(packed: int) -> EpisodeId:
    """Return the episode that a packed number stands for."""
    rest, index = divmod(int(packed), _INDEX)
    family, split = divmod(rest, 2 ** BITS["episode_split"])
    return EpisodeId(FAMILIES[family], SPLITS[split], index)


def outcomes_of(rollouts: Rollouts) -> Iterator[Outcomes]:
    """Yield the outcomes of each system, simulator by simulator, in the order of tables."""
    for code, simulator in enumerate(rollouts.simulators):
        for number, system in enumerate(rollouts.systems):
            begin = pack(simulator=code, system=number)
            end = begin | np.uint64(2**_SYSTEM_SHIFT - 1)
            start = np.searchsorted(rollouts.packed, begin)
            stop = np.searchsorted(rollouts.packed, end, side="right")
            if start < stop:
                yield _outcomes(rollouts, code, simulator, system, rollouts.packed[start:stop])


def _outcomes(
    rollouts: Rollouts, code: int, simulator: str, system: str, packed: NDArray[np.uint64]
) -> Outcomes:
    conditions, row = distinct(field(packed, "condition"))
    episodes, column = distinct(episodes_of(packed))
    status = field(packed, "status")
    shape = (len(conditions), len(episodes))
    cell = row * len(episodes) + column
    counts = np.bincount(cell * len(STATUSES) + status, minlength=shape[0] * shape[1] * 4)
    # Rows are sorted by model seed within a cell: the first two that count are the lowest seeds.
    counting = np.flatnonzero(status != ERROR)
    cell, status = cell[counting], status[counting]
    begins = np.flatnonzero(np.diff(cell, prepend=-1))
    repeats = np.full((2, shape[0] * shape[1]), -1, np.int8)
    repeats[0, cell[begins]] = status[begins]
    lowest = np.full(shape[0] * shape[1], -1, np.int32)
    lowest[cell[begins]] = field(packed[counting[begins]], "model_seed")
    again = begins[np.diff(begins, append=len(cell)) > 1]
    repeats[1, cell[again]] = status[again + 1]
    return Outcomes(
        simulator,
        system,
        tuple(NO_HISTORY if c == 0 else condition_name(int(c) - 1) for c in conditions),
        episodes,
        rollouts.difficulty_of(code, episodes),
        counts.reshape(*shape, len(STATUSES)).astype(np.int32),
        repeats.reshape(2, *shape),
        lowest.reshape(shape),
        tuple(np.split(packed, np.searchsorted(row, np.arange(1, len(conditions))))),
    )


def episodes_of(packed: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Return the packed episode of each packed row, `(N,) int64`."""
    return (packed >> np.uint64(_EPISODE_SHIFT)).astype(np.int64) & (2**_EPISODE_BITS - 1)


@dataclass(frozen=True)
class Expected:
    """The cells of one simulator, and the episodes that a complete one has.

    Attributes:
        conditions: Those that every system should have, as far as they apply to it.
        episodes: Packed, ascending, `(E,) int64`.
        difficulty: Code of each, −1 where no row tells, `(E,) int8`.
    """

    conditions: tuple[str, ...]
    episodes: NDArray[np.int64]
    difficulty: NDArray[np.int8]

    @property
    def families(self) -> NDArray[np.int64]:
        """Place of each episode's family in `FAMILIES`, `(E,) int64`."""
        return families_of(self.episodes)

    def conditions_of(self, one: Outcomes) -> list[str]:
        """Return what a system should have and what it has, in the order of tables."""
        system = SYSTEMS.get(one.system)
        due = {
            condition
            for condition in self.conditions
            if system is None
            or (system.no_history if condition == NO_HISTORY else system.with_history)
        }
        return sorted(due | set(one.conditions), key=condition_rank)


def expected_episodes(
    rollouts: Rollouts, outcomes: Sequence[Outcomes], grid: Grid
) -> dict[str, Expected]:
    """Return for each simulator the expected cells, and what a complete one has (see `Grid`)."""
    expected = {}
    for code, simulator in enumerate(rollouts.simulators):
        if grid is Grid.GIVEN:
            here = [one for one in outcomes if one.simulator == simulator]
            conditions = tuple({c: None for one in here for c in one.conditions})
            parts = [one.episodes for one in here]
            episodes = np.unique(np.concatenate([*parts, np.zeros(0, np.int64)]))
        else:
            conditions = (NO_HISTORY, *map(condition_name, DEFAULT_K))
            family, index = np.divmod(np.arange(len(FAMILIES) * TEST_EPISODES), TEST_EPISODES)
            place = family << BITS["episode_split"] | SPLITS.index("test")
            episodes = place << BITS["episode"] | index
        expected[simulator] = Expected(conditions, episodes, rollouts.difficulty_of(code, episodes))
    return expected
