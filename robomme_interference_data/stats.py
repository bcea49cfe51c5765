"""Statistics of success rates: intervals, exact tests, corrections, and the paired bootstrap.

Pure functions, of numbers alone. Wilson's interval is our own because SciPy's takes whole counts
only, and the exact test because whole numbers of Python give it to the last digit without SciPy,
which takes seconds to import; the tests hold both against SciPy's.
"""

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Z95", "newcombe", "newcombe_paired", "wilson"]  # intervals in closed form
__all__ += ["cohens_h", "holm", "mcnemar", "slope_weights"]  # tests and effect sizes
__all__ += ["DRAWS", "LEAST", "Interval", "Resampler", "Statistic", "enough", "paired_interval"]
__all__ += ["difference", "mean", "retention", "slope"]  # statistics of a bootstrap

Floats = NDArray[np.float64]

Z95 = 1.959963984540054
"""The 97.5% quantile of the standard normal distribution."""

DRAWS = 10_000
"""Bootstrap samples."""

LEAST = 10
"""So many episodes must stand out for a paired comparison to have a bootstrap interval."""

_CHUNK = 2**15  # numbers at a time: they stay in the cache, and BLAS starts no threads for them
_NORMAL = NormalDist()


# --- intervals in closed form ------------------------------------------------------------------


def wilson(successes: float, trials: int) -> tuple[float, float]:
    """Return the Wilson score interval of a rate at 95%; `(0, 1)` without trials.

    With z = 1.96 and p = successes / n: (p + z²/2n ± z √(p(1−p)/n + z²/4n²)) / (1 + z²/n).

    Source: Wilson (1927), Probable inference, the law of succession, and statistical inference,
    JASA 22, 209–212; the paper's own intervals are these.

    Args:
        successes: How many succeeded; a fraction where an episode was repeated and counts by the
            mean of its repeats.
        trials: How many there were.
    """
    if trials == 0:
        return 0.0, 1.0
    rate, z = successes / trials, Z95
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

    change = (first - second) / pairs
    return (
        max(-1.0, change - added(rate - low, other_high - other_rate)),
        min(1.0, change + added(high - rate, other_rate - other_low)),
    )


# --- tests and effect sizes --------------------------------------------------------------------


def mcnemar(gained: int, lost: int) -> float:
    """Return the two-sided p-value of the exact McNemar test.

    With n = gained + lost discordant pairs and m the smaller count, under the null hypothesis
    either way is equally likely: p = min(1, 2 · P(X ≤ m)), X ~ Binomial(n, ½). Pairs that agree
    do not enter. Without discordant pairs p is 1.

    Source: McNemar (1947), Psychometrika 12, 153–157, in its exact binomial form.

    Args:
        gained: Episodes that fail under the first condition and succeed under the second.
        lost: Episodes that succeed under the first and fail under the second.
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


def slope_weights(ks: Sequence[int]) -> Floats:
    """Return the weights by which rates at these k add up to the log-linear slope, `(K,) float64`.

    The slope b is that of the least-squares line rate = a + b · log₂(k + 1): k + 1 is the number
    of sessions in the buffer, the lesson included, so b is the change of the success rate with
    each doubling of the history's sessions. With x = log₂(k + 1): b = Σ (x − x̄) rate / Σ (x − x̄)².
    Every condition weighs the same, as all run the same episodes.

    Source: ordinary least squares; the logarithm is our choice, after the paper's k 0, 1, 3, 7,
    which doubles the sessions from one condition to the next.

    Args:
        ks: At least two different k.
    """
    x = np.log2(np.asarray(ks, float) + 1)
    centred = x - x.mean()
    return centred / (centred**2).sum()


# --- bootstrap ---------------------------------------------------------------------------------


class Interval(NamedTuple):
    """An estimate with its interval; bounds are NaN where they cannot be had."""

    value: float
    low: float = math.nan
    high: float = math.nan


@dataclass(frozen=True)
class Statistic:
    """Something computed from the means of some columns, over the episodes that have all of them.

    Attributes:
        columns: Places of the columns.
        combine: From their means, `(D, M) float64`, to the statistic, `(D,) float64`.
    """

    columns: tuple[int, ...]
    combine: Callable[[Floats], Floats]

    def features(self, values: Floats) -> Floats:
        """Return what is summed over episodes: the columns and a one, `(E, M + 1) float64`."""
        chosen = values[:, list(self.columns)]
        chosen = np.concatenate([chosen, np.ones((len(chosen), 1))], axis=1)
        chosen[np.isnan(chosen).any(axis=1)] = 0.0
        return chosen

    def of(self, sums: Floats) -> Floats:
        """Return the statistic of sums, rounded: what is exactly equal is so on any machine."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.combine(sums[:, :-1] / sums[:, -1:]).round(12)


