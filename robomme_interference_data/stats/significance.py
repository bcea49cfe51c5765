"""Tests of success rates, and their correction for multiple comparisons.

Own implementations, because Python's integers give exact tests without importing SciPy, which takes
seconds. The tests compare them with SciPy's.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .bootstrap import Floats, Interval
from .intervals import LEVEL, mover_interval, stratified_n, wilson

ALPHA = 0.05
"""Significance level."""

_LATTICE = 27720  # divisible by every number up to 12: exact for means of so many repeats
_STEPS = 20  # exact for means of 4 or 5 repeats


def mcnemar(gained: int, lost: int) -> float:
    """Return the two-sided p-value of the exact McNemar test.

    With n = gained + lost discordant pairs and m the smaller count: p = min(1, 2 · P(X ≤ m)) for X
    ~ Binomial(n, ½), or 1 without such pairs. The test is conservative.

    Source: McNemar (1947), Psychometrika 12, 153–157.
    """
    pairs = gained + lost
    ways = total = 1  # to choose i of the pairs, and up to i
    for i in range(min(gained, lost)):
        ways = ways * (pairs - i) // (i + 1)
        total += ways
    return min(1.0, 2 * total / 2**pairs)


def sign_flip(differences: NDArray[np.float64]) -> float:
    """Return the two-sided p-value of the exact sign-flip test of paired means.

    Of the 2ⁿ ways to assign signs to the n differences, `(E,) float64`, p is the share whose sum is
    at least as far from 0 as the observed one. For single rollouts this is McNemar's exact test.

    The differences are multiples of a common step. If the largest exceeds twenty steps, they are
    rounded to twentieths; the test stays exact for these.

    Source: Fisher (1935), The Design of Experiments, section 21; Edgington and Onghena (2007),
    Randomization Tests, chapter 6.
    """
    steps = np.rint(_LATTICE * differences).astype(np.int64)
    steps //= max(1, int(np.gcd.reduce(steps)))
    if np.abs(steps).max(initial=0) > _STEPS:
        steps = np.rint(_STEPS * differences).astype(np.int64)
        steps //= max(1, int(np.gcd.reduce(steps)))
    observed, counts = abs(int(steps.sum())), np.bincount(np.abs(steps))
    if not observed:
        return 1.0
    if len(counts) == 2:
        ones = int(counts[1])
        return mcnemar((ones + observed) // 2, (ones - observed) // 2)
    # The probability of each sum, from the smallest, in units of two steps.
    chances: NDArray[np.float64] = np.ones(1)
    for size in np.flatnonzero(counts[1:]) + 1:
        factor = np.zeros(int(size * counts[size]) + 1)
        factor[:: int(size)] = _heads(int(counts[size]))
        chances = np.convolve(chances, factor).astype(np.float64)
    # The number of sums that are `observed` or more.
    last = (len(chances) - 1 - observed) // 2 + 1
    tail = chances[len(chances) - last :]
    return min(1.0, 2 * float(tail.sum()))


@lru_cache(maxsize=1024)
def _heads(coins: int) -> NDArray[np.float64]:
    """Return the probabilities of 0 to all heads for a number of coins."""
    return np.array([math.comb(coins, heads) / 2**coins for heads in range(coins + 1)])


def poisson_binomial(successes: int, chances: Sequence[float]) -> float:
    """Return the one-sided p-value of so many successes or more, given each trial's chance.

    P(i successes) is the coefficient of xⁱ in Π (1 − c + c x) over the chances c. All terms are
    positive, so small p-values are accurate.

    Source: Hong (2013), Computational Statistics and Data Analysis 59, 41–51.
    """
    counts: NDArray[np.float64] = np.ones(1)  # by number of successes
    for chance in chances:
        counts = np.convolve(counts, (1 - chance, chance)).astype(np.float64)
    return min(1.0, float(counts[successes:].sum()))


def two_proportions(
    successes: float, trials: float, other_successes: float, other_trials: float
) -> float:
    """Return the two-sided p-value of the test of two unpaired rates; NaN without trials.

    With the pooled rate p: z = (p₁ − p₂) / √(p (1 − p)(1/n₁ + 1/n₂)), standard normal. p is 1 if
    all trials have the same outcome.

    Source: Pearson's χ² test of a 2 × 2 table, without correction.
    """
    if trials == 0 or other_trials == 0:
        return math.nan
    pooled = (successes + other_successes) / (trials + other_trials)
    spread = math.sqrt(pooled * (1 - pooled) * (1 / trials + 1 / other_trials))
    if spread == 0:
        return 1.0
    return math.erfc(abs(successes / trials - other_successes / other_trials) / spread / 2**0.5)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted by Holm's step-down method, in the same order.

    Sorted in ascending order, p(i) becomes max over j ≤ i of min(1, (m − j + 1) · p(j)) for m
    p-values. NaN means not tested; it stays and does not count.

    Source: Holm (1979), Scandinavian Journal of Statistics 6, 65–70.
    """
    known = [index for index, p in enumerate(p_values) if not math.isnan(p)]
    adjusted, largest = [math.nan] * len(p_values), 0.0
    for place, index in enumerate(sorted(known, key=lambda index: p_values[index])):
        largest = max(largest, min(1.0, (len(known) - place) * p_values[index]))
        adjusted[index] = largest
    return adjusted


