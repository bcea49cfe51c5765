"""Rates and differences over strata, by hand and where their true values are known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.stats.bootstrap import Floats
from robomme_interference_data.stats.intervals import mover_interval, stratified_n, wilson
from robomme_interference_data.stats.significance import Stratified, mantel_haenszel


def floats(*values: float) -> Floats:
    return np.array(values, float)


def test_what_fixed_strata_are_worth_by_hand() -> None:
    # p̃ 11/12 and 1/12: 2 · 10 · 11/144 / 400 = 0.0038194, and 0.25 / 0.0038194.
    assert stratified_n(floats(10, 0), floats(10, 10)) == pytest.approx(65.4545, abs=1e-4)
    # Strata of one rate are worth no more than their trials, and neither is certainty.
    for won in (floats(5, 5), floats(10, 10)):
        assert stratified_n(won, floats(10, 10)) == pytest.approx(20)
    # Equal weights of unequal strata are worth 1 / (1/4 · (1/10 + 1/90)) = 36 trials, not 100.
    equal = floats(0.5, 0.5)
    assert stratified_n(floats(10, 90), floats(10, 90), equal) == pytest.approx(36)


def compared(*strata: tuple[float, float, float, float]) -> Stratified:
    """Compare successes and trials of the first side, then of the second, in each stratum."""
    cells = np.array(strata, float).reshape(-1, 2, 2)
    return mantel_haenszel(cells[:, :, 0].T, cells[:, :, 1].T)


def test_a_difference_within_strata_by_hand() -> None:
    # Equal rates in each stratum: pooled, 9/20 against 3/20 would be 30 points (Simpson).
    found = compared((1, 5, 3, 15), (9, 15, 3, 5))
    assert found.strata == 2
    assert (found.change.value, found.p) == (0.0, 1.0)
    # Weights 5 · 15/20 = 15/4 and the same: (1/5 + 9/15) / 2 = 0.4 on both sides.
    assert (found.first, found.second) == pytest.approx((0.4, 0.4))
    # Differences 0.4 and 0.2 with the weights 5 and 2.5: 1/3. Pooled rates 0.4 and 0.5:
    # z = 2.5 / √(100 · 0.24 / 19 + 25 · 0.25 / 9) = 2.5 / 1.399143 = 1.786808.
    found = compared((2, 10, 6, 10), (2, 5, 3, 5))
    assert found.change.value == pytest.approx(1 / 3)
    assert found.p == pytest.approx(math.erfc(1.786808 / math.sqrt(2)), abs=1e-6)
    n = [
        stratified_n(won, floats(10, 5), floats(2 / 3, 1 / 3))
        for won in (floats(2, 2), floats(6, 3))
    ]
    sides = [wilson(rate * m, m) for rate, m in zip((4 / 15, 0.6), n, strict=True)]
    expected = mover_interval(0.6, sides[1], 4 / 15, sides[0])
    assert found.change[1:] == pytest.approx(expected)


def test_a_stratum_with_one_side_contributes_nothing() -> None:
    alone = compared((2, 10, 6, 10))
    assert compared((2, 10, 6, 10), (7, 9, 0, 0), (0, 0, 1, 4)) == alone
    assert alone.strata == 1
    nothing = compared((7, 9, 0, 0))
    assert nothing.strata == 0 and math.isnan(nothing.p) and math.isnan(nothing.change.value)


SIDE = st.integers(0, 20).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))


@given(st.lists(st.tuples(SIDE, SIDE).map(lambda two: (*two[0], *two[1])), max_size=9))
def test_exchanged_sides_have_the_opposite_difference(
    strata: list[tuple[int, int, int, int]],
) -> None:
    found, other = compared(*strata), compared(*[(c, d, a, b) for a, b, c, d in strata])
    if not found.strata:
        return
    (value, low, high), (negative, bottom, top) = found.change, other.change
    assert (value, low, high) == pytest.approx((-negative, -top, -bottom))
    assert found.p == pytest.approx(other.p)
    assert -1 <= low <= value <= high <= 1 and 0 <= found.p <= 1


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.0, 0.25])
@pytest.mark.parametrize("size", [6, 40])
def test_the_interval_and_the_test_hold(size: int, step: float) -> None:
    """Nine families of unequal rates and unequal shares of the two sides, 1,000 draws a case."""
    generator = np.random.default_rng(7)
    rates, shares = np.linspace(0.1, 0.7, 9), np.linspace(0.1, 0.9, 9)
    held, rejected = [], []
    for _ in range(1000):
        second = generator.binomial(size, shares)
        of = np.stack([size - second, second])
        won = generator.binomial(of, np.stack([rates, rates + step]))
        found = mantel_haenszel(won.astype(float), of.astype(float))
        held.append(found.change.low <= step <= found.change.high)
        rejected.append(found.p < 0.05)
    assert 0.93 <= np.mean(held) <= 0.975
    if not step:
        assert np.mean(rejected) <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / 1000)
