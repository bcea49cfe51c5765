"""Tests and effect sizes for rates over the same episodes: pure functions."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.intervals import wilson

__all__ = ["cohens_h", "flip_rate", "holm", "mcnemar", "slope_weights"]

_EXACT_SUM = 1000
"""Up to so many discordant pairs the binomial tail is summed in whole numbers."""


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
    pairs, fewer = gained + lost, min(gained, lost)
    if 2 * fewer == pairs:
        return 1.0
    if pairs <= _EXACT_SUM:
        return min(1.0, 2 * sum(math.comb(pairs, i) for i in range(fewer + 1)) / 2**pairs)
    # log C(n, i) by lgamma; terms below the largest by more than double precision add nothing.
    i = np.arange(fewer + 1, dtype=float)
    steps = np.concatenate([[0.0], np.log((pairs - i[:-1]) / (i[:-1] + 1))])
    logs = np.cumsum(steps) - pairs * math.log(2)
    return float(min(1.0, 2 * math.exp(logs.max()) * np.exp(logs - logs.max()).sum()))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for their number by Holm's step-down method, in the same order.

    Sorted upwards, p(i) becomes max over j ≤ i of min(1, (m − j + 1) · p(j)), with m p-values.
    NaN, where there was nothing to test, stays and is no test.

    Source: Holm (1979), A simple sequentially rejective multiple test procedure, Scandinavian
    Journal of Statistics 6, 65–70.
    """
    known = [index for index, p in enumerate(p_values) if not math.isnan(p)]
    order = sorted(known, key=lambda index: p_values[index])
    adjusted, largest = [math.nan] * len(p_values), 0.0
    for place, index in enumerate(order):
        largest = max(largest, min(1.0, (len(known) - place) * p_values[index]))
        adjusted[index] = largest
    return adjusted


def cohens_h(rate: float, other: float) -> float:
    """Return Cohen's effect size for two rates, 2 arcsin √rate − 2 arcsin √other.

    About 0.2 is called small, 0.5 medium, 0.8 large.

    Source: Cohen (1988), Statistical Power Analysis for the Behavioral Sciences, chapter 6.
    """
    return 2 * math.asin(math.sqrt(rate)) - 2 * math.asin(math.sqrt(other))


def slope_weights(ks: Sequence[int]) -> NDArray[np.float64]:
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


def flip_rate(
    first: NDArray[np.bool_], second: NDArray[np.bool_]
) -> tuple[int, float, float, float]:
    """Return how often two repeats of the same rollouts disagree: flips, rate, 95% interval.

    The rate is flips / pairs with its Wilson interval: the noise floor. A share of flips between
    conditions that is not above it is noise. It says less of a difference, which is net (gained
    less lost) where a flip rate is gross. NaN for a rate without pairs.

    Args:
        first: Whether each episode succeeded in one repeat, `(N,) bool`.
        second: The same in the other, `(N,) bool`.
    """
    flips = int((first != second).sum())
    low, high = wilson(flips, len(first))
    return flips, flips / len(first) if len(first) else math.nan, low, high
