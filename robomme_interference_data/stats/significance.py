"""Tests of success rates, and their correction for being many. Pure functions, of numbers alone.

The exact tests are our own because whole numbers of Python give them to the last digit without
SciPy, which takes seconds to import; the tests hold them against SciPy's.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

ALPHA = 0.05
"""Below this p something is taken as found."""

_LATTICE = 27720  # divided by every number up to 12: means of so many repeats lie on it exactly
_STEPS = 20  # of five repeats and of four of them, where one broke


def mcnemar(gained: int, lost: int) -> tuple[float, float]:
    """Return the two-sided p-value of the exact McNemar test, and its mid-p.

    With n = gained + lost discordant pairs and m the smaller count, under the null hypothesis
    either way is equally likely: p = min(1, 2 · P(X ≤ m)), X ~ Binomial(n, ½). Pairs that agree
    do not enter. Without discordant pairs p is 1. The exact test rejects less often than its level
    says; the mid-p, p − P(X = m), or 1 where as many are gained as lost, about as often.

    Source: McNemar (1947), Psychometrika 12, 153–157, in its exact binomial form; mid-p: Fagerland,
    Lydersen and Laake (2013), BMC Medical Research Methodology 13, 91.
    """
    pairs = gained + lost
    ways = total = 1  # of choosing i of the pairs, and of choosing up to i
    for i in range(min(gained, lost)):
        ways = ways * (pairs - i) // (i + 1)
        total += ways
    if gained == lost:
        return 1.0, 1.0
    return min(1.0, 2 * total / 2**pairs), min(1.0, (2 * total - ways) / 2**pairs)


def sign_flip(differences: NDArray[np.float64]) -> tuple[float, float]:
    """Return the two-sided p-value of the exact sign-flip test of paired means, and its mid-p.

    Under the null hypothesis each difference d is as likely its opposite. Of the 2ⁿ ways to give
    the n differences their signs, p is the share of those whose sum is as far from 0 as the
    observed one, or farther; the mid-p counts those that are as far by half, and is 1 where the
    observed sum is 0. Of differences of single rollouts, −1, 0 and 1, it is McNemar's exact test.

    The differences are whole numbers of some common step. Where the largest is more than twenty
    such steps, as of many repeats, they are rounded to twentieths: as exact a test, of
    slightly other numbers.

    Source: Fisher (1935), The Design of Experiments, section 21; Edgington and Onghena (2007),
    Randomization Tests, chapter 6.

    Args:
        differences: Of the episodes' means, `(E,) float64`.
    """
    steps = np.rint(_LATTICE * differences).astype(np.int64)
    steps //= max(1, int(np.gcd.reduce(steps)))
    if np.abs(steps).max(initial=0) > _STEPS:
        steps = np.rint(_STEPS * differences).astype(np.int64)
        steps //= max(1, int(np.gcd.reduce(steps)))
    observed, counts = abs(int(steps.sum())), np.bincount(np.abs(steps))
    if not observed:
        return 1.0, 1.0
    if len(counts) == 2:
        ones = int(counts[1])
        return mcnemar((ones + observed) // 2, (ones - observed) // 2)
    # Of each sum, from the least to the most, in twice the step.
    chances: NDArray[np.float64] = np.ones(1)
    for size in np.flatnonzero(counts[1:]) + 1:
        own = np.zeros(int(size * counts[size]) + 1)
        own[:: int(size)] = _heads(int(counts[size]))
        chances = np.convolve(chances, own).astype(np.float64)
    # A sum that is `observed` or more: so many of the last.
    last = (len(chances) - 1 - observed) // 2 + 1
    tail = chances[len(chances) - last :]
    return min(1.0, 2 * float(tail.sum())), min(1.0, float(2 * tail.sum() - tail[0]))


@lru_cache(maxsize=1024)
def _heads(coins: int) -> NDArray[np.float64]:
    """Return the chances of 0 to all heads of some coins."""
    return np.array([math.comb(coins, heads) / 2**coins for heads in range(coins + 1)])


def poisson_binomial(successes: int, chances: Sequence[float]) -> float:
    """Return the one-sided p-value of so many successes or more, if each came by its own chance.

    The number of successes of independent trials with chances c is Poisson-binomial: the chance of
    i of them is the coefficient of xⁱ in Π (1 − c + c x), which is multiplied out. All terms are
    positive, so small p-values have all their digits.

    Source: Hong (2013), On computing the distribution function for the Poisson binomial
    distribution, Computational Statistics and Data Analysis 59, 41–51.

    Args:
        successes: Observed successes.
        chances: Of each trial, from 0 to 1.
    """
    counts: NDArray[np.float64] = np.ones(1)  # of each number of successes, from none
    for chance in chances:
        counts = np.convolve(counts, (1 - chance, chance)).astype(np.float64)
    return min(1.0, float(counts[successes:].sum()))


def two_proportions(
    successes: float, trials: float, other_successes: float, other_trials: float
) -> float:
    """Return the two-sided p-value of the test of two unpaired rates; NaN without trials.

    With the rate p of both together: z = (p₁ − p₂) / √(p (1 − p)(1/n₁ + 1/n₂)), normal. Where all
    trials came out alike p is 1.

    Source: Pearson's χ² test of a fourfold table, without correction.
    """
    if trials == 0 or other_trials == 0:
        return math.nan
    pooled = (successes + other_successes) / (trials + other_trials)
    spread = math.sqrt(pooled * (1 - pooled) * (1 / trials + 1 / other_trials))
    if spread == 0:
        return 1.0
    return math.erfc(abs(successes / trials - other_successes / other_trials) / spread / 2**0.5)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for their number by Holm's step-down method, in the same order.

    Sorted upwards, p(i) becomes max over j ≤ i of min(1, (m − j + 1) · p(j)), with m p-values.
    NaN, where there was nothing to test, stays and is no test.

    Source: Holm (1979), A simple sequentially rejective multiple test procedure, Scandinavian
    Journal of Statistics 6, 65–70.
    """
    known = [index for index, p in enumerate(p_values) if not math.isnan(p)]
    adjusted, largest = [math.nan] * len(p_values), 0.0
    for place, index in enumerate(sorted(known, key=lambda index: p_values[index])):
        largest = max(largest, min(1.0, (len(known) - place) * p_values[index]))
        adjusted[index] = largest
    return adjusted
