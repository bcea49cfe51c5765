"""Closed-form confidence intervals and effect sizes of success rates.

Own implementations, because SciPy's Wilson interval accepts only whole counts and importing SciPy
takes seconds. The tests compare them with SciPy's.
"""

import math
from statistics import NormalDist

from .bootstrap import Floats

LEVEL = 0.95
"""Default level of intervals."""

_NORMAL = NormalDist()


def z_of(level: float) -> float:
    """Return the normal quantile of a two-sided interval: 1.96 for 95%, 1.64 for 90%."""
    return _NORMAL.inv_cdf((1 + level) / 2)


def wilson(successes: float, trials: float, level: float = LEVEL) -> tuple[float, float]:
    """Return the Wilson score interval of a rate; `(0, 1)` without trials.

    With z = 1.96 and p = successes / n: (p + z²/2n ± z √(p(1−p)/n + z²/4n²)) / (1 + z²/n). Counts
    may be fractions (see `effective_n`).

    Source: Wilson (1927), JASA 22, 209–212; the paper uses this interval too.
    """
    if trials == 0:
        return 0.0, 1.0
    rate, z = successes / trials, z_of(level)
    middle = rate + z * z / (2 * trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    # At 0 and n the bounds are exactly 0 and 1, without rounding errors.
    low = 0.0 if successes == 0 else max(0.0, (middle - half) / scale)
    high = 1.0 if successes == trials else min(1.0, (middle + half) / scale)
    return low, high


def effective_n(rate: float, variance: float, episodes: int, rollouts: int) -> float:
    """Return the number of independent trials that a rate over repeated episodes is worth.

    With the rate p over n episodes and the sample variance s² of the episodes' means: p (1 − p) n /
    s², limited to at least the number of episodes and at most the number of rollouts.

    Source: effective sample size of cluster samples, Kish (1965), Survey Sampling, chapter 8; with
    Wilson's interval, Dean and Pagano (2015), J. Survey Statistics and Methodology 3, 484–503.
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
    """Return the interval of rate − other, from both intervals and their correlation φ.

    With rates p, q and intervals (l, u), (l', u'): p − q − √((p − l)² − 2φ (p − l)(u' − q) + (u' −
    q)²) to p − q + √((u − p)² − 2φ (u − p)(q − l') + (q − l')²), within ± `limit`, which is 2 for a
    difference of differences.

    Source: Zou and Donner (2008), Statistics in Medicine 27, 1693–1702.
    """

    def combine(a: float, b: float) -> float:
        return math.sqrt(max(0.0, a * a - 2 * correlation * a * b + b * b))

    (low, high), (other_low, other_high) = bounds, other_bounds
    change = rate - other
    return (
        max(-limit, change - combine(rate - low, other_high - other)),
        min(limit, change + combine(high - rate, other - other_low)),
    )


def newcombe(
    successes: float,
    trials: float,
    other_successes: float,
    other_trials: float,
    level: float = LEVEL,
) -> tuple[float, float]:
    """Return the interval of the difference of two unpaired rates; `(−1, 1)` without trials.

    It is the `mover_interval` of their Wilson intervals.

    Source: Newcombe (1998), Statistics in Medicine 17, 873–890, method 10.
    """
    if trials == 0 or other_trials == 0:
        return -1.0, 1.0
    sides = ((successes, trials), (other_successes, other_trials))
    (p, bounds), (q, others) = ((won / n, wilson(won, n, level)) for won, n in sides)
    return mover_interval(p, bounds, q, others)


def newcombe_paired(
    both: int, first: int, second: int, neither: int, level: float = LEVEL
) -> tuple[float, float]:
    """Return the interval of the difference of two paired rates; `(−1, 1)` without pairs.

    The counts are pairs that succeed on both sides, only the first, only the second, and neither.
    It is the `mover_interval` of the two Wilson intervals. With A = both · neither − first · second
    and n₁, n₂ successes among n pairs, φ = A / √(n₁(n − n₁) n₂(n − n₂)); a positive A is first
    reduced by n / 2, to no less than 0, and φ = 0 if the root is 0.

    Source: Newcombe (1998), Statistics in Medicine 17, 2635–2650, method 10.
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

    It contains the ratios r with (share − r · whole)² ≤ z² (v − 2 r c + r² w), for the variances v,
    w of the two means and their covariance c. If `whole` does not differ significantly from 0, the
    interval is unbounded and both bounds are NaN.

    Source: Fieller (1954), J. Royal Statistical Society B 16, 175–185.
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
    """Return (rate − chance) / (1 − chance), the gain over chance; NaN if chance is 1.

    Source: Abbott's formula, J. Economic Entomology 18 (1925), 265–267.
    """
    return (rate - chance) / (1 - chance) if chance < 1 else math.nan


def stratified_n(successes: Floats, trials: Floats, weights: Floats | None = None) -> float:
    """Return the number of independent trials that a weighted rate over fixed strata is worth.

    Strata with xᶠ of nᶠ successes and weights λᶠ (by default nᶠ / n) that sum to 1 have the rate p
    = Σ λᶠ xᶠ / nᶠ with the variance v = Σ λᶠ² p̃ᶠ (1 − p̃ᶠ) / nᶠ, p̃ᶠ = (xᶠ + 1) / (nᶠ + 2). The
    trials are p (1 − p) / v, and at least 1 / Σ (λᶠ² / nᶠ), which is n for the default weights.
    Wilson's interval then is for these strata alone. All arrays are `(F,) float64`, without empty
    strata.

    Source: effective sample size, Kish (1965), Survey Sampling, chapter 8; Wilson's interval over
    strata, Yan and Su (2010), Statistics in Biopharmaceutical Research 2, 329–335.
    """
    weights = trials / trials.sum() if weights is None else weights
    rate = float(weights @ (successes / trials))
    near = (successes + 1) / (trials + 2)
    variance = float((weights**2) @ (near * (1 - near) / trials))
    return max(1 / float((weights**2) @ (1 / trials)), rate * (1 - rate) / variance)
