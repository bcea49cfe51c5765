"""The outcomes of all rollouts in one simulator, or along recordings, as arrays."""

import math
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.stats.bootstrap import Interval
from robomme_interference_data.stats.intervals import LEVEL, effective_n, wilson
from robomme_interference_data.stats.runs import ONE_RUN, RunSpread, run_spread

STATUSES = (Status.SUCCESS, Status.FAIL, Status.TIMEOUT, Status.ERROR, Status.MEASURED)
"""In the order of their numbers in `Outcomes.status`."""

TEST_EPISODES = 50
_SUCCESS, ERROR = 0, 3
"""Numbers in `Outcomes.status`."""

Statuses = NDArray[np.int8]
Flags = NDArray[np.bool_]


class Repeat(NamedTuple):
    """A rollout of an episode among others: the weights, and the draws with these."""

    training_seed: int | None  # None if unknown
    model_seed: int


@dataclass(frozen=True)
class Outcomes:
    """The outcomes in one simulator: S systems, C conditions, E episodes, M repeats."""

    simulator: str
    systems: tuple[str, ...]  # with rows, in the order of tables
    conditions: tuple[str, ...]  # with rows or expected, in the order of tables
    episodes: tuple[EpisodeId, ...]  # with rows or expected, in canonical order
    repeats: tuple[Repeat, ...]  # ascending, an unknown training seed first
    status: Statuses  # index into STATUSES, −1 without a rollout, (S, C, E, M) int8
    evidence: NDArray[np.float64]  # share of the evidence kept, NaN if unknown, (S, C, E, M)
    action_l1: NDArray[np.float64]  # action error offline, NaN if not measured, (S, C, E, M)
    difficulty: NDArray[np.int64]  # index into DIFFICULTIES, −1 if unknown, (E,)
    ability: NDArray[np.int64]  # index into ABILITIES, −1 if unknown or of no day, (E,)
    chance: NDArray[np.float64]  # success of guessing, NaN unless a question, (E,)
    expected: Flags  # the episodes of a complete cell, (E,)
    in_tables: Flags  # the cells that are expected or have rows, (S, C)
    without_revision: Flags  # systems whose rows name no revision of a buffer set, (S,)
    facts: tuple[frozenset[SystemFacts], ...]  # of each system; only `policy_id` varies, (S,)
    seeds_repeat: bool = True  # whether another model seed repeats an episode in the same scene

    def cell(self, system: str, condition: str) -> tuple[int, int]:
        """Return the place of a cell on the first two axes."""
        return self.systems.index(system), self.conditions.index(condition)

    def facts_of(self, system: str) -> frozenset[SystemFacts]:
        """Return the facts of a system: several if it has runs of different weights."""
        return self.facts[self.systems.index(system)]

    def is_reference(self, system: str) -> bool:
        """Whether a system is only a reference, which is never ranked."""
        return any(facts.reference for facts in self.facts_of(system))

    @cached_property
    def training(self) -> NDArray[np.int64]:
        """The number of each repeat's training run, `(M,)`; an unknown seed is a run."""
        seeds = [repeat.training_seed for repeat in self.repeats]
        places = {seed: place for place, seed in enumerate(dict.fromkeys(seeds))}
        return np.array([places[seed] for seed in seeds])

    @property
    def retrieving(self) -> list[str]:
        """The systems with a retrieval step."""
        return [
            name
            for name, of_system in zip(self.systems, self.facts, strict=True)
            if any(facts.retrieval is not None for facts in of_system)
        ]

    def ran(self, system: str) -> list[str]:
        """Return the conditions under which a system has rows."""
        has_rows = self.has_rows[self.systems.index(system)]
        return [condition for condition, has in zip(self.conditions, has_rows, strict=True) if has]

    def lacks_revision(self, system: str) -> bool:
        """Whether the rows of a system name no revision of a buffer set."""
        return bool(self.without_revision[self.systems.index(system)])

    def pairable(self, system: str, other: str) -> bool:
        """Whether two systems had the same histories: both name a revision, or they are one."""
        return system == other or not (self.lacks_revision(system) or self.lacks_revision(other))

    @cached_property
    def families(self) -> tuple[str, ...]:
        """The families of the episodes, in canonical order."""
        return tuple(dict.fromkeys(episode.family for episode in self.episodes))

    @cached_property
    def family(self) -> NDArray[np.int64]:
        """The place in `families` of each episode's family, `(E,) int64`."""
        places = {name: place for place, name in enumerate(self.families)}
        return np.array([places[episode.family] for episode in self.episodes])

    def of_family(self, family: str) -> Flags:
        """Whether each episode is of a family, `(E,) bool`."""
        return np.array([episode.family == family for episode in self.episodes], bool)

    def episodes_of(self, flags: Flags) -> list[EpisodeId]:
        """Return the episodes of some flags, `(E,) bool`, in the canonical order."""
        return [self.episodes[place] for place in np.flatnonzero(flags).tolist()]

    @cached_property
    def has_rows(self) -> Flags:
        """Whether a system has rows under a condition, `(S, C) bool`."""
        return np.asarray((self.status >= 0).any(axis=(2, 3)))

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """Rollouts by status, `(S, C, E, len(STATUSES)) int64`."""
        return np.stack([(self.status == place).sum(-1) for place in range(len(STATUSES))], -1)

    @cached_property
    def has_episode(self) -> Flags:
        """Whether a system has any row of an episode, `(S, E) bool`."""
        return np.asarray((self.status >= 0).any(axis=(1, 3)))

    @cached_property
    def counted(self) -> Flags:
        """Whether any rollout of the episode is not an error, `(S, C, E) bool`."""
        return np.asarray(counting(self.status).any(-1))

    @cached_property
    def missing(self) -> Flags:
        """Expected episodes that do not count with every seed of the cell, `(S, C, E) bool`."""
        # The repeats of a cell: each expected episode needs a rollout of each of them.
        seeds = (self.status >= 0).any(axis=2).sum(-1)[..., None]
        return self.expected & (~self.counted | (counting(self.status).sum(-1) < seeds))

    @cached_property
    def unexpected(self) -> Flags:
        """Episodes that count without being expected, `(S, C, E) bool`."""
        return self.counted & ~self.expected

    @cached_property
    def complete(self) -> Flags:
        """Whether exactly the expected episodes count, with every model seed, `(S, C) bool`."""
        return np.asarray(self.counted.any(-1) & ~(self.missing | self.unexpected).any(-1))

    @cached_property
    def repeat_flips(self) -> tuple[int, int]:
        """The number of repeated rollouts, and of those whose outcome flips.

        Repeats have the same weights, and differ in the model seed; the two lowest of an episode
        that count are compared.
        """
        if not self.seeds_repeat:
            return 0, 0
        pairs = flips = 0
        for run in range(int(self.training.max()) + 1):
            status = self.status[..., self.training == run]
            counts = counting(status)
            order = counts.cumsum(axis=-1) * counts  # 1 for the lowest model seed that counts, …
            first, second = (((order == n) & (status == _SUCCESS)).any(axis=-1) for n in (1, 2))
            repeated = (order == 2).any(axis=-1)
            pairs += int(repeated.sum())
            flips += int((first != second)[repeated].sum())
        return pairs, flips

    def with_errors_as(self, status: Status) -> "Outcomes":
        """Return the outcomes as if every error had another status."""
        return replace(self, status=errors_as(self.status, status))


