"""How often 95% intervals hold what they are of, in made-up rollouts: 1,000 draws a cell."""

import itertools
import math
from collections.abc import Callable
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from robomme_interference_data.evaluate.score.outcomes import rate_of, success
from robomme_interference_data.evaluate.score.tables.effects import retained
from robomme_interference_data.evaluate.score.tables.pairs import pair

pytestmark = pytest.mark.slow

DRAWS = 1000
CELLS = [*itertools.product((45, 180, 450), (0.0, 0.5, 0.9))]  # episodes, what they share


def rollouts(
    generator: np.random.Generator, n: int, rates: tuple[float, ...], shared: float, repeats: int
) -> NDArray[np.int8]:
    """Outcomes by condition, episode and repeat; `shared` is what episodes have in common."""
    normal = NormalDist()
    episode = generator.normal(size=(1, n, 1))
    own = generator.normal(size=(len(rates), n, repeats))
    hard = math.sqrt(shared) * episode + math.sqrt(1 - shared) * own
    limits = np.array([normal.inv_cdf(rate) for rate in rates])
    return (hard > limits[:, None, None]).astype(np.int8)  # 0 is success


def covers(
    bounds: Callable[[NDArray[np.int8]], tuple[float, float] | None], true: float, *given: Any
) -> float:
    """Share of the draws whose interval, where there is one, holds the true value."""
    generator = np.random.default_rng(7)
    found = [bounds(rollouts(generator, *given)) for _ in range(DRAWS)]
    held = [low <= true <= high for low, high in filter(None, found)]
    return sum(held) / len(held)


@pytest.mark.parametrize("repeats", [1, 3])
@pytest.mark.parametrize("rates", [(0.05, 0.2), (0.19, 0.45), (0.45, 0.45), (0.5, 0.8)])
@pytest.mark.parametrize(("n", "shared"), CELLS)
def test_differences(n: int, shared: float, rates: tuple[float, float], repeats: int) -> None:
    def bounds(status: NDArray[np.int8]) -> tuple[float, float]:
        change = pair(*status).change
        return change.low, change.high

    assert covers(bounds, rates[1] - rates[0], n, rates, shared, repeats) >= 0.92


@pytest.mark.parametrize("rate", [0.1, 0.2, 0.45])
@pytest.mark.parametrize(("n", "shared"), CELLS)
def test_rates_with_repeats(n: int, shared: float, rate: float) -> None:
    def bounds(status: NDArray[np.int8]) -> tuple[float, float]:
        return rate_of(status[0]).interval

    assert covers(bounds, rate, n, (rate,), shared, 3) >= 0.92


@pytest.mark.parametrize("rates", [(0.18, 0.45, 0.19), (0.18, 0.45, 0.45), (0.18, 0.45, 0.3)])
@pytest.mark.parametrize(("n", "shared"), CELLS)
def test_retention(n: int, shared: float, rates: tuple[float, float, float]) -> None:
    def bounds(status: NDArray[np.int8]) -> tuple[float, float] | None:
        none, start, end = status
        lift = pair(none, start)
        if not (lift.change.value > 0 and lift.p < 0.05):
            return None  # no retention is shown
        found = retained(success(status).T, pair(none, end).change, pair(start, end).change)
        assert not math.isnan(found.low)
        return found.low, found.high

    true = (rates[2] - rates[0]) / (rates[1] - rates[0])
    assert covers(bounds, true, n, rates, shared, 1) >= 0.92
