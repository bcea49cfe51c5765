"""Statistics of success rates: intervals in closed form, exact tests, corrections.

Pure functions, of numbers alone. Wilson's interval is our own because SciPy's takes whole counts
only, and the exact test because whole numbers of Python give it to the last digit without SciPy,
which takes seconds to import; the tests hold both against SciPy's.
"""

import math
from collections.abc import Sequence

_Z = 1.959963984540054  # the 97.5% quantile of the standard normal distribution


def wilson(successes: float, trials: int) -> tuple[float, float]:
    """Return the Wilson score interval of a rate at 95%; `(0, 1)` without trials.

    With z = 1.96 and p = successes / n: (p + z²/2n ± z √(p(1−p)/n + z²/4n²)) / (1 + z²/n).
    Successes are a fraction where an episode was repeated and counts by the mean of its repeats.

    Source: Wilson (1927), Probable inference, the law of succession, and statistical inference,
    JASA 22, 209–212; the paper's own intervals are these.
    """
    if trials == 0:
        return 0.0, 1.0
    rate, z = successes / trials, _Z
    middle = rate + z * z / (2 * trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    # At 0 and n the bounds are exactly 0 and 1; rounding would leave them just beside.
    low = 0.0 if successes == 0 else max(0.0, (middle - half) / scale)
    high = 1.0 if successes == trials else min(1.0, (middle + half) / scale)
    return low, high


def newcombe(
    successes: float, trials: int, other_successes: float, other_trials: int
) -> tuple[float, float]:
    """Return the 95% hybrid score interval of the difference of two unpaired rates.

    With rates p, q and their Wilson intervals (l, u), (l', u'):
    (p − q) − √((p − l)² + (u' − q)²) to (p − q) + √((u − p)² + (q − l')²).

    Without trials on either side the interval is `(−1, 1)`.

    Source: Newcombe (1998), Interval estimation for the difference between independent
    proportions, Statistics in Medicine 17, 873–890, method 10.
    """
    if trials == 0 or other_trials == 0:
        return -1.0, 1.0
    rate, other = successes / trials, other_successes / other_trials
    low, high = wilson(successes, trials)
    other_low, other_high = wilson(other_successes, other_trials)
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
        first: On the first side alone.
        second: On the second side alone.
        neither: On neither. Without any pair the interval is `(−1, 1)`.
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

    change = (first - second) / pairs
    return (
        max(-1.0, change - added(rate - low, other_high - other_rate)),
        min(1.0, change + added(high - rate, other_rate - other_low)),
    )


def mcnemar(gained: int, lost: int) -> float:
    """Return the two-sided p-value of the exact McNemar test.

    With n = gained + lost discordant pairs and m the smaller count, under the null hypothesis
    either way is equally likely: p = min(1, 2 · P(X ≤ m)), X ~ Binomial(n, ½). Pairs that agree
    do not enter. Without discordant pairs p is 1.

    Source: McNemar (1947), Psychometrika 12, 153–157, in its exact binomial form.
    """
    pairs = gained + lost
    ways = total = 1  # of choosing i of the pairs, and of choosing up to i
    for i in range(min(gained, lost)):
        ways = ways * (pairs - i) // (i + 1)
        total += ways
    return min(1.0, 2 * total / 2**pairs)


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
