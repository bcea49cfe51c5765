"""What came of every rollout in one simulator, as one array."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.conditions import (
    DEFAULT_CONDITIONS,
    NO_HISTORY,
    Condition,
    in_order,
)
from robomme_interference_data.constants import DIFFICULTIES, FAMILIES, SPLITS
from robomme_interference_data.evaluate.score import Grid
from robomme_interference_data.evaluate.score.rows import Rows
from robomme_interference_data.evaluate.systems import SYSTEMS
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.records import Status

__all__ = ["STATUSES", "Cube", "Flags", "Statuses", "counting", "cubes_of", "success"]

STATUSES = (Status.SUCCESS, Status.FAIL, Status.TIMEOUT, Status.ERROR)
"""By their numbers in a cube."""

TEST_EPISODES = 50
_SUCCESS, _ERROR = 0, 3

Statuses = NDArray[np.int8]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Cube:
    """What came of every rollout in one simulator: S systems, C conditions, E episodes, M seeds.

    Attributes:
        simulator: Name of the simulator.
        systems: Those that have rows, in the order of tables.
        conditions: Those that have rows or are expected, in the order of tables.
        episodes: Those that have rows or are expected, in the canonical order.
        model_seeds: Seeds that policies were given, ascending.
        status: Place in `STATUSES` of each rollout, −1 where there is none, `(S, C, E, M) int8`.
        difficulty: Place of each episode's in `DIFFICULTIES`, −1 unknown, `(E,) int64`.
        seed: Seed of each episode's scene, −1 unknown, `(E,) int64`.
        expected: The episodes of a complete cell, `(E,) bool`.
        due: The cells that are expected or have rows, `(S, C) bool`.
    """

    simulator: str
    systems: tuple[str, ...]
    conditions: tuple[Condition, ...]
    episodes: tuple[EpisodeId, ...]
    model_seeds: tuple[int, ...]
    status: Statuses
    difficulty: NDArray[np.int64]
    seed: NDArray[np.int64]
    expected: Flags
    due: Flags

    def cell(self, system: str, condition: str) -> tuple[int, int]:
        """Return the place of a cell on the first two axes."""
        names = [one.name for one in self.conditions]
        return self.systems.index(system), names.index(condition)

    def ran(self, system: str) -> list[str]:
        """Return the conditions under which a system has rows."""
        there = self.has_rows[self.systems.index(system)]
        return [one.name for one, has in zip(self.conditions, there, strict=True) if has]

    def of_family(self, family: str) -> Flags:
        """Whether each episode is of a family, `(E,) bool`."""
        return np.array([one.family == family for one in self.episodes], bool)

    @cached_property
    def has_rows(self) -> Flags:
        """Whether a system has rows under a condition, `(S, C) bool`."""
        return np.asarray((self.status >= 0).any(axis=(2, 3)))

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """Rollouts by status, `(S, C, E, 4) int64`."""
        return np.stack([(self.status == place).sum(-1) for place in range(len(STATUSES))], -1)

    @cached_property
    def there(self) -> Flags:
        """Whether a system has any row of an episode, `(S, E) bool`."""
        return np.asarray((self.status >= 0).any(axis=(1, 3)))

    @cached_property
    def counted(self) -> Flags:
        """Whether a rollout of the episode counts: any that is no error, `(S, C, E) bool`."""
        return np.asarray(counting(self.status).any(-1))

    @cached_property
    def whole(self) -> Flags:
        """Whether an episode counts with every model seed of its cell, `(S, C, E) bool`."""
        seeds = (self.status >= 0).any(axis=2)
        return self.counted & (counting(self.status).sum(-1) == seeds.sum(-1)[..., None])

    @cached_property
    def missing(self) -> Flags:
        """Expected episodes that do not count with every model seed, `(S, C, E) bool`."""
        return self.expected & ~self.whole

    @cached_property
    def other(self) -> Flags:
        """Episodes that count without being expected, `(S, C, E) bool`."""
        return self.counted & ~self.expected

    @cached_property
    def complete(self) -> Flags:
        """Whether exactly the expected episodes count, with every model seed, `(S, C) bool`."""
        return np.asarray(self.counted.any(-1) & ~(self.missing | self.other).any(-1))


def counting(status: Statuses) -> Flags:
    """Whether rollouts count: an error is neither success nor failure."""
    return (status >= 0) & (status < _ERROR)


def success(status: Statuses) -> NDArray[np.float64]:
    """Return the mean success of an episode's repeats, NaN where none counts.

    Args:
        status: Repeats on the last axis, `(…, M) int8`.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray((status == _SUCCESS).sum(-1) / counting(status).sum(-1))


def cubes_of(rows: Rows, grid: Grid) -> dict[str, Cube]:
    """Return simulator to the outcomes in it, by name, with the cells that are expected."""
    places = rows.places("simulator", names := rows.names("simulator"))
    return {
        name: _cube(rows.chosen(places == place), name, grid) for place, name in enumerate(names)
    }


def _cube(rows: Rows, simulator: str, grid: Grid) -> Cube:
    systems = sorted(rows.names("system"), key=_table_order)
    given = rows.names("condition")
    due = given if grid is Grid.GIVEN else DEFAULT_CONDITIONS
    conditions = in_order({*given, *due})
    model_seeds = sorted(rows.names("model_seed"))

    # An episode is a number in the canonical order.
    index = rows.numbers("episode")
    width = max(int(index.max()) + 1, TEST_EPISODES)
    group = rows.places("family", FAMILIES) * len(SPLITS) + rows.places("episode_split", SPLITS)
    number = group * width + index
    wanted = np.unique(number)
    if grid is Grid.BENCHMARK:
        group = np.arange(len(FAMILIES)) * len(SPLITS) + SPLITS.index("test")
        wanted = (group[:, None] * width + np.arange(TEST_EPISODES)).ravel()
    episodes = np.union1d(number, wanted)
    at = np.searchsorted(episodes, number)

    shape = (len(systems), len(conditions), len(episodes), len(model_seeds))
    status = np.full(shape, -1, np.int8)
    names = [one.name for one in conditions]
    axes = (rows.places("system", systems), rows.places("condition", names), at)
    status[(*axes, rows.places("model_seed", model_seeds))] = rows.places("status", STATUSES)
    known = {name: np.full(len(episodes), -1, np.int64) for name in ("difficulty", "seed")}
    for name, found in (
        ("difficulty", rows.places("difficulty", DIFFICULTIES)),
        ("seed", rows.numbers("seed")),
    ):
        known[name][at[found >= 0]] = found[found >= 0]
    applies = np.array([[_applies(s, c) and c in due for c in names] for s in systems])
    return Cube(
        simulator,
        tuple(systems),
        conditions,
        tuple(_episode(one, width) for one in episodes.tolist()),
        tuple(model_seeds),
        status,
        **known,
        expected=np.isin(episodes, wanted),
        due=applies | (status >= 0).any(axis=(2, 3)),
    )


def _episode(number: int, width: int) -> EpisodeId:
    group, index = divmod(number, width)
    family, split = divmod(group, len(SPLITS))
    return EpisodeId(FAMILIES[family], SPLITS[split], index)


def _table_order(system: str) -> tuple[int, str]:
    known = list(SYSTEMS)
    return (known.index(system) if system in SYSTEMS else len(known), system)


def _applies(system: str, condition: str) -> bool:
    found = SYSTEMS.get(system)
    if found is None:
        return True
    return found.no_history if condition == NO_HISTORY else found.with_history