class Stratified(NamedTuple):
    """Two unpaired sides compared within strata.

    Attributes:
        strata: The number of strata with trials on both sides; no other stratum contributes.
        first: The weighted rate of the first side; NaN without strata.
        second: That of the second side.
        change: second − first, with its interval.
        p: Two-sided p-value of no difference in any stratum.
    """

    strata: int
    first: float
    second: float
    change: Interval
    p: float


def mantel_haenszel(successes: Floats, trials: Floats, level: float = LEVEL) -> Stratified:
    """Compare two unpaired sides within strata: successes and trials, `(2, F) float64`.

    A stratum of n₁ and n₂ trials weighs n₁ n₂ / (n₁ + n₂), so one with trials on a single side
    weighs nothing. The difference is the weighted mean of the strata's own ones; its interval is
    the `mover_interval` of Wilson's intervals of the two weighted rates with `stratified_n`. The
    test is that of Cochran, Mantel and Haenszel without continuity correction: z = Σ n₁ n₂ (p₂ −
    p₁) / N over √(Σ n₁ n₂ p (1 − p) / (N − 1)), with N = n₁ + n₂ and the pooled rate p of each
    stratum. p is 1 if no stratum has both outcomes.

    Source: Mantel and Haenszel (1959), JNCI 22, 719–748; the interval: Yan and Su (2010),
    Statistics in Biopharmaceutical Research 2, 329–335.
    """
    both = (trials > 0).all(axis=0)
    won, of = successes[:, both], trials[:, both]
    strata = int(both.sum())
    if not strata:
        return Stratified(0, math.nan, math.nan, Interval(math.nan), math.nan)
    total = of.sum(axis=0)
    sizes = of.prod(axis=0) / total
    weights = sizes / sizes.sum()
    rates = [float(weights @ side) for side in won / of]
    effective = [stratified_n(*side, weights) for side in zip(won, of, strict=True)]
    bounds = [wilson(rate * n, n, level) for rate, n in zip(rates, effective, strict=True)]
    (first, second), pooled = rates, won.sum(axis=0) / total
    interval = mover_interval(second, bounds[1], first, bounds[0])
    spread = math.sqrt(float((of.prod(axis=0) / (total - 1)) @ (pooled * (1 - pooled))))
    change = round(second - first, 12)
    z = change * float(sizes.sum()) / spread if spread else 0.0
    return Stratified(
        strata, first, second, Interval(change, *interval), math.erfc(abs(z) / math.sqrt(2))
    )
