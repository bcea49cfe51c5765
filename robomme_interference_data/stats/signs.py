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
        # At most all draws: a level of 0 would be one more.
        rank = min(math.floor((1 - level) * (1 + len(self.low)) + 1e-9), len(self.low))
        if not (self.wide and rank):
            return Interval(self.value)
        return Interval(self.value, float(self.low[rank - 1]), float(self.high[rank - 1]))


_NOTHING = SignFlips(math.nan, math.nan, np.empty(0), np.empty(0), wide=False)
"""Of no episodes."""


def sign_flips(values: Floats, key: str, draws: int = DRAWS) -> list[SignFlips]:
    """Test whether the mean of each column is 0 by sign flips, random or all of them.

    `values` has a row per episode, with NaN if missing, `(E, K) float64`; the text `key` seeds the
    draws. A draw splits the episodes into two parts, and changes the sign of one part. For a mean
    θ, the sum of the flipped deviations from θ is at least as far from 0 as the observed one
    exactly if θ is between the means of the two parts. So p(θ) = (1 + number of such draws) / (1 +
    draws); the p-value is p(0), and the interval has the θ with p(θ) above 5%: they always agree.
    Flips keep Σ (d − θ)², so the test of the sum is also that of Student's t: it is exact for
    symmetric differences and asymptotically for any others. Without `varies_enough`, there is no
    interval.

    A column of n episodes with 2ⁿ ≤ draws, up to 13 of 10,000, takes every flip once instead of
    draws: its p is a whole number of 2ⁿ-ths, at least 2 / 2ⁿ, and does not depend on `key`.

    Source: Hartigan (1969), Using subsample values as typical values, JASA 64, 1303–1317; Janssen
    (1999), Testing nonparametric statistical functionals, JSPI 81, 71–93 (studentized flips).
    """
    known = ~np.isnan(values)
    masks, place = np.unique(known, axis=1, return_inverse=True)
    by_column: list[SignFlips] = [_NOTHING] * values.shape[1]
    few = masks.sum(axis=0) <= _most_enumerated(draws)
    # All columns with many episodes share their draws; each set of few episodes has its own flips.
    groups = [(np.ones(len(values), bool), ~few[place])]
    groups += [(masks[:, at], place == at) for at in np.flatnonzero(few)]
    for rows, columns in groups:
        numbers = np.flatnonzero(columns)
        if len(numbers) and rows.any():
            tests = _tests(values[np.ix_(rows, numbers)], _flips(key, int(rows.sum()), draws))
            for number, test in zip(numbers.tolist(), tests, strict=True):
                by_column[number] = test
    return by_column


def _tests(values: Floats, flips: NDArray[np.uint8]) -> list[SignFlips]:
    """Return what `sign_flips` does, from the given flips."""
    known = ~np.isnan(values)
    masks, place = np.unique(known, axis=1, return_inverse=True)
    filled, count = np.where(known, values, 0.0), values.shape[1]
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
            float((total[k] / n[k]).round(12)),
            float((1 + reached[k]) / (1 + len(flips))),
            low[:, k],
            high[:, k],
            varies_enough(values[known[:, k], k]),
        )
        for k in range(count)
    ]


def vector_sign_flips(parts: Sequence[Floats], key: str, draws: int = DRAWS) -> list[float]:
    """Test whether all column means of a part are 0, for each part, by sign flips.

    Parts are `(E, K) float64`; an episode with NaN takes no part. With the sum s of the episodes'
    vectors d, the statistic is sᵀ (Σ d dᵀ)⁻¹ s, on the space that they span. Flips keep Σ d dᵀ, so
    the test is also that of Hotelling's T²: exact for symmetric vectors and asymptotically for any
    others. p is (1 + number of draws with at least the observed value) / (1 + draws), NaN without
    episodes and 1 if all vectors are 0. As in `sign_flips`, few episodes take every flip once.

    Source: Chung and Fraser (1958), Randomization tests for a multivariate two-sample problem, JASA
    53, 729–735, with signs instead of permutations; Janssen (1999), as for `sign_flips`.
    """
    ps = [math.nan] * len(parts)
    many: dict[int, Floats] = {}
    for number, values in enumerate(parts):
        known = np.asarray(~np.isnan(values).any(axis=1))
        n = int(known.sum())
        if not n:
            continue
        vectors = np.where(known[:, None], values, 0.0)
        sizes, axes = np.linalg.eigh(vectors.T @ vectors)
        kept = sizes > 1e-9 * max(1.0, float(sizes.max(initial=0.0)))
        whitened = vectors @ (axes[:, kept] / np.sqrt(sizes[kept]))
        if n <= _most_enumerated(draws):
            [ps[number]] = _vector_tests([whitened[known]], _flips(key, n, draws))
        else:
            many[number] = whitened
    if many:
        columns = [*many.values()]
        tests = _vector_tests(columns, _flips(key, len(columns[0]), draws))
        for number, p in zip(many, tests, strict=True):
            ps[number] = p
    return ps


def _vector_tests(whitened: Sequence[Floats], flips: NDArray[np.uint8]) -> list[float]:
    """Return p of each part, whose vectors have a sum of squares of 1 along each axis."""
    columns = np.concatenate(whitened, axis=1)
    squares = np.square(columns.sum(axis=0) - 2 * summed(flips, columns))
    observed = np.square(columns.sum(axis=0))
    found, at = list[float](), 0
    for part in whitened:
        here = slice(at, at := at + part.shape[1])
        reached = squares[:, here].sum(axis=1) >= observed[here].sum() - 1e-9
        found.append(float((1 + reached.sum()) / (1 + len(flips))))
    return found


@lru_cache(maxsize=2)
def _flips(key: str, episodes: int, draws: int) -> NDArray[np.uint8]:
    """Return which episodes each draw flips, `(draws, episodes)` of 0 and 1.

    If there are no more than `draws` flips in all, they are all of them except the observed signs,
    which a test counts by itself.
    """
    if episodes <= _most_enumerated(draws):
        every = np.arange(1, 2**episodes)[:, None]
        return (every >> np.arange(episodes) & 1).astype(np.uint8)
    return generator_of(f"{key}, signs").integers(0, 2, (draws, episodes), np.uint8)


def _most_enumerated(draws: int) -> int:
    """Return the most episodes whose sign flips, 2ⁿ, are no more than the draws."""
    return draws.bit_length() - 1


def simultaneous(tests: int, alpha: float = 1 - LEVEL) -> float:
    """Return the level at which `tests` intervals hold all at once with 1 − alpha (Bonferroni)."""
    return 1 - alpha / max(1, tests)
