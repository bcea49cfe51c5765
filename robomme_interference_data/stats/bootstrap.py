"""Bootstrap confidence intervals of means over episodes."""

import hashlib
import math
from collections.abc import Sequence
from functools import lru_cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DRAWS = 10_000
"""Number of bootstrap samples."""

MIN_EPISODES = 10
"""Episodes that must differ from the most common value for an interval."""

_CHUNK = 2**15  # values at a time: they fit the CPU cache
_ALONE = 2**18  # multiplications at a time: BLAS starts no threads, which would wait for each other
_NORMAL = NormalDist()


class Interval(NamedTuple):
    """An estimate and its interval; bounds are NaN if there is none."""

    value: float
    low: float = math.nan
    high: float = math.nan


def slope_weights(ks: Sequence[int]) -> Floats:
    """Return the weight of the rate at each k in the log-linear slope.

    The slope b is that of the least-squares line rate = a + b · log₂(k + 1): the change of the
    success rate per doubling of the sessions. With x = log₂(k + 1): b = Σ (x − x̄) rate / Σ (x −
    x̄)². All conditions have equal weight, since all run the same episodes, so b is also the mean
    of the episodes' slopes.

    Source: ordinary least squares; the logarithm is our choice, since the paper's k 0, 1, 3, 7
    double the sessions.
    """
    x = np.log2(np.asarray(ks, float) + 1)
    centered = x - x.mean()
    return np.asarray(centered / (centered**2).sum())


def residual_weights(ks: Sequence[int]) -> Floats:
    """Return the matrix that takes rates at each k to their residuals from the log-linear line.

    With X = (1, log₂(k + 1)): I − X (XᵀX)⁻¹ Xᵀ, `(K, K)`, of rank K − 2.
    """
    x = np.log2(np.asarray(ks, float) + 1)
    line = np.stack([np.ones_like(x), x], axis=1)
    return np.asarray(np.eye(len(x)) - line @ np.linalg.pinv(line))


def varies_enough(values: Floats) -> bool:
    """Whether the episodes' values, `(E,)`, vary enough for a bootstrap.

    At least `MIN_EPISODES` episodes must differ from the most common value. With fewer, the
    resampled means take few distinct values and the intervals are too narrow.
    """
    _, counts = np.unique(values.round(12), return_counts=True)
    return len(values) - int(counts.max(initial=0)) >= MIN_EPISODES


def known_interval(interval: Interval, values: Floats) -> Interval:
    """Return the interval without its bounds if the episodes' values do not vary enough."""
    return interval if varies_enough(values) else Interval(interval.value)


def bootstrap(values: Floats, key: str, draws: int = DRAWS) -> list[Interval]:
    """Return the mean of each column with its 95% BCa interval, all from the same draws.

    `values` has a row per episode, with NaN if missing, `(E, K) float64`. Episodes are the
    clusters: all values of an episode are drawn together, with the mean of its repeats. The text
    `key` seeds the draws.

    The bounds are the quantiles α of the draws with α = Φ(z₀ + (z₀ + z) / (1 − a (z₀ + z))) for z =
    ∓1.96; z₀ = Φ⁻¹ of the share of draws below the estimate, with half of the ties; a = Σ dᵢ³ / 6
    (Σ dᵢ²)^1.5 with the deviations dᵢ from the mean. Draws without any value are omitted. If the
    correction is undefined, as when all draws are on one side of the estimate, the bounds are the
    plain percentiles. A single episode has no interval.

    Source: Efron (1987), JASA 82, 171–185; Efron and Tibshirani (1993), An Introduction to the
    Bootstrap, chapter 14.
    """
    if not values.size:
        return [Interval(math.nan)] * values.shape[1]
    drawn = _drawn_means(values, key, draws)
    return [
        _interval(column[~np.isnan(column)], means[np.isfinite(means)])
        for column, means in zip(values.T, drawn.T, strict=True)
    ]


def _drawn_means(values: Floats, key: str, draws: int = DRAWS) -> Floats:
    """Return the column means in the draws of `bootstrap`, `(draws, K)`; NaN without values.

    They are rounded, so that equal means are equal on any machine.
    """
    known = ~np.isnan(values)
    # Most columns lack the same episodes: each mask is summed once.
    masks, place = np.unique(known, axis=1, return_inverse=True)
    columns = np.concatenate([np.where(known, values, 0.0), masks], axis=1)
    sums = summed(drawn_counts(key, len(values), draws), columns)
    count = values.shape[1]
    with np.errstate(invalid="ignore"):
        return np.asarray((sums[:, :count] / sums[:, count:][:, place]).round(12))


def summed(drawn: NDArray[np.uint8], columns: Floats) -> Floats:
    """Return the sums of the columns, `(E, K)`, in draws of episodes, `(draws, E)`."""
    step = max(1, min(_CHUNK, _ALONE // max(1, columns.shape[1])) // len(columns))
    parts = range(0, len(drawn), step)
    return np.concatenate([drawn[at : at + step].astype(float) @ columns for at in parts])


def _interval(values: Floats, drawn: Floats) -> Interval:
    if not len(values):
        return Interval(math.nan)
    value = float(values.mean().round(12))
    if len(values) < 2 or not len(drawn):
        return Interval(value)
    below = ((drawn < value).sum() + (drawn <= value).sum()) / (2 * len(drawn))
    apart = (values - value).round(12)
    spread = float((apart**2).sum())
    tails = [0.025, 0.975]
    if 0 < below < 1 and spread > 0:
        skew = float((apart**3).sum()) / (6 * spread**1.5)
        bias = _NORMAL.inv_cdf(below)
        shifted = [bias + _NORMAL.inv_cdf(tail) for tail in tails]
        if all(1 - skew * z > 0 for z in shifted):
            tails = [_NORMAL.cdf(bias + z / (1 - skew * z)) for z in shifted]
    low, high = np.quantile(drawn, tails)
    return Interval(value, float(low), float(high))


def generator_of(key: str) -> np.random.Generator:
    """Return a random generator seeded with a text; it is the same on every machine."""
    seed = int.from_bytes(hashlib.sha256(key.encode()).digest()[:16])
    return np.random.Generator(np.random.PCG64(seed))


@lru_cache(maxsize=2)
def drawn_counts(key: str, episodes: int, draws: int) -> NDArray[np.uint8]:
    """Return how often each draw contains each episode, `(draws, episodes)`, always below 256.

    All systems with the same episodes share the draws.
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
