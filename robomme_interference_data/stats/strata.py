"""Rates, and differences between two unpaired sides, over strata such as families."""

import math
from typing import NamedTuple

from .bootstrap import Floats, Interval
from .intervals import LEVEL, mover_interval, wilson


def stratified_n(successes: Floats, trials: Floats, weights: Floats | None = None) -> float:
    """Return the number of independent trials that a weighted rate over fixed strata is worth.

    Strata with xᶠ of nᶠ successes and weights λᶠ (by default nᶠ / n) that sum to 1 have the rate p
    = Σ λᶠ xᶠ / nᶠ with the variance v = Σ λᶠ² p̃ᶠ (1 − p̃ᶠ) / nᶠ, p̃ᶠ = (xᶠ + 1) / (nᶠ + 2). The
    trials are p (1 − p) / v, and at least 1 / Σ (λᶠ² / nᶠ), which is n for the default weights.
    Wilson's interval then is for these strata alone. All arrays are `(F,) float64`, without empty
    strata.

    Source: effective sample size, Kish (1965), Survey Sampling, chapter 8; Wilson's interval over
    strata, Yan and Su (2010), Statistics in Biopharmaceutical Research 2, 329–335.
    """
    weights = trials / trials.sum() if weights is None else weights
    rate = float(weights @ (successes / trials))
    near = (successes + 1) / (trials + 2)
    variance = float((weights**2) @ (near * (1 - near) / trials))
    return max(1 / float((weights**2) @ (1 / trials)), rate * (1 - rate) / variance)


class Stratified(NamedTuple):
    """Two unpaired sides compared within strata.

    Attributes:
        strata: The number of strata with trials on both sides; no other stratum contributes.
        first: The weighted rate of the first side; NaN without strata.
        second: That of the second side.
        change: second − first, with its interval.
        p: Two-sided p-value of no difference in any stratum.
    """

    strata: int
    first: float
    second: float
    change: Interval
    p: float


def mantel_haenszel(successes: Floats, trials: Floats, level: float = LEVEL) -> Stratified:
    """Compare two unpaired sides within strata: successes and trials, `(2, F) float64`.

    A stratum of n₁ and n₂ trials weighs n₁ n₂ / (n₁ + n₂), so one with trials on a single side
    weighs nothing. The difference is the weighted mean of the strata's own ones; its interval is
    the `mover_interval` of Wilson's intervals of the two weighted rates with `stratified_n`. The
    test is that of Cochran, Mantel and Haenszel without continuity correction: z = Σ n₁ n₂ (p₂ −
    p₁) / N over √(Σ n₁ n₂ p (1 − p) / (N − 1)), with N = n₁ + n₂ and the pooled rate p of each
    stratum. p is 1 if no stratum has both outcomes.

    Source: Mantel and Haenszel (1959), JNCI 22, 719–748; the interval: Yan and Su (2010),
    Statistics in Biopharmaceutical Research 2, 329–335.
    """
    both = (trials > 0).all(axis=0)
    won, of = successes[:, both], trials[:, both]
    strata = int(both.sum())
    if not strata:
        return Stratified(0, math.nan, math.nan, Interval(math.nan), math.nan)
    total = of.sum(axis=0)
    sizes = of.prod(axis=0) / total
    weights = sizes / sizes.sum()
    rates = [float(weights @ share) for share in won / of]
    worth = [stratified_n(*side, weights) for side in zip(won, of, strict=True)]
    bounds = [wilson(rate * n, n, level) for rate, n in zip(rates, worth, strict=True)]
    (first, second), pooled = rates, won.sum(axis=0) / total
    interval = mover_interval(second, bounds[1], first, bounds[0])
    spread = math.sqrt(float((of.prod(axis=0) / (total - 1)) @ (pooled * (1 - pooled))))
    change = round(second - first, 12)
    z = change * float(sizes.sum()) / spread if spread else 0.0
    return Stratified(
        strata, first, second, Interval(change, *interval), math.erfc(abs(z) / math.sqrt(2))
    )
