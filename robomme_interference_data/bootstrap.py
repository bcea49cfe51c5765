"""Bootstrap intervals for what is computed from episodes, under one condition or several."""

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "DRAWS",
    "Interval",
    "LEAST",
    "Resampler",
    "Statistic",
    "difference",
    "enough",
    "mean",
    "retention",
    "slope",
]

DRAWS = 10_000
LEAST = 10
"""So many episodes must stand out for a paired comparison to have a bootstrap interval."""
_CHUNK = 2**15  # numbers at a time: they stay in the cache, and BLAS starts no threads for them
_MANY = 5_000
"""Above so many episodes, equal ones are drawn together."""
_NORMAL = NormalDist()

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Interval:
    """An estimate with its interval; bounds are NaN where they cannot be had."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Statistic:
    """Something computed from sums over episodes.

    Attributes:
        features: From values, `(P, C) float64` with NaN for what is missing, to what is summed,
            `(P, M) float64`. Episodes that do not count are zeros.
        combine: From sums, `(D, M) float64`, to the statistic, `(D,) float64`.
    """

    features: Callable[[Floats], Floats]
    combine: Callable[[Floats], Floats]


def _together(columns: Sequence[int]) -> Callable[[Floats], Floats]:
    """Sum the given columns and a one, over the episodes that have all of them."""

    def features(values: Floats) -> Floats:
        chosen = values[:, list(columns)]
        chosen = np.concatenate([chosen, np.ones((len(chosen), 1))], axis=1)
        chosen[np.isnan(chosen).any(axis=1)] = 0.0
        return chosen

    return features


def mean(column: int) -> Statistic:
    """Return the mean of a column, over the episodes that have it."""
    return Statistic(_together((column,)), lambda s: s[:, 0] / s[:, 1])


def difference(first: int, second: int) -> Statistic:
    """Return mean of column `second` − mean of column `first`, over episodes that have both."""
    return Statistic(_together((first, second)), lambda s: (s[:, 1] - s[:, 0]) / s[:, 2])


def retention(none: int, start: int, end: int) -> Statistic:
    """Return (end − none) / (start − none): what is left of the lift at the start.

    With columns for k7, `no-history` and k0 it is (k7 − no-history) / (k0 − no-history): 1 if
    nothing is lost, 0 if k7 is back at the rate without history.
    """
    return Statistic(
        _together((none, start, end)), lambda s: (s[:, 2] - s[:, 0]) / (s[:, 1] - s[:, 0])
    )


def slope(columns: Sequence[int], weights: Floats) -> Statistic:
    """Return the weighted sum of the columns' means (see `statistics.slope_weights`)."""
    return Statistic(_together(columns), lambda s: s[:, :-1] @ weights / s[:, -1])


def enough(values: Floats) -> bool:
    """Whether what each episode adds to a comparison varies enough for a bootstrap interval.

    At least `LEAST` episodes must have another value than the commonest one, which for a paired
    difference is most often 0: as many must differ between the two sides. With fewer, the
    resampled means fall on a coarse lattice, a share of draws that is not small holds none of the
    few episodes that matter, and intervals cover less than they promise, down to width zero
    where all episodes agree.

    Args:
        values: A number for each episode, `(E,) float64`.
    """
    _, counts = np.unique(values.round(12), return_counts=True)
    return len(values) - int(counts.max(initial=0)) >= LEAST


