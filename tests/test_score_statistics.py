"""Statistics against worked values and scipy's."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data import bootstrap
from robomme_interference_data.bootstrap import (
    Resampler,
    Statistic,
    difference,
    enough,
    mean,
    retention,
    slope,
)
from robomme_interference_data.evaluate.score.statistics import (
    cohens_h,
    flip_rate,
    holm,
    mcnemar,
    slope_weights,
)
from robomme_interference_data.intervals import Z95, newcombe, wilson


def test_wilson_interval_by_hand() -> None:
    # 8 of 10, z = 1.96: middle (0.8 + 1.9208/10)/1.38416 = 0.7167, half 0.2266
    low, high = wilson(8, 10, z=1.96)
    assert (round(low, 3), round(high, 3)) == (0.490, 0.943)
    # 202 of 450, z² = 3.841459: (202 + 1.920729)/453.841459 = 0.449322, half
    # 1.959964 · √(450 · 0.448889 · 0.551111 + 0.960365)/453.841459 = 0.045761
    low, high = wilson(202, 450)
    assert (round(low, 6), round(high, 6)) == (0.403560, 0.495083)
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(0, 50)[0] == 0.0
    assert wilson(50, 50)[1] == 1.0


@given(st.integers(1, 2000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_is_scipys(counts: tuple[int, int]) -> None:
    expected = scipy.stats.binomtest(*counts).proportion_ci(0.95, method="wilson")
    assert wilson(*counts) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_the_quantile() -> None:
    assert pytest.approx(scipy.stats.norm.ppf(0.975), abs=1e-15) == Z95


@pytest.mark.parametrize(
    ("counts", "interval"),
    [  # Newcombe (1998), Table II, method 10, contrasts (a) to (h)
        ((56, 70, 48, 80), (0.0524, 0.3339)),
        ((9, 10, 3, 10), (0.1705, 0.8090)),
        ((6, 7, 2, 7), (0.0582, 0.8062)),
        ((5, 56, 0, 29), (-0.0381, 0.1926)),
        ((0, 10, 0, 20), (-0.1611, 0.2775)),
        ((0, 10, 0, 10), (-0.2775, 0.2775)),
        ((10, 10, 0, 20), (0.6791, 1.0)),
        ((10, 10, 0, 10), (0.6075, 1.0)),
    ],
)
def test_newcombes_own_examples(
    counts: tuple[int, int, int, int], interval: tuple[float, float]
) -> None:
    assert newcombe(*counts) == pytest.approx(interval, abs=0.00006)
    a, n, b, m = counts
    assert newcombe(b, m, a, n) == pytest.approx((-interval[1], -interval[0]), abs=0.00006)


def test_newcombe_without_trials_says_nothing() -> None:
    assert newcombe(0, 0, 3, 5) == newcombe(3, 5, 0, 0) == (-1.0, 1.0)


def test_mcnemar_by_hand() -> None:
    assert mcnemar(13, 13) == 1.0  # as the released rows flip between k0 and k7
    assert mcnemar(0, 0) == 1.0
    # Of 5 discordant pairs none the other way: 2 · 1/32
    assert mcnemar(5, 0) == mcnemar(0, 5) == 0.0625
    # 2 of 10: 2 · (1 + 10 + 45)/1024
    assert mcnemar(8, 2) == 0.109375


@given(st.integers(0, 3000), st.integers(0, 3000))
def test_mcnemar_is_the_binomial_test(gained: int, lost: int) -> None:
    if gained + lost:
        expected = scipy.stats.binomtest(gained, gained + lost).pvalue
        assert mcnemar(gained, lost) == pytest.approx(expected, rel=1e-8, abs=1e-300)


def test_holm_by_hand() -> None:
    # Sorted 0.01, 0.02, 0.03, 0.04 times 4, 3, 2, 1 is 0.04, 0.06, 0.06, 0.04; never falling.
    assert holm([0.04, 0.01, 0.03, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []
    # What was not tested is no test: 2 and not 3 times the smallest.
    tested = holm([0.01, math.nan, 0.04])
    assert tested[0] == 0.02 and math.isnan(tested[1]) and tested[2] == 0.04


@given(st.lists(st.floats(0, 1), max_size=8))
def test_holm_keeps_the_order_and_only_raises(values: list[float]) -> None:
    adjusted = holm(values)
    assert all(b >= a for a, b in zip(values, adjusted, strict=True))
    assert max(adjusted, default=0) <= 1
    for i, a in enumerate(values):
        for j, b in enumerate(values):
            assert not (a < b and adjusted[i] > adjusted[j])


def test_cohens_h_by_hand() -> None:
    # 2 arcsin 1 − 2 arcsin √½ = π − π/2
    assert cohens_h(1.0, 0.5) == pytest.approx(math.pi / 2)
    assert cohens_h(0.3, 0.3) == 0.0
    assert cohens_h(0.2, 0.4) == -cohens_h(0.4, 0.2)


def test_the_slope_is_the_least_squares_line_over_log2_sessions() -> None:
    ks, rates = [0, 1, 3, 7], [0.453, 0.384, 0.300, 0.193]
    expected = scipy.stats.linregress([0, 1, 2, 3], rates).slope
    assert float(slope_weights(ks) @ rates) == pytest.approx(expected)
    # Over 0, 1, 2, 3 the weights are −0.3, −0.1, 0.1, 0.3: −0.1359 + −0.0384 + 0.03 + 0.0579
    assert float(slope_weights(ks) @ rates) == pytest.approx(-0.0864)


def test_flip_rate_by_hand() -> None:
    first, second = np.array([1, 1, 0, 0, 1], bool), np.array([1, 0, 0, 1, 1], bool)
    flips, rate, low, high = flip_rate(first, second)
    assert (flips, rate) == (2, 0.4)
    assert (low, high) == wilson(2, 5)
    assert math.isnan(flip_rate(first[:0], second[:0])[1])


def outcomes(episodes: int = 80) -> Any:
    numbers = np.random.default_rng(1).random((episodes, 4))
    return (numbers < [0.2, 0.7, 0.55, 0.4]).astype(float)


Function = Callable[..., Any]


@pytest.mark.parametrize(
    ("statistic", "function"),
    [
        (difference(0, 1), lambda a, b, c, d, axis: b.mean(axis) - a.mean(axis)),
        (
            retention(0, 1, 3),
            lambda a, b, c, d, axis: (d.mean(axis) - a.mean(axis)) / (b.mean(axis) - a.mean(axis)),
        ),
        (
            slope([1, 2, 3], slope_weights([0, 1, 3])),
            lambda a, b, c, d, axis: np.tensordot(
                slope_weights([0, 1, 3]), np.stack([x.mean(axis) for x in (b, c, d)]), 1
            ),
        ),
    ],
    ids=["difference", "retention", "slope"],
)
def test_intervals_are_scipys_bca(statistic: Statistic, function: Function) -> None:
    # Means of repeats, so that draws seldom tie with the estimate or each other.
    values = outcomes() + np.random.default_rng(2).normal(0, 0.05, (80, 4))
    found = Resampler(values, "seed", draws=40_000).intervals([statistic])[0]
    expected = scipy.stats.bootstrap(
        tuple(values.T), function, paired=True, n_resamples=40_000, method="BCa", rng=3
    ).confidence_interval
    assert found.value == pytest.approx(float(function(*values.T, axis=0)))
    # Two bootstraps of 40,000 draws differ by a few hundredths of the interval's length.
    tolerance = 0.04 * (expected.high - expected.low)
    assert found.low == pytest.approx(expected.low, abs=tolerance)
    assert found.high == pytest.approx(expected.high, abs=tolerance)


def test_ten_episodes_must_stand_out_for_an_interval() -> None:
    assert not enough(np.zeros(0))
    assert not enough(np.array([1.0] * 9 + [0.0] * 441))
    assert enough(np.array([1.0] * 10 + [0.0] * 440))
    # All gained but nine: the draws are as coarse as where nine are gained.
    assert not enough(np.array([1.0] * 441 + [0.0] * 9))
    assert not enough(np.ones(450))
    # Six differ one way and four the other.
    assert enough(np.array([1.0] * 6 + [-1.0] * 4 + [0.0] * 20))
    # What rounding alone tells apart is equal.
    assert not enough(np.array([0.1 + 0.2] * 10 + [0.3] * 20))


def test_missing_episodes_do_not_count() -> None:
    values = outcomes()
    holes = np.concatenate([values, np.full((30, 4), np.nan)])
    holes[80:, 0] = 1.0  # these have one condition alone
    whole, partial = (
        Resampler(v, "").intervals([difference(0, 1), retention(0, 1, 3)]) for v in (values, holes)
    )
    for a, b in zip(whole, partial, strict=True):
        assert a.value == b.value
        assert (a.low, a.high) == pytest.approx((b.low, b.high), abs=0.12)


def test_nothing_to_compare_is_no_number() -> None:
    for values in (np.zeros((0, 2)), np.array([[1.0, np.nan], [np.nan, 0.0]])):
        (found,) = Resampler(values, "").intervals([difference(0, 1)])
        assert math.isnan(found.value) and math.isnan(found.low) and math.isnan(found.high)
    # Retention without any lift divides by nothing.
    (found,) = Resampler(np.ones((9, 3)), "").intervals([retention(0, 1, 2)])
    assert math.isnan(found.value)


def test_one_episode_alone_has_no_interval() -> None:
    found = Resampler(np.array([[0.0, 1.0], [np.nan, 1.0]]), "key", 100).intervals(
        [difference(0, 1), mean(1)]
    )
    assert found[0].value == 1.0
    assert math.isnan(found[0].low)
    assert math.isnan(found[0].high)
    assert (found[1].value, found[1].low, found[1].high) == (1.0, 1.0, 1.0)


def test_the_key_alone_seeds_the_draws() -> None:
    values, statistics = outcomes(), [slope([0, 1, 2, 3], slope_weights([0, 1, 3, 7]))]
    first, again, other = (Resampler(values, k, 500).intervals(statistics) for k in "aab")
    assert first == again
    assert first != other
    # Whatever else is computed from the same draws makes no difference.
    assert Resampler(values, "a", 500).intervals([difference(0, 1), *statistics])[1:] == first


def test_draws_in_chunks_are_the_same_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    statistics = [difference(0, 1), retention(0, 1, 3)]
    whole = Resampler(outcomes(), "x", 500).intervals(statistics)
    monkeypatch.setattr(bootstrap, "_CHUNK", 160)
    bootstrap._drawn.cache_clear()
    assert Resampler(outcomes(), "x", 500).intervals(statistics) == whole


def test_many_episodes_are_drawn_by_their_kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ways of drawing are the same bootstrap; by kinds, order and _MANY play no part."""
    values, statistics = outcomes(400), [difference(0, 1), retention(0, 1, 3)]
    single = Resampler(values, "x", 20_000).intervals(statistics)
    monkeypatch.setattr(bootstrap, "_MANY", 399)
    by_kind = Resampler(values, "x", 20_000).intervals(statistics)
    assert by_kind == Resampler(values[::-1], "x", 20_000).intervals(statistics)
    for one, other in zip(single, by_kind, strict=True):
        assert one.value == other.value
        tolerance = 0.05 * (one.high - one.low)
        assert one.low == pytest.approx(other.low, abs=tolerance)
        assert one.high == pytest.approx(other.high, abs=tolerance)
    monkeypatch.setattr(bootstrap, "_CHUNK", 160)
    assert by_kind == Resampler(values, "x", 20_000).intervals(statistics)