def counting(status: Statuses) -> Flags:
    """Whether rollouts count: an error is neither success nor failure."""
    return (status >= 0) & (status != ERROR)


def success(status: Statuses) -> NDArray[np.float64]:
    """Return the mean success of an episode's repeats, the last axis, NaN where none counts."""
    with np.errstate(invalid="ignore"):
        return np.asarray((status == _SUCCESS).sum(-1) / counting(status).sum(-1))


def errors_as(status: Statuses, other: Status) -> Statuses:
    """Return statuses, of any shape, with another one instead of each error."""
    return np.where(status == ERROR, np.int8(STATUSES.index(other)), status)


def success_by_run(status: Statuses, training: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the mean success of each training run's repeats, `(…, R)`, NaN where none counts.

    `status` has the repeats as its last axis, `training` the number of each one's run. Only runs
    with a rollout that counts are returned, and at least one.
    """
    counts = counting(status)
    ran = np.unique(training[counts.any(axis=tuple(range(counts.ndim - 1)))])
    by_run = [success(status[..., training == run]) for run in ran.tolist()]
    return np.stack(by_run or [np.full(status.shape[:-1], np.nan)], axis=-1)


def mean_errors(action_l1: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean action error of an episode's repeats, the last axis, NaN without any."""
    known = ~np.isnan(action_l1)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(known, action_l1, 0).sum(-1) / known.sum(-1))


class SuccessRate(NamedTuple):
    """A success rate."""

    n: int  # episodes that count
    value: float  # mean of their success, NaN if there are none
    trials: float  # effective number of independent trials: n, and more with repeats
    spread: RunSpread = ONE_RUN  # over training runs

    @property
    def interval(self) -> tuple[float, float]:
        """Its 95% Wilson interval, widened by training runs; `(0, 1)` without episodes."""
        if not self.n:
            return 0.0, 1.0
        bounds = wilson(self.value * self.trials, self.trials)
        _, low, high = self.spread.widen(Interval(self.value, *bounds), LEVEL, (0.0, 1.0))
        return low, high


def rate_of(status: Statuses, training: NDArray[np.int64] | None = None) -> SuccessRate:
    """Return the rate of rollouts, `(E, M) int8`; `training` is the run of each repeat, `(M,)`.

    Without it, all repeats have the same weights.
    """
    spread = ONE_RUN
    if training is not None and training.any():
        spread = run_spread(success_by_run(status, training))
    won, of = (status == _SUCCESS).sum(-1), counting(status).sum(-1)
    won, of = won[of > 0], of[of > 0]
    n, counts = len(of), np.unique(of).tolist()
    if not n:
        return SuccessRate(0, math.nan, 0)
    # Exact, so that systems with equal means of repeats share a rank.
    value = float(sum(Fraction(int(won[of == count].sum()), count) for count in counts) / n)
    rates = won / of
    if n < 2:
        return SuccessRate(n, value, n, spread)
    variance = float(rates.var(ddof=1))
    trials = effective_n(float(rates.mean()), variance, n, int(of.sum()))
    return SuccessRate(n, value, trials, spread)
