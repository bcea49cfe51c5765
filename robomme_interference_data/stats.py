"""Statistics of success rates: intervals in closed form, exact tests, corrections.

Pure functions, of numbers alone. Wilson's interval is our own because SciPy's takes whole counts
only, and the exact test because whole numbers of Python give it to the last digit without SciPy,
which takes seconds to import; the tests hold both against SciPy's.
"""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import reduce
from statistics import NormalDist

import numpy as np

LEVEL = 0.95
"""Of intervals, unless another is asked for."""

SURE = 0.05
"""Below this p something is taken as found."""

_NORMAL = NormalDist()
_LATTICE = 840  # divided by every number up to 8: means of so many repeats lie on it exactly


def z_of(level: float) -> float:
    """Return the quantile that an interval of a level reaches to: 1.96 of 95%, 1.64 of 90%."""
    return _NORMAL.inv_cdf((1 + level) / 2)


def wilson(successes: float, trials: float, level: float = LEVEL) -> tuple[float, float]:
    """Return the Wilson score interval of a rate; `(0, 1)` without trials.

    With z = 1.96 and p = successes / n: (p + z²/2n ± z √(p(1−p)/n + z²/4n²)) / (1 + z²/n).
    Both are fractions where episodes were repeated (see `effective`).

    Source: Wilson (1927), Probable inference, the law of succession, and statistical inference,
    JASA 22, 209–212; the paper's own intervals are these.
    """
    if trials == 0:
        return 0.0, 1.0
    rate, z = successes / trials, z_of(level)
    middle = rate + z * z / (2 * trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    # At 0 and n the bounds are exactly 0 and 1; rounding would leave them just beside.
    low = 0.0 if successes == 0 else max(0.0, (middle - half) / scale)
    high = 1.0 if successes == trials else min(1.0, (middle + half) / scale)
    return low, high


def effective(rate: float, variance: float, episodes: int, rollouts: int) -> float:
    """Return how many independent trials a rate of repeated episodes is worth.

    The rate p is the mean over n episodes, its variance s² / n with s² of the episodes' means: a
    sample of p (1 − p) n / s² trials has the same. It is at least the number of episodes, as if
    all repeats of one agreed, and at most that of rollouts, as if they had nothing in common.

    Source: the effective sample size of cluster samples, Kish (1965), Survey Sampling, chapter 8;
    for Wilson's interval, Dean and Pagano (2015), J. Survey Statistics and Methodology 3, 484–503.

    Args:
        rate: Mean over episodes of the means of their repeats.
        variance: Of these means, with n − 1 in the denominator.
        episodes: Number of episodes, n.
        rollouts: Number of rollouts.
    """
    if variance <= 0:
        return episodes
    return min(rollouts, max(episodes, rate * (1 - rate) * episodes / variance))


def combined(
    rate: float,
    bounds: tuple[float, float],
    other: float,
    other_bounds: tuple[float, float],
    correlation: float = 0.0,
) -> tuple[float, float]:
    """Return the interval of rate − other from the interval of each and their correlation φ.

    With rates p, q and intervals (l, u), (l', u'):
    p − q − √((p − l)² − 2φ (p − l)(u' − q) + (u' − q)²) to
    p − q + √((u − p)² − 2φ (u − p)(q − l') + (q − l')²).

    Source: Newcombe's method 10 in both papers below; of any two intervals, Zou and Donner (2008),
    Construction of confidence limits about effect measures, Statistics in Medicine 27, 1693–1702.
    """

    def added(a: float, b: float) -> float:
        return math.sqrt(max(0.0, a * a - 2 * correlation * a * b + b * b))

    (low, high), (other_low, other_high) = bounds, other_bounds
    change = rate - other
    return (
        max(-1.0, change - added(rate - low, other_high - other)),
        min(1.0, change + added(high - rate, other - other_low)),
    )


def newcombe(
    successes: float,
    trials: float,
    other_successes: float,
    other_trials: float,
    level: float = LEVEL,
) -> tuple[float, float]:
    """Return the hybrid score interval of the difference of two unpaired rates.

    `combined` of their Wilson intervals; without trials on either side it is `(−1, 1)`.

    Source: Newcombe (1998), Interval estimation for the difference between independent
    proportions, Statistics in Medicine 17, 873–890, method 10.
    """
    if trials == 0 or other_trials == 0:
        return -1.0, 1.0
    sides = ((successes, trials), (other_successes, other_trials))
    (p, bounds), (q, others) = ((won / n, wilson(won, n, level)) for won, n in sides)
    return combined(p, bounds, q, others)


def newcombe_paired(
    both: int, first: int, second: int, neither: int, level: float = LEVEL
) -> tuple[float, float]:
    """Return the score interval of the difference of two paired rates, first − second.

    With n pairs, `combined` of the Wilson intervals of (both + first) / n and (both + second) / n.
    φ estimates the correlation: with A = both · neither − first · second it is
    A / √(n₁(n − n₁) n₂(n − n₂)), n₁ and n₂ the successes of the two sides, where a positive A is
    first lowered by n / 2, to no less than 0; φ is 0 where a factor of the root is.

    Source: Newcombe (1998), Improved confidence intervals for the difference between binomial
    proportions based on paired data, Statistics in Medicine 17, 2635–2650, method 10.

    Args:
        both: Pairs that succeed on both sides.
        first: On the first side alone.
        second: On the second side alone.
        neither: On neither. Without any pair the interval is `(−1, 1)`.
        level: Of the interval.
    """
    pairs = both + first + second + neither
    if pairs == 0:
        return -1.0, 1.0
    one, other = both + first, both + second
    product = one * (pairs - one) * other * (pairs - other)
    joint: float = both * neither - first * second
    joint = max(0.0, joint - pairs / 2) if joint > 0 else joint
    phi = joint / math.sqrt(product) if product else 0.0
    bounds, others = wilson(one, pairs, level), wilson(other, pairs, level)
    return combined(one / pairs, bounds, other / pairs, others, phi)


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


def sign_flip(differences: Iterable[float]) -> tuple[float, float]:
    """Return the two-sided p-value of the exact sign-flip test of paired means, and its mid-p.

    Under the null hypothesis each difference d is as likely its opposite. Of the 2ⁿ ways to give
    the n differences their signs, p is the share of those whose sum is as far from 0 as the
    observed one, or farther; the mid-p counts those that are as far by half, and is 1 where the
    observed sum is 0. Of differences of single rollouts, −1, 0 and 1, it is McNemar's exact test.

    Exact for means of up to eight repeats a side; of more they are rounded to 1/840.

    Source: Fisher (1935), The Design of Experiments, section 21; Edgington and Onghena (2007),
    Randomization Tests, chapter 6.
    """
    steps = [round(_LATTICE * one) for one in differences]
    unit = reduce(math.gcd, steps, 0) or 1
    sizes = Counter(abs(one) // unit for one in steps)
    observed = abs(sum(steps)) // unit
    if not observed:
        return 1.0, 1.0
    if sizes.keys() <= {0, 1}:
        return mcnemar((sizes[1] + observed) // 2, (sizes[1] - observed) // 2)
    chances = np.ones(1)  # of each sum, from the least to the most, in steps of two units
    for size, count in sizes.items():
        for _ in range(count * (size > 0)):
            spread = np.zeros(len(chances) + size)
            spread[:-size] = chances / 2
            spread[size:] += chances / 2
            chances = spread
    # A sum that is `observed` or more: so many of the last.
    last = (len(chances) - 1 - observed) // 2 + 1
    tail = chances[len(chances) - last :]
    return min(1.0, 2 * float(tail.sum())), min(1.0, float(2 * tail.sum() - tail[0]))


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


def cohens_h(rate: float, other: float) -> float:
    """Return Cohen's effect size for two rates, 2 arcsin √rate − 2 arcsin √other.

    About 0.2 is called small, 0.5 medium, 0.8 large.

    Source: Cohen (1988), Statistical Power Analysis for the Behavioral Sciences, chapter 6.
    """
    return 2 * math.asin(math.sqrt(rate)) - 2 * math.asin(math.sqrt(other))