def mean(column: int) -> Statistic:
    """Return the mean of a column."""
    return Statistic((column,), lambda m: m[:, 0])


def difference(first: int, second: int) -> Statistic:
    """Return mean of column `second` − mean of column `first`."""
    return Statistic((first, second), lambda m: m[:, 1] - m[:, 0])


def retention(none: int, start: int, end: int) -> Statistic:
    """Return (end − none) / (start − none): what is left of the lift at the start.

    1 if nothing is lost, 0 if the end is back at the rate without history.
    """
    return Statistic((none, start, end), lambda m: (m[:, 2] - m[:, 0]) / (m[:, 1] - m[:, 0]))


def slope(columns: Sequence[int], weights: Floats) -> Statistic:
    """Return the weighted sum of the columns' means (see `slope_weights`)."""
    return Statistic(tuple(columns), lambda m: m @ weights)


def enough(values: Floats) -> bool:
    """Whether what each episode adds to a comparison varies enough for a bootstrap interval.

    At least `LEAST` episodes must have another value than the commonest one, which for a paired
    difference is most often 0. With fewer, the resampled means fall on a coarse lattice, and
    intervals cover less than they promise, down to width zero where all episodes agree.

    Args:
        values: A number for each episode, `(E,) float64`.
    """
    _, counts = np.unique(values.round(12), return_counts=True)
    return len(values) - int(counts.max(initial=0)) >= LEAST


def paired_interval(values: Floats, once: bool, drawn: Interval) -> tuple[Interval, str]:
    """Return the difference of two sides with the interval that its data bear, and its kind.

    `bca` where at least ten episodes differ (see `enough`); with fewer, `newcombe` where every
    episode has one rollout a side, as that interval is made for pairs of single outcomes; else
    there is none: bounds are NaN and the kind is empty.

    Args:
        values: Success of the first and the second side, in the episodes that count on both,
            `(E, 2) float64`.
        once: Whether every one of these episodes has one rollout that counts on each side.
        drawn: Mean of second − first with its bootstrap interval.
    """
    first, second = values.T
    if enough(second - first) and drawn.low < drawn.high:
        return drawn, "bca"
    if not once or not len(values):
        return Interval(drawn.value), ""
    both, one, other = (int(part.sum()) for part in (first * second, second, first))
    bounds = newcombe_paired(both, one - both, other - both, len(values) - one - other + both)
    return Interval(drawn.value, *bounds), "newcombe"


