"""What a paired comparison of two cells rests on: pairs of rollouts, and an interval."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.bootstrap import LEAST, Interval, enough
from robomme_interference_data.evaluate.score.check import field
from robomme_interference_data.evaluate.score.outcomes import SUCCESS, Outcomes, episodes_of
from robomme_interference_data.evaluate.score.statistics import mcnemar
from robomme_interference_data.intervals import newcombe_paired
from robomme_interference_data.tables import Column

__all__ = ["COLUMNS", "Pairs", "Side", "Tested", "interval_of", "note_of", "pairs_of", "tested"]

COLUMNS = (
    *(Column("low", "points"), Column("high", "points"), Column("interval")),
    *(Column("pairs", "count"), Column("gained", "count"), Column("lost", "count")),
    *(Column("flips", "rate"), Column("p", "p"), Column("p_holm", "p")),
)
"""Columns of a table of paired comparisons, after the difference."""

_NOTE = (
    f"95% intervals: bca, BCa bootstrap clustered by episode, where at least {LEAST} episodes "
    "differ; newcombe, Newcombe's paired score interval, where fewer do and each has one rollout "
    "a side; none where fewer do with repeats. pairs: one an episode, of the lowest model seed "
    "that counts on both sides; gained and lost: pairs whose outcome differs, flips: their share; "
    "p: McNemar's exact test on them; p_holm: corrected for the number of tests in this table."
)


@dataclass(frozen=True)
class Side:
    """One of two cells that are compared.

    Attributes:
        outcomes: Its system.
        condition: Its condition.
        seeds: A number for each model seed of its rows, ascending, by which seeds of different
            runs are matched; None for their places.
    """

    outcomes: Outcomes
    condition: str
    seeds: NDArray[np.int64] | None = None

    def lowest(self, episodes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the lowest seed that counts in each of the system's episodes, −1 for none.

        Returns:
            Its number, and whether that rollout succeeded.
        """
        row = self.outcomes.conditions.index(self.condition)
        at = np.searchsorted(self.outcomes.episodes, episodes)
        places = self.outcomes.lowest[row, at].astype(np.int64)
        success = self.outcomes.repeats[0, row, at] == SUCCESS
        return np.where(places >= 0, self._numbers(places), -1), success

    def rollouts(self, episodes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return all that count: episode and seed in one ascending number, and the success."""
        rows = self.outcomes.rows(self.condition, episodes)
        numbers = self._numbers(field(rows, "model_seed"))
        return episodes_of(rows) << 32 | numbers, field(rows, "status") == SUCCESS

    def _numbers(self, places: NDArray[np.int64]) -> NDArray[np.int64]:
        return places if self.seeds is None else self.seeds[places]


@dataclass(frozen=True)
class Pairs:
    """One pair of rollouts an episode.

    Attributes:
        episodes: Packed, ascending, `(P,) int64`.
        first: Whether it succeeded on the first side, `(P,) bool`.
        second: The same on the second side.
    """

    episodes: NDArray[np.int64]
    first: NDArray[np.bool_]
    second: NDArray[np.bool_]


@dataclass(frozen=True)
class Tested:
    """What McNemar's exact test says.

    Attributes:
        pairs: Number of pairs.
        gained: Pairs that succeed on the second side alone.
        lost: Pairs that succeed on the first side alone.
    """

    pairs: int
    gained: int
    lost: int

    @property
    def flips(self) -> float:
        """Share of the pairs whose outcome differs, NaN without pairs."""
        return (self.gained + self.lost) / self.pairs if self.pairs else math.nan

    @property
    def p(self) -> float:
        """Two-sided p-value, NaN without pairs."""
        return mcnemar(self.gained, self.lost) if self.pairs else math.nan


def pairs_of(first: Side, second: Side) -> Pairs:
    """Pair rollouts, in each episode those of the lowest model seed that counts on both sides."""
    sides = (first, second)
    episodes = np.intersect1d(first.outcomes.episodes, second.outcomes.episodes, assume_unique=True)
    (seeds, here), (others, there) = (side.lowest(episodes) for side in sides)
    paired = (seeds >= 0) & (seeds == others)
    # Seldom, the lowest that counts is another one on each side.
    rest = (seeds >= 0) & (others >= 0) & ~paired
    if rest.any():
        (keys, one), (other_keys, other) = (side.rollouts(episodes[rest]) for side in sides)
        shared, at, other_at = np.intersect1d(
            keys, other_keys, assume_unique=True, return_indices=True
        )
        found = np.flatnonzero(np.diff(shared >> 32, prepend=-1))
        places = np.searchsorted(episodes, shared[found] >> 32)
        paired[places] = True
        here[places], there[places] = one[at[found]], other[other_at[found]]
    return Pairs(episodes[paired], here[paired], there[paired])


def tested(pairs: Pairs, chosen: NDArray[np.bool_] | None = None) -> Tested:
    """Count pairs, or those of a part of the episodes: `chosen`, `(P,) bool`."""
    every = np.ones(len(pairs.episodes), bool) if chosen is None else chosen
    gained, lost = pairs.second & ~pairs.first, pairs.first & ~pairs.second
    return Tested(int(every.sum()), int((gained & every).sum()), int((lost & every).sum()))


def interval_of(values: NDArray[np.float64], once: bool, drawn: Interval) -> tuple[Interval, str]:
    """Return the difference of two sides with the interval that its data bear, and its kind.

    `bca` where at least ten episodes differ (see `bootstrap.enough`); with fewer, `newcombe`
    where every episode has one rollout a side, as that interval is made for pairs of single
    outcomes; else there is none: bounds are NaN and the kind is empty.

    Args:
        values: Success of the first and the second side, in the episodes that count on both,
            `(E, 2) float64`.
        once: Whether every one of these episodes has one rollout that counts on each side.
        drawn: Mean of second − first with its bootstrap interval.
    """
    first, second = values.T
    if enough(second - first) and drawn.low < drawn.high:
        return drawn, "bca"
    if not once or not len(values):
        return Interval(drawn.value, math.nan, math.nan), ""
    both, one = int((first * second).sum()), int(second.sum())
    other = int(first.sum())
    bounds = newcombe_paired(both, one - both, other - both, len(values) - one - other + both)
    return Interval(drawn.value, *bounds), "newcombe"


def note_of(counts: list[tuple[int, int]]) -> str:
    """Return how a table of paired comparisons is to be read.

    Args:
        counts: Of each row the episodes of its difference, and the pairs that are tested.
    """
    fewer = sum(pairs < n for n, pairs in counts)
    if not fewer:
        return _NOTE
    rows = "1 row" if fewer == 1 else f"{fewer} rows"
    return (
        f"{_NOTE} In {rows} the test leaves out a part of the n episodes, in which no model seed "
        "counts on both sides: difference and p are not over the same episodes."
    )
