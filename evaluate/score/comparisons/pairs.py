"""Two sides of a comparison, paired over the episodes that count on both."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import (
    Rate,
    Statuses,
    counting,
    rate_of,
    success,
)
from robomme_interference_data.stats.bootstrap import Floats, Interval
from robomme_interference_data.stats.intervals import (
    LEVEL,
    mover_interval,
    newcombe,
    newcombe_paired,
    wilson,
)
from robomme_interference_data.stats.significance import mcnemar, sign_flip, two_proportions

WITHIN = 0.90
"""Level of the interval that lies within a margin where two one-sided tests at 5% say so."""


@dataclass(frozen=True)
class Pairs:
    """Two sides, paired over the episodes that count on both.

    Attributes:
        n: Episodes that count on both sides; of unpaired sides the fewer.
        first: Mean success over them on the first side.
        second: The same on the second side.
        change: `second` − `first` with its 95% interval.
        within: The same with its 90% interval.
        interval: Kind of these intervals: `newcombe` of single rollouts, `clusters` with repeats,
            `unpaired`; empty without an episode.
        pairs: Pairs of rollouts, one an episode: of the lowest model seed that counts on both
            sides; none of unpaired sides.
        gained: Pairs that succeed on the second side alone.
        lost: Pairs that succeed on the first side alone.
        p: Two-sided p-value of the exact sign-flip test on the episodes' means, which of single
            rollouts is McNemar's; of unpaired sides that of two proportions. NaN without episodes.
        p_mid: Its mid-p; NaN of unpaired sides.
    """

    n: int
    first: float
    second: float
    change: Interval
    within: Interval
    interval: str
    pairs: int
    gained: int
    lost: int
    p: float
    p_mid: float

    @property
    def paired(self) -> bool:
        """Whether both sides had the same histories."""
        return self.interval != "unpaired"

    @property
    def flips(self) -> float:
        """Share of the pairs whose outcome differs, NaN without pairs."""
        return (self.gained + self.lost) / self.pairs if self.pairs else math.nan


NO_PAIRS = Pairs(
    *(0, math.nan, math.nan, Interval(math.nan), Interval(math.nan), "", 0, 0, 0),
    *(math.nan, math.nan),
)
"""What comes of no episode."""


def pair(
    first: Statuses, second: Statuses, matched: Sequence[tuple[int, int]] | None = None
) -> Pairs:
    """Compare two sides over the same episodes.

    Args:
        first: Outcomes by episode and model seed, `(E, M) int8`.
        second: The same of the second side, `(E, N) int8`.
        matched: Places of model seeds that are paired, of the first and the second side, in the
            order in which a pair is looked for; None for equal places.
    """
    before, after = success(first), success(second)
    known = ~np.isnan(before + after)
    before, after, first, second = before[known], after[known], first[known], second[known]
    n = len(before)
    if n == counting(first).sum() == counting(second).sum():
        return _of_single(before, after)
    change, within = (_clusters(first, second, level) for level in (LEVEL, WITHIN))
    tests = sign_flip(after - before)
    rate, other_rate = float(before.mean()), float(after.mean())
    if matched is not None:
        one, other = zip(*matched, strict=True)
        first, second = first[:, one], second[:, other]
    both = counting(first) & counting(second)
    found = np.flatnonzero(both.any(-1))
    seed = both[found].argmax(-1)
    old, new = (side[found, seed] == 0 for side in (first, second))
    gained, lost = int((new & ~old).sum()), int((old & ~new).sum())
    counts = (len(found), gained, lost)
    return Pairs(n, rate, other_rate, change, within, "clusters", *counts, *tests)


def _of_single(before: Floats, after: Floats) -> Pairs:
    """Compare single rollouts, success 0 or 1 in each episode: four counts say it all."""
    n = len(before)
    if not n:
        return NO_PAIRS
    one, other, both = (int(part) for part in (before.sum(), after.sum(), before @ after))
    gained, lost = other - both, one - both
    gap, neither = round((other - one) / n, 12), n - both - gained - lost
    change, within = (
        Interval(gap, *newcombe_paired(both, gained, lost, neither, level))
        for level in (LEVEL, WITHIN)
    )
    counts = (n, gained, lost)
    return Pairs(
        *(n, one / n, other / n), change, within, "newcombe", *counts, *mcnemar(gained, lost)
    )


def _clusters(first: Statuses, second: Statuses, level: float) -> Interval:
    """Return second − first with the interval of means of repeats."""
    values = [success(side) for side in (first, second)]
    before, after = (float(side.mean()) for side in values)
    spread = float(values[0].std() * values[1].std())
    phi = (float((values[0] * values[1]).mean()) - before * after) / spread if spread else 0.0
    worth = [rate_of(side).trials for side in (first, second)]
    old, new = (wilson(r * m, m, level) for r, m in zip((before, after), worth, strict=True))
    return Interval(round(after - before, 12), *mover_interval(after, new, before, old, phi))


def compare_unpaired(first: Rate, second: Rate) -> Pairs:
    """Compare two sides that cannot be paired."""
    won = second.value * second.trials, first.value * first.trials
    counts = (won[0], second.trials, won[1], first.trials)
    gap, p = round(second.value - first.value, 12), two_proportions(*counts)
    change, within = (Interval(gap, *newcombe(*counts, level)) for level in (LEVEL, WITHIN))
    n, rates = min(first.n, second.n), (first.value, second.value)
    return Pairs(n, *rates, change, within, "unpaired", 0, 0, 0, p, math.nan)
