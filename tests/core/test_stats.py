"""Statistics against worked values and scipy's."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.stats.bootstrap import bootstrap, slope_weights, varies_enough
from robomme_interference_data.stats.intervals import (
    effective_n,
    fieller,
    newcombe,
    newcombe_paired,
    wilson,
)
from robomme_interference_data.stats.significance import (
    holm,
    mcnemar,
    poisson_binomial,
    sign_flip,
    two_proportions,
)
from robomme_interference_data.stats.signs import sign_flips, vector_sign_flips

COUNTS = st.tuples(*[st.integers(0, 300)] * 4).filter(any)


@given(st.integers(1, 2000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_is_scipys(counts: tuple[int, int]) -> None:
    expected = scipy.stats.binomtest(*counts).proportion_ci(0.95, method="wilson")
    assert wilson(*counts) == pytest.approx((expected.low, expected.high), abs=1e-12)


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
    assert newcombe(0, 0, 3, 5) == newcombe(3, 5, 0, 0) == (-1.0, 1.0)


@pytest.mark.parametrize(
    ("counts", "interval"),
    [
        # p = 2/21 in (0.0265188, 0.2891414), q = 8/21 in (0.2075101, 0.5912135). A = 12 − 7 = 5 is
        # under 21/2, so φ is 0: −6/21 − √(0.0687193² + 0.2102610²), −6/21 + √(0.1939033² +
        # 0.1734423²).
        ((1, 1, 7, 12), (-0.506920, -0.025559)),
        # p = 32/50 in (0.5014102, 0.7586125), q = 22/50 in (0.3116220, 0.5769397). A = 320 − 24 =
        # 296, less 25 is 271; φ = 271/√(32 · 18 · 22 · 28) = 0.4549542.
        # 0.2 − √(0.1385898² − 2φ · 0.1385898 · 0.1369397 + 0.1369397²)
        ((20, 12, 2, 16), (0.056156, 0.329207)),
        # p = 48/50 in (0.8653991, 0.9889611), q = 38/50 in (0.6258732, 0.8570260). A = −24 stays;
        # φ = −24/√(48 · 2 · 38 · 12) = −0.1147079.
        ((36, 12, 2, 0), (0.056930, 0.340428)),
        # All agree, half of them in success: A = 25, less 5 is 20, φ = 20/25. Both rates in
        # (0.2365931, 0.7634069): ±0.2634069 · √(2 − 1.6)
        ((5, 0, 0, 5), (-0.166593, 0.166593)),
        # Both sides certain, without a correlation: low is 1 − √(0.6576198² + 0.6576198²).
        ((0, 2, 0, 0), (0.069985, 1.0)),
        ((0, 0, 0, 0), (-1.0, 1.0)),
    ],
)
def test_newcombes_paired_interval_by_hand(
    counts: tuple[int, int, int, int], interval: tuple[float, float]
) -> None:
    assert newcombe_paired(*counts) == pytest.approx(interval, abs=1e-6)


@given(COUNTS)
def test_no_paired_interval_has_width_zero(counts: tuple[int, int, int, int]) -> None:
    low, high = newcombe_paired(*counts)
    narrow = newcombe_paired(*counts, level=0.9)
    change = (counts[1] - counts[2]) / sum(counts)
    assert -1 <= low <= narrow[0] <= change <= narrow[1] <= high <= 1 and low < high
    both, first, second, neither = counts
    assert newcombe_paired(both, second, first, neither) == pytest.approx((-high, -low))


def test_what_repeats_are_worth_by_hand() -> None:
    # 0.5 · 0.5 / 0.05 is 5 trials an episode, but there are only 3 rollouts of each.
    assert effective_n(0.5, 0.05, 10, 30) == 30
    assert effective_n(0.5, 0.125, 10, 30) == pytest.approx(20)
    # Single rollouts have p (1 − p) n / (n − 1): their number, and no fewer.
    assert effective_n(0.5, 0.25 * 10 / 9, 10, 10) == 10
    # Where all episodes agree nothing tells repeats from copies.
    assert effective_n(1.0, 0.0, 10, 30) == 10


def test_two_proportions_by_hand() -> None:
    # Published GroundSG and the next without history: z = 0.024444 / √(p(1−p) 2/450), p = 175/900
    assert two_proportions(93, 450, 82, 450) == pytest.approx(0.354208, abs=1e-6)
    table = scipy.stats.chi2_contingency([[93, 357], [82, 368]], correction=False)
    assert two_proportions(93, 450, 82, 450) == pytest.approx(table.pvalue)
    assert two_proportions(5, 5, 7, 7) == 1.0
    assert math.isnan(two_proportions(0, 0, 1, 2))


def test_fiellers_interval_by_hand() -> None:
    # z² = 3.841459. a = 1 − 0.0384146, b = 0.5 − 0.0192073, c = 0.25 − 0.0384146:
    # (0.4807927 ∓ √(0.2311616 − 0.9615854 · 0.2115854 = 0.0277042)) / 0.9615854
    found = fieller(0.5, 1.0, (0.01, 0.01), 0.005)
    assert found == pytest.approx((0.326905, 0.673095), abs=1e-6)
    # Twice the same mean is a ratio of 1 without any spread.
    assert fieller(0.5, 0.5, (0.01, 0.01), 0.01) == pytest.approx((1, 1))
    # A denominator that can be 0 bounds nothing: 0.3² < z² · 0.05
    assert all(map(math.isnan, fieller(0.1, 0.3, (0.05, 0.05), 0.0)))


@given(st.lists(st.sampled_from([-1, -2 / 3, -0.5, -1 / 3, 0, 0.25, 0.5, 1]), max_size=9))
def test_sign_flips_are_counted(differences: list[float]) -> None:
    p = sign_flip(np.array(differences))
    sums = [
        abs(sum(map(math.prod, zip(differences, signs, strict=True))))
        for signs in itertools.product((1, -1), repeat=len(differences))
    ]
    observed = abs(sum(differences))
    above = sum(one > observed + 1e-9 for one in sums)
    equal = sum(abs(one - observed) <= 1e-9 for one in sums)
    assert p == pytest.approx((above + equal) / len(sums))


def test_sign_flips_of_five_repeats_are_exact_where_one_broke() -> None:
    # In twentieths 16, −12, −4 and 15, with the sum 15. Of the sums ±16 ± 12 ± 4, ±32 are as far
    # from 0 with either sign of the 15, ±24 and ±8 with one, and 0, twice, with either: 12 of 16.
    found = sign_flip(np.array([4 / 5, -3 / 5, -1 / 5, 3 / 4]))
    assert found == pytest.approx(12 / 16)


@pytest.mark.parametrize(
    ("differences", "p"),
    [
        ([], math.nan),
        ([0.3], 1.0),  # both signs are as far from 0
        ([0.1, 0.2], 2 / 4),
        ([0.1, 0.2, -0.3], 1.0),  # the sum is 0
        ([3.0, 2.0, -1.0], 4 / 8),  # the sum is 4: of 6, 4, 2 and 0 with either sign, two reach it
        ([0.3, 0.1, 0.4, 0.1, 0.5, 0.9], 2 / 64),
        ([-1.0] * 13, 2 / 8192),
    ],
)
def test_few_episodes_take_every_flip_once(differences: list[float], p: float) -> None:
    """Whatever the key; also beside a column of many episodes, and as vectors of one number."""
    column = np.full((40, 2), 0.5)
    column[:, 0] = np.nan
    column[5 : 5 + len(differences), 0] = differences
    for key in ("one key", "other"):
        found = sign_flips(column, key)[0]
        [of_vectors] = vector_sign_flips([column[:, :1]], key)
        assert [found.p, of_vectors] == pytest.approx([p, p], rel=1e-12, nan_ok=True)


def test_the_interval_of_few_episodes_by_hand() -> None:
    """Of 0 and twelve ones: a part without the 0 has the mean 1, the other one 1 - 1 / its size."""
    values = np.array([0.0, *[1.0] * 12])
    [found] = sign_flips(values[:, None], "key")
    sizes = [size for size in range(1, 13) for _ in range(2 * math.comb(12, size - 1))]
    assert found.low[0] == -np.inf and len(found.low) == 2**13 - 1
    assert found.low[1:] == pytest.approx([1 - 1 / size for size in sizes])
    assert found.p == 4 / 2**13  # no flip, all, and those of the 0 alone


def test_random_sign_flips_and_their_interval_by_hand() -> None:
    # Of the draws of four ones, two in sixteen leave one part empty: the sum is as far from 0.
    column = np.array([[1.0, 0.0]] * 4 + [[np.nan, 0.0]] * 2)
    one, nothing = sign_flips(column, "key", 20_000)
    assert one.value == 1 and one.p == 2 / 16
    assert math.isnan(one.at().low)  # fewer than ten episodes differ
    assert (nothing.value, nothing.p) == (0, 1)
    # Of a normal sample the interval is Student's, and the p-value that of its test.
    values = np.random.default_rng(4).normal(0.3, 1, (60, 3))
    for found, own in zip(sign_flips(values, "key", 20_000), values.T, strict=True):
        test = scipy.stats.ttest_1samp(own, 0)
        assert found.p == pytest.approx(test.pvalue, abs=0.01)
        bounds = test.confidence_interval(0.95)
        assert found.at()[1:] == pytest.approx((bounds.low, bounds.high), abs=0.02)


@given(st.lists(st.integers(-2, 2), min_size=20, max_size=40), st.sampled_from([0.9, 0.95]))
def test_the_interval_of_sign_flips_agrees_with_its_test(values: list[int], level: float) -> None:
    (found,) = sign_flips(np.array(values, float)[:, None], "key", 400)
    interval = found.at(level)
    if not math.isnan(interval.low):
        assert interval.low <= interval.value <= interval.high
        assert (interval.low <= 0 <= interval.high) == (found.p > 1 - level + 1e-9)
    # A shift of all values shifts the interval.
    (moved,) = sign_flips(np.array(values, float)[:, None] + 5, "key", 400)
    assert moved.at(level)[1:] == pytest.approx([b + 5 for b in interval[1:]], nan_ok=True)


def test_sign_flips_of_vectors_by_hand() -> None:
    # Of equal vectors, two of sixteen draws are as far from zero: no flip, or all.
    equal = np.array([[1.0, 2.0]] * 4 + [[np.nan, 1.0]])
    # A and −A cancel out.
    none = np.array([[1.0, 2.0], [-1.0, -2.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    found = vector_sign_flips([equal, none, 0 * none, np.nan * none], "key", 20_000)
    assert found[:3] == pytest.approx([2 / 16, 1, 1], abs=0.01)
    assert math.isnan(found[3]) and vector_sign_flips([], "key") == []
    # Of one column, it is the test of the mean; of a normal sample, Hotelling's.
    values = np.random.default_rng(4).normal(0.3, 1, (60, 2)) @ [[1, 0.5], [0, 1]]
    (one,) = vector_sign_flips([values[:, :1]], "key", 20_000)
    assert one == sign_flips(values[:, :1], "key", 20_000)[0].p
    mean = values.mean(axis=0)
    statistic = 60 * mean @ np.linalg.solve(np.cov(values.T), mean) * 58 / (2 * 59)
    (two,) = vector_sign_flips([values], "key", 20_000)
    assert two == pytest.approx(scipy.stats.f.sf(statistic, 2, 58), abs=0.01)


@given(st.integers(0, 200), st.integers(0, 200), st.integers(0, 50))
def test_of_single_rollouts_sign_flips_are_mcnemars(gained: int, lost: int, same: int) -> None:
    assert sign_flip(np.array([1.0] * gained + [-1.0] * lost + [0.0] * same)) == mcnemar(
        gained, lost
    )


@given(st.integers(0, 3000), st.integers(0, 3000))
def test_mcnemar_is_the_binomial_test(gained: int, lost: int) -> None:
    if gained + lost:
        expected = scipy.stats.binomtest(gained, gained + lost).pvalue
        assert mcnemar(gained, lost) == pytest.approx(expected, rel=1e-8, abs=1e-200)


@given(st.integers(0, 450), st.integers(0, 450), st.integers(2, 5))
def test_guesses_of_equal_chances_are_binomial(first: int, second: int, options: int) -> None:
    right, n = sorted((first, second))
    expected = scipy.stats.binom.sf(right - 1, n, 1 / options)
    assert poisson_binomial(right, [1 / options] * n) == pytest.approx(expected, rel=1e-9)


@given(st.lists(st.floats(0, 1), max_size=8), st.integers(0, 9))
def test_guesses_are_all_that_can_be(chances: list[float], right: int) -> None:
    every = itertools.product((False, True), repeat=len(chances))
    expected = sum(
        math.prod(c if won else 1 - c for c, won in zip(chances, one, strict=True))
        for one in every
        if sum(one) >= right
    )
    assert poisson_binomial(right, chances) == pytest.approx(expected, abs=1e-12)


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
    order = sorted(range(len(values)), key=values.__getitem__)
    assert sorted(adjusted) == [adjusted[place] for place in order]


def test_slopes_by_hand() -> None:
    # The slope is that of the least-squares line over log2 of the sessions, 0, 1, 2 and 3, with the
    # weights −0.3, −0.1, 0.1, 0.3: −0.1359 + −0.0384 + 0.03 + 0.0579
    rates = [0.453, 0.384, 0.300, 0.193]
    found = float(rates @ slope_weights([0, 1, 3, 7]))
    assert found == pytest.approx(-0.0864)
    assert found == pytest.approx(scipy.stats.linregress([0, 1, 2, 3], rates).slope)


def outcomes(episodes: int = 80) -> Any:
    numbers = np.random.default_rng(1).random((episodes, 4))
    return (numbers < [0.2, 0.7, 0.55, 0.4]).astype(float)


def changes(values: Any) -> Any:
    """Second − first, and the slope over the last three, of x = 0, 1, 2: half of last − first."""
    return np.stack([values[:, 1] - values[:, 0], values[:, 1:] @ slope_weights([0, 1, 3])], axis=1)


def test_intervals_are_scipys_bca() -> None:
    # Means of repeats, so that draws seldom tie with the estimate or each other.
    values = outcomes() + np.random.default_rng(2).normal(0, 0.05, (80, 4))
    wanted = (values[:, 1] - values[:, 0], (values[:, 3] - values[:, 1]) / 2)
    for found, own in zip(bootstrap(changes(values), "seed", 40_000), wanted, strict=True):
        expected = scipy.stats.bootstrap(
            (own,), np.mean, n_resamples=40_000, method="BCa", rng=3
        ).confidence_interval
        assert found.value == pytest.approx(own.mean())
        # Two bootstraps of 40,000 draws differ by a few hundredths of the interval's length.
        tolerance = 0.04 * (expected.high - expected.low)
        assert found.low == pytest.approx(expected.low, abs=tolerance)
        assert found.high == pytest.approx(expected.high, abs=tolerance)


def test_the_draws_are_these() -> None:
    """Published intervals can be had again: the draws of a key never change."""
    found = bootstrap(changes(outcomes()), "robomme", 1000)
    bounds = [(round(one.low, 9), round(one.high, 9)) for one in found]
    assert bounds == [(0.2375, 0.5125), (-0.16875, -0.025)]


def test_ten_episodes_must_stand_out_for_an_interval() -> None:
    assert not varies_enough(np.zeros(0))
    assert not varies_enough(np.array([1.0] * 9 + [0.0] * 441))
    assert varies_enough(np.array([1.0] * 10 + [0.0] * 440))
    # All gained but nine: the draws are as coarse as where nine are gained.
    assert not varies_enough(np.array([1.0] * 441 + [0.0] * 9))
    assert not varies_enough(np.ones(450))
    # Six differ one way and four the other.
    assert varies_enough(np.array([1.0] * 6 + [-1.0] * 4 + [0.0] * 20))
    # What rounding alone tells apart is equal.
    assert not varies_enough(np.array([0.1 + 0.2] * 10 + [0.3] * 20))
