"""Training runs as a random effect: what they add to the uncertainty of a mean.

A mean over episodes and training runs varies with both. The interval over episodes, for fixed runs,
is widened by the variance that the runs add: with few runs, much, because a spread estimated from
three numbers is itself uncertain (Student's t).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .bootstrap import Floats, Interval
from .intervals import LEVEL

MIN_RUNS = 3
"""Training runs from which intervals and tests hold for other runs of the same training."""

_LEAST = 0.25
"""Least share of the variance between runs that is theirs, not the noise of single rollouts."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)


@dataclass(frozen=True)
class RunSpread:
    """The spread of a mean over training runs.

    Attributes:
        runs: The number of runs; of a difference, of the side with fewer.
        deviation: Standard deviation of the runs' own means; NaN with a single run.
        variance: Variance that the runs add to the mean over them: 0 below `MIN_RUNS` runs.
        freedom: Degrees of freedom of `variance`; infinite if that is 0.
    """

    runs: int = 1
    deviation: float = math.nan
    variance: float = 0.0
    freedom: float = math.inf

    def widen(
        self, interval: Interval, level: float, limits: tuple[float, float] = (-1.0, 1.0)
    ) -> Interval:
        """Return an interval over episodes, of this level, with the runs as a random effect.

        Each half h becomes √(h² + t² v), with the variance v and Student's t of its degrees of
        freedom, within `limits`.

        Source: adding the squared halves of two independent parts, as `mover_interval` does.
        """
        if not self.variance:
            return interval
        return self._widened(interval, student_quantile(level, self.freedom), limits)

    def p(self, at: Callable[[float], Interval], p: float) -> float:
        """Return the p-value of a mean of 0 with the runs as a random effect.

        It is one minus the level of the widened interval that ends at 0, and no less than `p`, the
        p-value for fixed runs. `at` returns the interval over episodes of any level.
        """
        if not self.variance or math.isnan(p) or math.isnan(at(LEVEL).low):
            return p
        # The smallest t whose interval holds 0, between the levels of 1% and all but one.
        low, high = (student_quantile(level, self.freedom) for level in (0.01, 1 - 1e-12))
        while high - low > 1e-5 * high:
            t = (low + high) / 2
            interval = at(1 - student_tails(t, self.freedom))
            bounds = self._widened(interval, t, (-math.inf, math.inf))
            low, high = (t, high) if bounds.low > 0 or bounds.high < 0 else (low, t)
        return max(p, student_tails(high, self.freedom))

    def _widened(self, interval: Interval, t: float, limits: tuple[float, float]) -> Interval:
        value, low, high = interval
        if math.isnan(low):
            return interval
        added = t * t * self.variance
        return Interval(
            value,
            max(limits[0], value - math.sqrt((value - low) ** 2 + added)),
            min(limits[1], value + math.sqrt((high - value) ** 2 + added)),
        )


ONE_RUN = RunSpread()
"""The spread of a single run: unknown, so it adds nothing."""


def run_spread(values: Floats) -> RunSpread:
    """Return the spread over training runs of values, `(E, R) float64`, NaN where missing.

    With the variance s² of the runs' means over n episodes and the residual variance r of episodes
    and runs, the runs add max(s² / 4, s² − r / n) · Σ w², with R − 1 degrees of freedom: the noise
    of single rollouts is in the interval over episodes already. At least a quarter of s², because
    three runs are often alike by chance: without it, tests of three runs reject too often, 7%.

    The weights w of the runs in the mean over episodes are 1 / R each, and unequal if runs lack
    episodes: few episodes of a run are not another run. Means are those of the episodes that all
    runs have, or if these are fewer than two, as of runs that share the episodes out, of each run's
    own: their differences are larger, with nothing subtracted.

    Source: components of variance of two crossed random effects, Searle (1971), Linear Models,
    chapter 9.
    """
    runs = values.shape[1]
    known = ~np.isnan(values)
    if runs < 2 or not known.any(axis=0).all():
        return RunSpread(runs)
    shared = values[known.all(axis=1)]
    n = len(shared)
    means = shared.mean(axis=0) if n > 1 else np.nanmean(values, axis=0)
    spread = float(means.var(ddof=1))
    deviation = math.sqrt(spread)
    if runs < MIN_RUNS:
        return RunSpread(runs, deviation)
    noise = 0.0
    if n > 1:
        residuals = shared - means - shared.mean(axis=1, keepdims=True) + shared.mean()
        noise = float((residuals**2).sum()) / ((runs - 1) * (n - 1) * n)
    known = known[known.any(axis=1)]
    weights = (known / known.sum(axis=1, keepdims=True)).mean(axis=0)
    variance = max(_LEAST * spread, spread - noise) * float(weights @ weights)
    if variance < 1e-18:  # equal means can differ in the last digits
        return RunSpread(runs, deviation)
    return RunSpread(runs, deviation, variance, runs - 1)


def independent(first: RunSpread, second: RunSpread) -> RunSpread:
    """Return the spread of the difference of two means over unrelated training runs.

    The variances add up, with the degrees of freedom of Welch and Satterthwaite.

    Source: Welch (1947), Biometrika 34, 28–35.
    """
    runs = min(first.runs, second.runs)
    variance = first.variance + second.variance
    if not variance:
        return RunSpread(runs)
    parts = first.variance**2 / first.freedom + second.variance**2 / second.freedom
    return RunSpread(runs, variance=variance, freedom=variance**2 / parts)


def student_tails(t: float, freedom: float) -> float:
    """Return P(|T| ≥ t) of Student's t with at least one degree of freedom, not always whole.

    With ν degrees of freedom and φ = atan(√ν / t): 2 / B(ν / 2, ½) · ∫₀^φ sin(x)^(ν − 1) dx.

    Source: NIST Digital Library of Mathematical Functions, 8.17.1 with sin² as its variable.
    """
    end = math.atan2(math.sqrt(freedom), t)
    area = float(_WEIGHTS @ np.sin(end / 2 * (_NODES + 1)) ** (freedom - 1)) * end / 2
    beta = math.lgamma(freedom / 2) + math.lgamma(0.5) - math.lgamma((freedom + 1) / 2)
    return min(1.0, 2 * area * math.exp(-beta))


@lru_cache(maxsize=4096)
def student_quantile(level: float, freedom: float) -> float:
    """Return the t of a two-sided interval of this level: 4.303 for 95% and two degrees."""
    low, high = 0.0, 1e6
    while high - low > 1e-9 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if student_tails(middle, freedom) > 1 - level else (low, middle)
    return high
