"""Confidence intervals of rates, in closed form."""

import math

__all__ = ["Z95", "newcombe", "wilson"]

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
