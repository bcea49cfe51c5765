"""Two sides of a comparison, paired over the episodes that count on both."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robomme_interference_data.bootstrap import LEAST, Interval, paired_interval
from robomme_interference_data.evaluate.score.cube import Statuses, counting, success
from robomme_interference_data.stats import holm, mcnemar

COLUMNS = (
    "low:points high:points interval pairs:count gained:count lost:count flips:rate p:p p_holm:p"
)
"""Columns of a table of comparisons, after the difference (see `tested`)."""


@dataclass(frozen=True)
class Pairs:
    """Two sides, paired over the episodes that count on both.

    Attributes:
        n: Episodes that count on both sides.
        first: Mean success over them on the first side.
        second: The same on the second side.
        change: `second` − `first` with its interval.
        interval: Kind of that interval (see `bootstrap.paired_interval`).
        pairs: Pairs of rollouts that are tested, one an episode: of the lowest model seed that
            counts on both sides.
        gained: Pairs that succeed on the second side alone.
        lost: Pairs that succeed on the first side alone.
    """

    n: int
    first: float
    second: float
    change: Interval
    interval: str
    pairs: int
    gained: int
    lost: int

    @property
    def flips(self) -> float:
        """Share of the pairs whose outcome differs, NaN without pairs."""
        return (self.gained + self.lost) / self.pairs if self.pairs else math.nan

    @property
    def p(self) -> float:
        """Two-sided p-value of McNemar's exact test, NaN without pairs."""
        return mcnemar(self.gained, self.lost) if self.pairs else math.nan


def pair(
    first: Statuses,
    second: Statuses,
    drawn: Interval,
    matched: Sequence[tuple[int, int]] | None = None,
) -> Pairs:
    """Compare two sides over the same episodes.

    Args:
        first: Outcomes by episode and model seed, `(E, M) int8`.
        second: The same of the second side, `(E, N) int8`.
        drawn: Mean of second − first with its bootstrap interval.
        matched: Places of model seeds that are paired, of the first and the second side, in the
            order in which a pair is looked for; None for equal places.
    """
    values = np.stack([success(first), success(second)], axis=1)
    known = ~np.isnan(values).any(axis=1)
    values = values[known]
    once = all((counting(side[known]).sum(-1) == 1).all() for side in (first, second))
    change, interval = paired_interval(values, once, drawn)
    if matched is not None:
        one, other = zip(*matched, strict=True)
        first, second = first[:, one], second[:, other]
    both = counting(first) & counting(second)
    found = np.flatnonzero(both.any(-1))
    seed = both[found].argmax(-1)
    before, after = (side[found, seed] == 0 for side in (first, second))
    rates = [float(side.mean()) if len(values) else math.nan for side in values.T]
    gained, lost = int((after & ~before).sum()), int((before & ~after).sum())
    return Pairs(len(values), rates[0], rates[1], change, interval, len(found), gained, lost)


def tested(found: Sequence[Pairs]) -> list[tuple[Any, ...]]:
    """Return for each comparison of a table the difference and the values of `COLUMNS`."""
    return [
        (*one.change, one.interval, one.pairs, one.gained, one.lost, one.flips, one.p, p)
        for one, p in zip(found, holm([one.p for one in found]), strict=True)
    ]


def how_to_read(found: Iterable[Pairs]) -> str:
    """Return how a table of comparisons is to be read."""
    note = (
        "95% intervals: bca, BCa bootstrap clustered by episode, where at least "
        f"{LEAST} episodes differ; newcombe, Newcombe's paired score interval, where fewer do and "
        "each has one rollout a side; none where fewer do with repeats. pairs: one an episode, of "
        "the lowest model seed that counts on both sides; gained and lost: pairs whose outcome "
        "differs, flips: their share; p: McNemar's exact test on them; p_holm: corrected for the "
        "number of tests in this table."
    )
    if fewer := sum(one.pairs < one.n for one in found):
        note += (
            f" In {fewer} row{'s' * (fewer > 1)} the test leaves out a part of the n episodes, in "
            "which no model seed counts on both sides: difference and p are not over the same "
            "episodes."
        )
    return note
