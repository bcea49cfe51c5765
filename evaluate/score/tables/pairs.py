"""Two sides of a comparison, paired over the episodes that count on both."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import (
    Statuses,
    SuccessRate,
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
from robomme_interference_data.stats.signs import SignFlips

WITHIN = 0.90
"""Level of the interval that equivalence uses: two one-sided tests at 5%."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """Two sides of a comparison, paired over the episodes that count on both.

    Offline, the action error takes the place of success.
    """

    n: int  # episodes that count on both sides; of unpaired sides the fewer
    first: float  # mean success over them on the first side
    second: float
    at: Callable[[float], Interval]  # second − first, with its interval of any level
    method: str  # of interval and p: `newcombe`, with repeats `clusters`, `unpaired`, `sign-flip`
    pairs: int  # pairs of rollouts, one per episode: of the lowest shared model seed
    gained: int  # pairs that succeed on the second side alone
    lost: int  # pairs that succeed on the first side alone
    p: float  # two-sided: McNemar's or sign-flip; unpaired, of two proportions

    @cached_property
    def change(self) -> Interval:
        """The difference second − first, with its 95% interval."""
        return self.at(LEVEL)

    @cached_property
    def within(self) -> Interval:
        """The difference second − first, with its 90% interval."""
        return self.at(WITHIN)

    @property
    def paired(self) -> bool:
        """Whether both sides had the same histories."""
        return self.method != "unpaired"

    @property
    def flips(self) -> float:
        """Share of the pairs whose outcome differs, NaN without pairs."""
        return (self.gained + self.lost) / self.pairs if self.pairs else math.nan


NO_PAIRS = Pairs(
    n=0,
    first=math.nan,
    second=math.nan,
    at=lambda level: Interval(math.nan),
    method="",
    pairs=0,
    gained=0,
    lost=0,
    p=math.nan,
)
"""The comparison over no episode."""


def pair(
    first: Statuses, second: Statuses, matched: Sequence[tuple[int, int]] | None = None
) -> Pairs:
    """Compare two sides over the same episodes: outcomes by episode and model seed, `(E, M) int8`.

    `matched` lists the places of paired model seeds on both sides, in order of preference; by
    default seeds at equal places are paired.
    """
    before, after = success(first), success(second)
    known = ~np.isnan(before + after)
    before, after, first, second = before[known], after[known], first[known], second[known]
    n = len(before)
    # As many rollouts as episodes: no repeats.
    if n == counting(first).sum() == counting(second).sum():
        return _of_single(before, after)
    at = partial(_clusters, first, second)  # over all repeats; `matched` is for gained and lost
    if matched is not None:
        first_seeds, second_seeds = zip(*matched, strict=True)
        first, second = first[:, first_seeds], second[:, second_seeds]
    both = counting(first) & counting(second)
    episodes = np.flatnonzero(both.any(-1))
    seed = both[episodes].argmax(-1)
    old, new = (side[episodes, seed] == 0 for side in (first, second))
    return Pairs(
        n=n,
        first=float(before.mean()),
        second=float(after.mean()),
        at=at,
        method="clusters",
        pairs=len(episodes),
        gained=int((new & ~old).sum()),
        lost=int((old & ~new).sum()),
        p=sign_flip(after - before),
    )


def _of_single(before: Floats, after: Floats) -> Pairs:
    """Compare single rollouts: success is 0 or 1 in each episode, so four counts suffice."""
    n = len(before)
    if not n:
        return NO_PAIRS
    won_before, won_after, both = int(before.sum()), int(after.sum()), int(before @ after)
    gained, lost = won_after - both, won_before - both
    neither = n - both - gained - lost
    change = round((won_after - won_before) / n, 12)

    def at(level: float) -> Interval:
        return Interval(change, *newcombe_paired(both, gained, lost, neither, level))

    return Pairs(
        n=n,
        first=won_before / n,
        second=won_after / n,
        at=at,
        method="newcombe",
        pairs=n,
        gained=gained,
        lost=lost,
        p=mcnemar(gained, lost),
    )


def _clusters(first: Statuses, second: Statuses, level: float) -> Interval:
    """Return second − first with the interval of means of repeats."""
    values = [success(side) for side in (first, second)]
    before, after = (float(side.mean()) for side in values)
    spread = float(values[0].std() * values[1].std())
    phi = (float((values[0] * values[1]).mean()) - before * after) / spread if spread else 0.0
    trials = [rate_of(side).trials for side in (first, second)]
    old, new = (wilson(r * m, m, level) for r, m in zip((before, after), trials, strict=True))
    return Interval(round(after - before, 12), *mover_interval(after, new, before, old, phi))


def pair_errors(before: Floats, after: Floats, test: SignFlips) -> Pairs:
    """Compare the action errors of two sides by episode, `(E,)`, NaN where one is unknown.

    `test` is the sign-flip test of `after - before`. A lower error is better, so an episode is
    gained if its error falls.
    """
    known = ~np.isnan(before + after)
    n = int(known.sum())
    if not n:
        return NO_PAIRS
    return Pairs(
        n=n,
        first=float(before[known].mean()),
        second=float(after[known].mean()),
        at=test.at,
        method="sign-flip",
        pairs=n,
        gained=int((after < before).sum()),
        lost=int((after > before).sum()),
        p=test.p,
    )


def compare_unpaired(first: SuccessRate, second: SuccessRate) -> Pairs:
    """Compare two sides that cannot be paired."""
    counts = (second.value * second.trials, second.trials, first.value * first.trials, first.trials)
    change = round(second.value - first.value, 12)

    def at(level: float) -> Interval:
        return Interval(change, *newcombe(*counts, level))

    return Pairs(
        n=min(first.n, second.n),
        first=first.value,
        second=second.value,
        at=at,
        method="unpaired",
        pairs=0,
        gained=0,
        lost=0,
        p=two_proportions(*counts),
    )
