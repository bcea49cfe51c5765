"""Statistics of success rates: intervals in closed form, and effect sizes.

Pure functions, of numbers alone. Wilson's interval is our own because SciPy's takes whole counts
only, and SciPy takes seconds to import; the tests hold it against SciPy's.
"""

import math
from statistics import NormalDist

LEVEL = 0.95
"""Of intervals, unless another is asked for."""

_NORMAL = NormalDist()


def z_of(level: float) -> float:
    """Return the quantile that an interval of a level reaches to: 1.96 of 95%, 1.64 of 90%."""
    return _NORMAL.inv_cdf((1 + level) / 2)


def wilson(successes: float, trials: float, level: float = LEVEL) -> tuple[float, float]:
    """Return the Wilson score interval of a rate; `(0, 1)` without trials.

    With z = 1.96 and p = successes / n: (p + z²/2n ± z √(p(1−p)/n + z²/4n²)) / (1 + z²/n).
    Both are fractions where episodes were repeated (see `effective_n`).

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


def effective_n(rate: float, variance: float, episodes: int, rollouts: int) -> float:
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


def mover_interval(
    rate: float,
    bounds: tuple[float, float],
    other: float,
    other_bounds: tuple[float, float],
    correlation: float = 0.0,
    limit: float = 1.0,
) -> tuple[float, float]:
    """Return the interval of rate − other from the interval of each and their correlation φ.

    Of changes in place of rates it is that of the difference of differences, whose limit is 2.

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
        max(-limit, change - added(rate - low, other_high - other)),
        min(limit, change + added(high - rate, other - other_low)),
    )


def newcombe(
    successes: float,
    trials: float,
    other_successes: float,
    other_trials: float,
    level: float = LEVEL,
) -> tuple[float, float]:
    """Return the hybrid score interval of the difference of two unpaired rates.

    `mover_interval` of their Wilson intervals; without trials on either side it is `(−1, 1)`.

    Source: Newcombe (1998), Interval estimation for the difference between independent
    proportions, Statistics in Medicine 17, 873–890, method 10.
    """
    if trials == 0 or other_trials == 0:
        return -1.0, 1.0
    sides = ((successes, trials), (other_successes, other_trials))
    (p, bounds), (q, others) = ((won / n, wilson(won, n, level)) for won, n in sides)
    return mover_interval(p, bounds, q, others)


def newcombe_paired(
    both: int, first: int, second: int, neither: int, level: float = LEVEL
) -> tuple[float, float]:
    """Return the score interval of the difference of two paired rates, first − second.

    With n pairs, `mover_interval` of the Wilson intervals of (both + first) / n and
    (both + second) / n. φ estimates the correlation: with A = both · neither − first · second it is
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
    return mover_interval(one / pairs, bounds, other / pairs, others, phi)


def fieller(
    share: float,
    whole: float,
    variances: tuple[float, float],
    covariance: float,
    level: float = LEVEL,
) -> tuple[float, float]:
    """Return Fieller's interval of the ratio share / whole of two paired means.

    It holds the ratios r for which share − r · whole is not significantly other than 0:
    (share − r · whole)² ≤ z² (v − 2 r c + r² w), with the variances v of share and w of whole and
    their covariance c. Where whole itself is not significantly other than 0, no finite interval
    does: its bounds are NaN.

    Source: Fieller (1954), Some problems in interval estimation, J. Royal Statistical Society B 16,
    175–185.

    Args:
        share: Mean of the numerator.
        whole: Mean of the denominator.
        variances: Of the two means.
        covariance: Of the two means.
        level: Of the interval.
    """
    z = z_of(level) ** 2
    # a r² − 2 b r + c ≤ 0
    a, b = whole**2 - z * variances[1], share * whole - z * covariance
    c = share**2 - z * variances[0]
    if a <= 0:
        return math.nan, math.nan
    root = math.sqrt(max(0.0, b * b - a * c))
    return (b - root) / a, (b + root) / a


def above_chance(rate: float, chance: float) -> float:
    """Return the share of what chance leaves that a rate has: 1 is all, 0 none, below 0 less.

    (rate − chance) / (1 − chance); NaN where chance leaves nothing.

    Source: Abbott's formula, J. Economic Entomology 18 (1925), 265–267.
    """
    return (rate - chance) / (1 - chance) if chance < 1 else math.nan


def cohens_h(rate: float, other: float) -> float:
    """Return Cohen's effect size for two rates, 2 arcsin √rate − 2 arcsin √other.

    About 0.2 is called small, 0.5 medium, 0.8 large.

    Source: Cohen (1988), Statistical Power Analysis for the Behavioral Sciences, chapter 6.
    """
    return 2 * math.asin(math.sqrt(rate)) - 2 * math.asin(math.sqrt(other))