class Resampler:
    """Draws episodes with replacement, each with all its conditions and repeats.

    The episode is the cluster: its outcomes under all conditions, repeats among them as a mean,
    are drawn together, so what episodes have in common never counts as evidence twice.

    Above `_MANY` episodes those with equal values, which cannot be told apart, are drawn together:
    how often each distinct row of values occurs, from the multinomial distribution with the
    observed shares. That is the same bootstrap, and takes time by the number of distinct rows: 16
    for four conditions without repeats, however many episodes there are.

    Args:
        values: A row per episode, a column per condition, NaN for what is missing,
            `(E, C) float64`.
        key: Text that seeds the draws. The same key, values and order of episodes give the same
            intervals, whatever else is computed.
        draws: Number of bootstrap samples.
    """

    def __init__(self, values: Floats, key: str, draws: int = DRAWS):
        if len(values) > _MANY:
            self._rows, self._times = _distinct(values)
        else:
            self._rows, self._times = values, np.ones(len(values), np.int64)
        self._key = key
        self._draws = draws

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
        if not len(self._rows) or not statistics:
            return [Interval(math.nan, math.nan, math.nan) for _ in statistics]
        features = [statistic.features(self._rows) for statistic in statistics]
        # Statistics share most of what they sum: each column is summed once.
        columns, place = np.unique(np.concatenate(features, axis=1), axis=1, return_inverse=True)
        sums = np.concatenate([weights @ columns for weights in self._weights()])
        intervals, start = [], 0
        for statistic, feature in zip(statistics, features, strict=True):
            mine = place[start : start + feature.shape[1]]
            start += feature.shape[1]
            intervals.append(self._interval(statistic, feature, _combine(statistic, sums[:, mine])))
        return intervals

    def _interval(self, statistic: Statistic, features: Floats, drawn: Floats) -> Interval:
        whole = self._times @ features
        value = float(_combine(statistic, whole[None])[0])
        drawn = drawn[np.isfinite(drawn)]
        counted = int(self._times @ features.any(axis=1))
        if not math.isfinite(value) or not len(drawn) or counted < 2:
            return Interval(value if math.isfinite(value) else math.nan, math.nan, math.nan)
        below = ((drawn < value).sum() + (drawn <= value).sum()) / (2 * len(drawn))
        # Leaving out any episode of a distinct row gives the same estimate.
        without, times = _combine(statistic, whole - features), self._times
        kept = np.isfinite(without)
        without, times = without[kept], times[kept]
        shifts = (times @ without) / times.sum() - without
        spread = float(times @ shifts**2)
        tails = [0.025, 0.975]
        if 0 < below < 1 and spread > 0:
            skew = float(times @ shifts**3) / (6 * spread**1.5)
            bias = _NORMAL.inv_cdf(below)
            shifted = [bias + _NORMAL.inv_cdf(tail) for tail in tails]
            if all(1 - skew * z > 0 for z in shifted):
                tails = [_NORMAL.cdf(bias + z / (1 - skew * z)) for z in shifted]
        low, high = np.quantile(drawn, tails)
        return Interval(value, float(low), float(high))

    def _weights(self) -> Iterator[Floats]:
        """Yield how often each row is drawn, `(D, R) float64`, some draws at a time."""
        step = max(1, _CHUNK // len(self._rows))
        if len(self._rows) == self._times.sum():
            drawn = _drawn(self._key, len(self._rows), self._draws)
            for start in range(0, self._draws, step):
                yield drawn[start : start + step].astype(float)
            return
        total = int(self._times.sum())
        generator, shares = _generator(self._key), self._times / total
        for start in range(0, self._draws, step):
            size = min(step, self._draws - start)
            yield generator.multinomial(total, shares, size).astype(float)


def _generator(key: str) -> np.random.Generator:
    digest = hashlib.sha256(key.encode()).digest()
    return np.random.Generator(np.random.PCG64(int.from_bytes(digest[:16])))


@lru_cache(maxsize=2)
def _drawn(key: str, episodes: int, draws: int) -> NDArray[np.uint8]:
    """Return how often each draw takes each episode, `(draws, episodes) uint8`.

    All systems over the same episodes share the draws. That an episode is taken 256 times of
    `_MANY` has no probability to speak of.
    """
    generator, counts = _generator(key), np.zeros((draws, episodes), np.uint8)
    step = max(1, _CHUNK // episodes)
    for start in range(0, draws, step):
        part = counts[start : start + step]
        places = generator.integers(0, episodes, part.shape)
        places += np.arange(len(part))[:, None] * episodes
        part[...] = np.bincount(places.ravel(), minlength=part.size).reshape(part.shape)
    return counts


def _combine(statistic: Statistic, sums: Floats) -> Floats:
    # Rounded, so that what is equal in exact arithmetic is equal here on any machine.
    with np.errstate(divide="ignore", invalid="ignore"):
        return statistic.combine(sums).round(12)


def _distinct(values: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return the distinct rows, `(P, C)`, and how often each occurs, `(P,)`."""
    if not values.size:
        return values[:0], np.zeros(0, np.int64)
    code = np.zeros(len(values), np.int64)
    for column in values.T:
        _, place = np.unique(column, return_inverse=True)  # NaN counts as one value
        _, code = np.unique(code * (place.max() + 1) + place, return_inverse=True)
    _, first, counts = np.unique(code, return_index=True, return_counts=True)
    return values[first], counts
