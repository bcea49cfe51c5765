"""Confidence intervals of rates, in closed form."""

import math

__all__ = ["Z95", "newcombe", "newcombe_paired", "wilson"]

Z95 = 1.959963984540054
"""The 97.5% quantile of the standard normal distribution."""


def wilson(successes: float, trials: int, z: float = Z95) -> tuple[float, float]:
    """Return the Wilson score interval of a rate, by default at 95%; `(0, 1)` without trials.

    With p = successes / n: (p + z²/2n ± z √(p(1−p)/n + z²/4n²)) / (1 + z²/n).

    Source: Wilson (1927), Probable inference, the law of succession, and statistical inference,
    JASA 22, 209–212; the paper's own intervals are these.

    Args:
        successes: How many succeeded; a fraction where an episode was repeated and counts by the
            mean of its repeats.
        trials: How many there were.
        z: Quantile of the standard normal distribution.
    """
    if trials == 0:
        return 0.0, 1.0
    rate = successes / trials
    middle = rate + z * z / (2 * trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    # At 0 and n the bounds are exactly 0 and 1; rounding would leave them just beside.
    low = 0.0 if successes == 0 else max(0.0, (middle - half) / scale)
    high = 1.0 if successes == trials else min(1.0, (middle + half) / scale)
    return low, high


def newcombe(
    successes: float, trials: int, other_successes: float, other_trials: int, z: float = Z95
) -> tuple[float, float]:
    """Return the hybrid score interval of the difference of two unpaired rates, first − second.

    With rates p, q and their Wilson intervals (l, u), (l', u'):
    (p − q) − √((p − l)² + (u' − q)²) to (p − q) + √((u − p)² + (q − l')²).

    Source: Newcombe (1998), Interval estimation for the difference between independent
    proportions, Statistics in Medicine 17, 873–890, method 10. Without trials on either side the
    interval is `(−1, 1)`.
    """
    if trials == 0 or other_trials == 0:
        return -1.0, 1.0
    rate, other = successes / trials, other_successes / other_trials
    low, high = wilson(successes, trials, z)
    other_low, other_high = wilson(other_successes, other_trials, z)
    return (
        rate - other - math.hypot(rate - low, other_high - other),
        rate - other + math.hypot(high - rate, other - other_low),
    )


def newcombe_paired(both: int, first: int, second: int, neither: int) -> tuple[float, float]:
    """Return the 95% score interval of the difference of two paired rates, first − second.

    With n pairs, rates p = (both + first) / n and q = (both + second) / n and their Wilson
    intervals (l, u), (l', u'): p − q − √((p − l)² − 2φ (p − l)(u' − q) + (u' − q)²) to
    p − q + √((u − p)² − 2φ (u − p)(q − l') + (q − l')²). φ estimates the correlation: with
    A = both · neither − first · second it is A / √(n₁(n − n₁) n₂(n − n₂)), n₁ and n₂ the successes
    of the two sides, where a positive A is first lowered by n / 2, to no less than 0; φ is 0 where
    a factor of the root is.

    Source: Newcombe (1998), Improved confidence intervals for the difference between binomial
    proportions based on paired data, Statistics in Medicine 17, 2635–2650, method 10.

    Args:
        both: Pairs that succeed on both sides.
        first: Pairs that succeed on the first side alone.
        second: Pairs that succeed on the second side alone.
        neither: Pairs that succeed on neither. Without any pair the interval is `(−1, 1)`.
    """
    pairs = both + first + second + neither
    if pairs == 0:
        return -1.0, 1.0
    one, other = both + first, both + second
    rate, other_rate = one / pairs, other / pairs
    low, high = wilson(one, pairs)
    other_low, other_high = wilson(other, pairs)
    product = one * (pairs - one) * other * (pairs - other)
    joint: float = both * neither - first * second
    joint = max(0.0, joint - pairs / 2) if joint > 0 else joint
    phi = joint / math.sqrt(product) if product else 0.0

    def added(a: float, b: float) -> float:
        return math.sqrt(max(0.0, a * a - 2 * phi * a * b + b * b))

    difference = (first - second) / pairs
    return (
        max(-1.0, difference - added(rate - low, other_high - other_rate)),
        min(1.0, difference + added(high - rate, other_rate - other_low)),
    )
