"""The bootstrap: intervals of means over episodes, and of what is linear in them."""

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
"""Bootstrap samples."""

MIN_EPISODES = 10
"""So many episodes must stand out for a slope, or a mean over families, to have an interval."""

_CHUNK = 2**15  # numbers at a time: they stay in the cache, and BLAS starts no threads for them
_NORMAL = NormalDist()


class Interval(NamedTuple):
    """An estimate with its interval; bounds are NaN where they cannot be had."""

    value: float
    low: float = math.nan
    high: float = math.nan


def slope_weights(ks: Sequence[int]) -> Floats:
    """Return the weights of rates under conditions with these k in their log-linear slope.

    The slope b is that of the least-squares line rate = a + b · log₂(k + 1): k + 1 is the number
    of sessions in the buffer, the lesson included, so b is the change of the success rate with
    each doubling of the history's sessions. With x = log₂(k + 1): b = Σ (x − x̄) rate / Σ (x − x̄)².
    Every condition weighs the same, as all run the same episodes. Of single episodes in the place
    of rates it is what each adds to the slope: b is their mean.

    Source: ordinary least squares; the logarithm is our choice, after the paper's k 0, 1, 3, 7,
    which doubles the sessions from one condition to the next.

    Args:
        ks: At least two different k.
    """
    x = np.log2(np.asarray(ks, float) + 1)
    centred = x - x.mean()
    return np.asarray(centred / (centred**2).sum())


def varies_enough(values: Floats) -> bool:
    """Whether what each episode adds to a comparison, `(E,)`, varies enough for a bootstrap.

    At least `MIN_EPISODES` episodes must have another value than the commonest one, which for a
    paired difference is most often 0. With fewer, the resampled means fall on a coarse lattice, and
    intervals cover less than they promise, down to width zero where all episodes agree.
    """
    _, counts = np.unique(values.round(12), return_counts=True)
    return len(values) - int(counts.max(initial=0)) >= MIN_EPISODES


def bootstrap(values: Floats, key: str, draws: int = DRAWS) -> list[Interval]:
    """Return the mean of each column with its 95% BCa interval, all from the same draws.

    The episode is the cluster: its outcomes under all conditions, repeats among them as a mean,
    are drawn together, so what episodes have in common never counts as evidence twice.

    The bounds are the quantiles α₁ and α₂ of the draws, with
    α = Φ(z₀ + (z₀ + z) / (1 − a (z₀ + z))) for z = ∓1.96: z₀ = Φ⁻¹ of the share of draws below
    the estimate, ties counting half; a = Σ dᵢ³ / 6 (Σ dᵢ²)^1.5 with dᵢ the i-th episode's value
    minus the mean. Draws without any episode that has a value are left out. Where the correction
    itself has no value, as when all draws lie on one side of the estimate, the bounds are the plain
    percentiles. One episode alone has no interval: its bounds are NaN.

    Source: Efron (1987), Better bootstrap confidence intervals, JASA 82, 171–185; Efron and
    Tibshirani (1993), An Introduction to the Bootstrap, chapter 14.

    Args:
        values: A row per episode, NaN for what is missing, `(E, K) float64`.
        key: Text that seeds the draws. The same key, values and order of episodes give the same
            intervals, whatever else is computed.
        draws: Number of bootstrap samples.
    """
    if not values.size:
        return [Interval(math.nan)] * values.shape[1]
    drawn = drawn_means(values, key, draws)
    return [
        _interval(own[~np.isnan(own)], means[np.isfinite(means)])
        for own, means in zip(values.T, drawn.T, strict=True)
    ]


def drawn_means(values: Floats, key: str, draws: int = DRAWS) -> Floats:
    """Return the means of each column in the draws that `bootstrap` takes, `(draws, K)`.

    They are rounded: what is exactly equal is so on any machine. NaN where a draw has no value.

    Args:
        values: As of `bootstrap`, of at least one episode.
        key: As of `bootstrap`.
        draws: As of `bootstrap`.
    """
    known = ~np.isnan(values)
    # Most columns lack the same episodes, mostly none: each mask is summed once.
    masks, place = np.unique(known, axis=1, return_inverse=True)
    columns = np.concatenate([np.where(known, values, 0.0), masks], axis=1)
    drawn = drawn_counts(key, len(values), draws)
    step = max(1, _CHUNK // len(values))
    sums = np.concatenate(
        [drawn[at : at + step].astype(float) @ columns for at in range(0, draws, step)]
    )
    count = values.shape[1]
    with np.errstate(invalid="ignore"):
        return np.asarray((sums[:, :count] / sums[:, count:][:, place]).round(12))


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
    """Return random numbers that a text seeds: the same on every machine."""
    seed = int.from_bytes(hashlib.sha256(key.encode()).digest()[:16])
    return np.random.Generator(np.random.PCG64(seed))


@lru_cache(maxsize=2)
def drawn_counts(key: str, episodes: int, draws: int) -> NDArray[np.uint8]:
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