class Resampler:
    """Draws episodes with replacement, each with all its conditions and repeats.

    The episode is the cluster: its outcomes under all conditions, repeats among them as a mean,
    are drawn together, so what episodes have in common never counts as evidence twice.

    Args:
        values: A row per episode, a column per condition, NaN for what is missing,
            `(E, C) float64`.
        key: Text that seeds the draws. The same key, values and order of episodes give the same
            intervals, whatever else is computed.
        draws: Number of bootstrap samples.
    """

    def __init__(self, values: Floats, key: str, draws: int = DRAWS):
        self._values, self._key, self._draws = values, key, draws

    def intervals(self, statistics: Sequence[Statistic]) -> list[Interval]:
        """Return each statistic with its 95% BCa interval, all from the same draws.

        The bounds are the quantiles α₁ and α₂ of the draws, with
        α = Φ(z₀ + (z₀ + z) / (1 − a (z₀ + z))) for z = ∓1.96: z₀ = Φ⁻¹ of the share of draws
        below the estimate, ties counting half; a = Σ dᵢ³ / 6 (Σ dᵢ²)^1.5 with dᵢ the mean of all
        leave-one-episode-out estimates minus the i-th.

        Source: Efron (1987), Better bootstrap confidence intervals, JASA 82, 171–185; Efron and
        Tibshirani (1993), An Introduction to the Bootstrap, chapter 14. Draws in which a ratio has
        no value (a zero denominator) are left out. Where the correction itself has no value, as
        when all draws lie on one side of the estimate, the bounds are the plain percentiles. One
        episode alone has no interval: its bounds are NaN.
        """
        if not len(self._values) or not statistics:
            return [Interval(math.nan) for _ in statistics]
        features = [statistic.features(self._values) for statistic in statistics]
        # Statistics share most of what they sum: each column is summed once.
        columns, place = np.unique(np.concatenate(features, axis=1), axis=1, return_inverse=True)
        drawn = _drawn(self._key, len(self._values), self._draws)
        step = max(1, _CHUNK // len(self._values))
        sums = np.concatenate(
            [drawn[at : at + step].astype(float) @ columns for at in range(0, self._draws, step)]
        )
        ends = np.cumsum([feature.shape[1] for feature in features])[:-1]
        return [
            _interval(statistic, feature, statistic.of(sums[:, mine]))
            for statistic, feature, mine in zip(
                statistics, features, np.split(place, ends), strict=True
            )
        ]


def _interval(statistic: Statistic, features: Floats, drawn: Floats) -> Interval:
    every: Floats = np.ones(len(features))
    whole = every @ features
    value = float(statistic.of(whole[None])[0])
    drawn = drawn[np.isfinite(drawn)]
    if not math.isfinite(value) or not len(drawn) or features.any(axis=1).sum() < 2:
        return Interval(value if math.isfinite(value) else math.nan)
    below = ((drawn < value).sum() + (drawn <= value).sum()) / (2 * len(drawn))
    without = statistic.of(whole - features)
    without = without[np.isfinite(without)]
    every = every[: len(without)]
    shifts = (every @ without) / len(without) - without
    spread = float(every @ shifts**2)
    tails = [0.025, 0.975]
    if 0 < below < 1 and spread > 0:
        skew = float(every @ shifts**3) / (6 * spread**1.5)
        bias = _NORMAL.inv_cdf(below)
        shifted = [bias + _NORMAL.inv_cdf(tail) for tail in tails]
        if all(1 - skew * z > 0 for z in shifted):
            tails = [_NORMAL.cdf(bias + z / (1 - skew * z)) for z in shifted]
    low, high = np.quantile(drawn, tails)
    return Interval(value, float(low), float(high))


@lru_cache(maxsize=2)
def _drawn(key: str, episodes: int, draws: int) -> NDArray[np.uint8]:
    """Return how often each draw takes each episode, `(draws, episodes) uint8`.

    All systems over the same episodes share the draws. That an episode is taken 256 times has no
    probability to speak of.
    """
    seed = int.from_bytes(hashlib.sha256(key.encode()).digest()[:16])
    generator = np.random.Generator(np.random.PCG64(seed))
    counts = np.zeros((draws, episodes), np.uint8)
    step = max(1, _CHUNK // episodes)
    for start in range(0, draws, step):
        part = counts[start : start + step]
        places = generator.integers(0, episodes, part.shape)
        places += np.arange(len(part))[:, None] * episodes
        part[...] = np.bincount(places.ravel(), minlength=part.size).reshape(part.shape)
    return counts
