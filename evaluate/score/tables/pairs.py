"""Two sides of a comparison, paired over the episodes that count on both."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.evaluate.score.outcomes import (
    ERROR,
    Flags,
    Statuses,
    SuccessRate,
    counting,
    errors_as,
    rate_of,
    success,
    success_by_run,
)
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.stats.bootstrap import Floats, Interval
from robomme_interference_data.stats.intervals import (
    LEVEL,
    mover_interval,
    newcombe,
    newcombe_paired,
    wilson,
)
from robomme_interference_data.stats.runs import ONE_RUN, RunSpread, independent, run_spread
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
    pairs: int  # pairs of rollouts, one per episode: of the lowest repeat that both sides have
    gained: int  # pairs that succeed on the second side alone
    lost: int  # pairs that succeed on the first side alone
    p: float  # two-sided: McNemar's or sign-flip; unpaired, of two proportions
    spread: RunSpread = ONE_RUN  # of the difference over training runs, which `at` and `p` hold
    if_failures: "Pairs | None" = None  # the same if every error were a failure; None without any
    if_successes: "Pairs | None" = None  # … a success

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


def compare_cells(
    first: Statuses,
    second: Statuses,
    training: NDArray[np.int64],
    *,
    same_weights: bool,
    paired: bool = True,
) -> Pairs:
    """Compare two sides, with training runs and errors.

    Args:
        first: Statuses by episode and repeat, `(E, M) int8`.
        second: The same of the other side.
        training: The training run of each repeat, `(M,)`.
        same_weights: Whether equal runs of both sides have the same weights, so that only runs of
            both sides are compared, and none without a common run. Otherwise the runs of one side
            have nothing in common with those of the other.
        paired: Whether both sides had the same histories.
    """
    if same_weights and training.any():
        shared = shared_runs([first, second], training)
        if not shared.any():
            return NO_PAIRS
        first, second, training = first[:, shared], second[:, shared], training[shared]
    compare = partial(_with_runs, training=training, same_weights=same_weights, paired=paired)
    compared = compare(first, second)
    if (first == ERROR).any() or (second == ERROR).any():
        failures, successes = (
            compare(errors_as(first, status), errors_as(second, status))
            for status in (Status.FAIL, Status.SUCCESS)
        )
        compared = replace(compared, if_failures=failures, if_successes=successes)
    return compared


def shared_runs(sides: Sequence[Statuses], training: NDArray[np.int64]) -> Flags:
    """Return which repeats, `(M,)`, are of training runs that count on all sides.

    Sides are `(E, M) int8`.
    """
    ran = [{*training[counting(side).any(axis=0)].tolist()} for side in sides]
    shared = set.intersection(*ran)
    return np.array([run in shared for run in training.tolist()])


def _with_runs(
    first: Statuses,
    second: Statuses,
    training: NDArray[np.int64],
    *,
    same_weights: bool,
    paired: bool,
) -> Pairs:
    compared = pair(first, second) if paired else compare_unpaired(rate_of(first), rate_of(second))
    if not training.any():
        return compared
    before, after = (success_by_run(side, training) for side in (first, second))
    if same_weights and before.shape == after.shape:
        spread = run_spread(after - before)
    else:
        spread = independent(run_spread(before), run_spread(after))
    return add_runs(compared, spread)


def add_runs(pairs: Pairs, spread: RunSpread) -> Pairs:
    """Return a comparison over fixed training runs with the runs as a random effect."""

    def at(level: float) -> Interval:
        return spread.widen(pairs.at(level), level)

    return replace(pairs, at=at, p=spread.p(pairs.at, pairs.p), spread=spread)


def pair(first: Statuses, second: Statuses) -> Pairs:
    """Compare two sides over the same episodes: outcomes by episode and repeat, `(E, M) int8`.

    Repeats at equal places are pairs. All repeats have the same weights, or weights that are fixed.
    """
    before, after = success(first), success(second)
    known = ~np.isnan(before + after)
    before, after, first, second = before[known], after[known], first[known], second[known]
    n = len(before)
    # As many rollouts as episodes: no repeats.
    if n == counting(first).sum() == counting(second).sum():
        return _of_single(before, after)
    at = _clusters(first, second)
    both = counting(first) & counting(second)
    if not both.any():  # no repeat in common, such as other seeds: each side's lowest
        first, second = _lowest(first), _lowest(second)
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


def _lowest(status: Statuses) -> Statuses:
    """Return the status of each episode's lowest repeat that counts, `(E, 1)`."""
    lowest = counting(status).argmax(-1)
    return np.asarray(np.take_along_axis(status, lowest[:, None], axis=-1))


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


def _clusters(first: Statuses, second: Statuses) -> Callable[[float], Interval]:
    """Return second − first with the intervals of means of repeats, by level."""
    values = [success(side) for side in (first, second)]
    before, after = (float(side.mean()) for side in values)
    spread = float(values[0].std() * values[1].std())
    phi = (float((values[0] * values[1]).mean()) - before * after) / spread if spread else 0.0
    trials = [rate_of(side).trials for side in (first, second)]

    def at(level: float) -> Interval:
        sides = zip((before, after), trials, strict=True)
        old, new = (wilson(rate * m, m, level) for rate, m in sides)
        return Interval(round(after - before, 12), *mover_interval(after, new, before, old, phi))

    return at


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
