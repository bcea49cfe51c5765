"""Sign-flip tests of means over episodes, with the intervals that these tests define."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .bootstrap import DRAWS, Floats, Interval, generator_of, summed, varies_enough
from .intervals import LEVEL


@dataclass(frozen=True)
class SignFlips:
    """The sign-flip test of one mean, and its intervals.

    Attributes:
        value: The mean.
        p: Two-sided p-value of the mean being 0.
        low: Lower ends of the draws, ascending.
        high: Upper ends of the draws, descending.
        wide: Whether enough episodes differ for an interval.
    """

    value: float
    p: float
    low: Floats
    high: Floats
    wide: bool

    def at(self, level: float = LEVEL) -> Interval:
        """Return the mean and its interval: all values that the test does not reject."""
        rank = math.floor((1 - level) * (1 + len(self.low)) + 1e-9)
        if not (self.wide and rank):
            return Interval(self.value)
        return Interval(self.value, float(self.low[rank - 1]), float(self.high[rank - 1]))


def sign_flips(values: Floats, key: str, draws: int = DRAWS) -> list[SignFlips]:
    """Test whether the mean of each column is 0 by random sign flips, all from the same draws.

    `values` has a row per episode, with NaN if missing, `(E, K) float64`; the text `key` seeds the
    draws. A draw splits the episodes into two parts, and changes the sign of one part. For a mean
    θ, the sum of the flipped deviations from θ is at least as far from 0 as the observed one
    exactly if θ is between the means of the two parts. So p(θ) = (1 + number of such draws) / (1 +
    draws); the p-value is p(0), and the interval has the θ with p(θ) above 5%: they always agree.
    Flips keep Σ (d − θ)², so the test of the sum is also that of Student's t: it is exact for
    symmetric differences and asymptotically for any others. Without `varies_enough`, there is no
    interval.

    Source: Hartigan (1969), Using subsample values as typical values, JASA 64, 1303–1317; Janssen
    (1999), Testing nonparametric statistical functionals, JSPI 81, 71–93 (studentized flips).
    """
    known = ~np.isnan(values)
    masks, place = np.unique(known, axis=1, return_inverse=True)
    filled, count = np.where(known, values, 0.0), values.shape[1]
    flips = _flips(key, len(values), draws)
    sums = summed(flips, np.concatenate([filled, masks], axis=1))
    n, total = known.sum(axis=0), filled.sum(axis=0)
    size, part = sums[:, count:][:, place], sums[:, :count]
    with np.errstate(invalid="ignore", divide="ignore"):
        ends = np.stack([part / size, (total - part) / (n - size)]).round(12)
    # A part without episodes puts no bound on the mean.
    low = np.where(np.isnan(ends).any(axis=0), -np.inf, ends.min(axis=0))
    high = np.where(np.isnan(ends).any(axis=0), np.inf, ends.max(axis=0))
    reached = ((low <= 0) & (high >= 0)).sum(axis=0)
    low, high = np.sort(low, axis=0), -np.sort(-high, axis=0)
    return [
        SignFlips(
            float((total[k] / n[k]).round(12)) if n[k] else math.nan,
            float((1 + reached[k]) / (1 + draws)) if n[k] else math.nan,
            low[:, k],
            high[:, k],
            bool(n[k]) and varies_enough(values[known[:, k], k]),
        )
        for k in range(count)
    ]


def vector_sign_flips(parts: Sequence[Floats], key: str, draws: int = DRAWS) -> list[float]:
    """Test whether all column means of a part are 0, for each part; from the same draws.

    Parts are `(E, K) float64`; an episode with NaN takes no part. With the sum s of the episodes'
    vectors d, the statistic is sᵀ (Σ d dᵀ)⁻¹ s, on the space that they span. Flips keep Σ d dᵀ, so
    the test is also that of Hotelling's T²: exact for symmetric vectors and asymptotically for any
    others. p is (1 + number of draws with at least the observed value) / (1 + draws), NaN without
    episodes and 1 if all vectors are 0.

    Source: Chung and Fraser (1958), Randomization tests for a multivariate two-sample problem, JASA
    53, 729–735, with signs instead of permutations; Janssen (1999), as for `sign_flips`.
    """
    if not parts:
        return []
    whitened, empty = [], []
    for values in parts:
        known = ~np.isnan(values).any(axis=1, keepdims=True)
        vectors = np.where(known, values, 0.0)
        sizes, axes = np.linalg.eigh(vectors.T @ vectors)
        kept = sizes > 1e-9 * max(1.0, float(sizes.max(initial=0.0)))
        whitened.append(vectors @ (axes[:, kept] / np.sqrt(sizes[kept])))
        empty.append(not known.any())
    columns = np.concatenate(whitened, axis=1)
    flipped = summed(_flips(key, len(columns), draws), columns)
    squares = np.square(columns.sum(axis=0) - 2 * flipped)
    observed = np.square(columns.sum(axis=0))
    found, at = list[float](), 0
    for part, nothing in zip(whitened, empty, strict=True):
        here = slice(at, at := at + part.shape[1])
        reached = squares[:, here].sum(axis=1) >= observed[here].sum() - 1e-9
        found.append(math.nan if nothing else float((1 + reached.sum()) / (1 + draws)))
    return found


@lru_cache(maxsize=2)
def _flips(key: str, episodes: int, draws: int) -> NDArray[np.uint8]:
    """Return which episodes each draw flips, `(draws, episodes)` of 0 and 1."""
    return generator_of(f"{key}, signs").integers(0, 2, (draws, episodes), np.uint8)


def simultaneous(tests: int, alpha: float = 1 - LEVEL) -> float:
    """Return the level at which `tests` intervals hold all at once with 1 − alpha (Bonferroni)."""
    return 1 - alpha / max(1, tests)
