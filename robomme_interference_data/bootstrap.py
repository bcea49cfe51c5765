"""The paired bootstrap: intervals of whatever is computed from the rates of the same episodes."""

import hashlib
import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DRAWS = 10_000
"""Bootstrap samples."""

LEAST = 10
"""So many episodes must stand out for a slope, or a mean over families, to have an interval."""

_CHUNK = 2**15  # numbers at a time: they stay in the cache, and BLAS starts no threads for them
_NORMAL = NormalDist()


class Interval(NamedTuple):
    """An estimate with its interval; bounds are NaN where they cannot be had."""

    value: float
    low: float = math.nan
    high: float = math.nan


class Statistic(NamedTuple):
    """Something computed from the means of some columns, over the episodes that have all of them.

    Attributes:
        columns: Places of the columns.
        combine: From their means, `(D, M) float64`, to the statistic, `(D,) float64`. Of single
            episodes in their place it is what each adds to a slope.
    """

    columns: tuple[int, ...]
    combine: Callable[[Floats], Floats]

    def of(self, sums: Floats) -> Floats:
        """Return the statistic of the columns' sums and the number of episodes, `(D, M + 1)`.

        It is rounded: what is exactly equal is so on any machine.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.combine(sums[:, :-1] / sums[:, -1:]).round(12)


def mean(column: int) -> Statistic:
    """Return the mean of a column."""
    return Statistic((column,), lambda m: m[:, 0])


def slope(columns: Sequence[int], ks: Sequence[int]) -> Statistic:
    """Return the log-linear slope of the columns' means, of conditions with these k.

    The slope b is that of the least-squares line rate = a + b · log₂(k + 1): k + 1 is the number
    of sessions in the buffer, the lesson included, so b is the change of the success rate with
    each doubling of the history's sessions. With x = log₂(k + 1): b = Σ (x − x̄) rate / Σ (x − x̄)².
    Every condition weighs the same, as all run the same episodes.

    Source: ordinary least squares; the logarithm is our choice, after the paper's k 0, 1, 3, 7,
    which doubles the sessions from one condition to the next.

    Args:
        columns: Places of the columns.
        ks: At least two different k, one a column.
    """
    x = np.log2(np.asarray(ks, float) + 1)
    centred = x - x.mean()
    weights = centred / (centred**2).sum()
    return Statistic(tuple(columns), lambda m: m @ weights)


def enough(values: Floats) -> bool:
    """Whether what each episode adds to a comparison, `(E,)`, varies enough for a bootstrap.

    At least `LEAST` episodes must have another value than the commonest one, which for a paired
    difference is most often 0. With fewer, the resampled means fall on a coarse lattice, and
    intervals cover less than they promise, down to width zero where all episodes agree.
    """
    _, counts = np.unique(values.round(12), return_counts=True)
    return len(values) - int(counts.max(initial=0)) >= LEAST


def bootstrap(
    values: Floats, statistics: Sequence[Statistic], key: str, draws: int = DRAWS
) -> list[Interval]:
    """Return each statistic with its 95% BCa interval, all from the same draws of episodes.

    The episode is the cluster: its outcomes under all conditions, repeats among them as a mean,
    are drawn together, so what episodes have in common never counts as evidence twice.

    The bounds are the quantiles α₁ and α₂ of the draws, with
    α = Φ(z₀ + (z₀ + z) / (1 − a (z₀ + z))) for z = ∓1.96: z₀ = Φ⁻¹ of the share of draws below
    the estimate, ties counting half; a = Σ dᵢ³ / 6 (Σ dᵢ²)^1.5 with dᵢ the mean of all
    leave-one-episode-out estimates minus the i-th. Draws in which a ratio has no value (a zero
    denominator) are left out. Where the correction itself has no value, as when all draws lie on
    one side of the estimate, the bounds are the plain percentiles. One episode alone has no
    interval: its bounds are NaN.

    Source: Efron (1987), Better bootstrap confidence intervals, JASA 82, 171–185; Efron and
    Tibshirani (1993), An Introduction to the Bootstrap, chapter 14.

    Args:
        values: A row per episode, a column per condition, NaN for what is missing,
            `(E, C) float64`.
        statistics: What is computed.
        key: Text that seeds the draws. The same key, values and order of episodes give the same
            intervals, whatever else is computed.
        draws: Number of bootstrap samples.
    """
    if not len(values) or not statistics:
        return [Interval(math.nan) for _ in statistics]
    features = [_features(values, statistic.columns) for statistic in statistics]
    # Statistics share most of what they sum: each column is summed once.
    columns, place = np.unique(np.concatenate(features, axis=1), axis=1, return_inverse=True)
    sums = _sums(columns, key, draws)
    ends = np.cumsum([feature.shape[1] for feature in features])[:-1]
    return [
        _interval(statistic, feature, statistic.of(sums[:, mine]))
        for statistic, feature, mine in zip(
            statistics, features, np.split(place, ends), strict=True
        )
    ]


def drawn_means(values: Floats, key: str, draws: int = DRAWS) -> Floats:
    """Return the means of each column in the draws that `bootstrap` takes, `(draws, C)`.

    Args:
        values: As of `bootstrap`, without a hole.
        key: As of `bootstrap`.
        draws: As of `bootstrap`.
    """
    return _sums(values, key, draws) / len(values)


def _sums(columns: Floats, key: str, draws: int) -> Floats:
    drawn = _drawn(key, len(columns), draws)
    step = max(1, _CHUNK // len(columns))
    return np.concatenate(
        [drawn[at : at + step].astype(float) @ columns for at in range(0, draws, step)]
    )


def _features(values: Floats, columns: Sequence[int]) -> Floats:
    """Return what is summed over episodes: the columns and a one, `(E, M + 1) float64`."""
    chosen = np.concatenate([values[:, list(columns)], np.ones((len(values), 1))], axis=1)
    chosen[np.isnan(chosen).any(axis=1)] = 0.0
    return chosen


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


def generator_of(key: str) -> np.random.Generator:
    """Return random numbers that a text seeds: the same on every machine."""
    seed = int.from_bytes(hashlib.sha256(key.encode()).digest()[:16])
    return np.random.Generator(np.random.PCG64(seed))


@lru_cache(maxsize=2)
def _drawn(key: str, episodes: int, draws: int) -> NDArray[np.uint8]:
    """Return how often each draw takes each episode, `(draws, episodes)`; no one 256 times.

    All systems over the same episodes share the draws.
    """
    generator = generator_of(key)
    counts = np.zeros((draws, episodes), np.uint8)
    step = max(1, _CHUNK // episodes)
    for start in range(0, draws, step):
        part = counts[start : start + step]
        places = generator.integers(0, episodes, part.shape)
        places += np.arange(len(part))[:, None] * episodes
        part[...] = np.bincount(places.ravel(), minlength=part.size).reshape(part.shape)
    return counts
