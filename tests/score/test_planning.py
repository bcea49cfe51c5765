"""Equivalence within a margin, and what a number of episodes can show."""

import json
import math
import re
from pathlib import Path
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import scoring as made
from support.messages import raises
from support.scoring import BASE, RETRIEVAL, cells, record, records, run

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.score.config import Expected, Settings
from robomme_interference_data.evaluate.score.planning import plan
from robomme_interference_data.evaluate.score.power import needed, power, smallest
from robomme_interference_data.evaluate.score.report.headline import headlines
from robomme_interference_data.evaluate.score.tables.equivalence import (
    BEYOND,
    EQUIVALENT,
    OPEN,
    tost,
    verdict,
)
from robomme_interference_data.evaluate.score.tables.pairs import NO_PAIRS, Pairs, pair
from robomme_interference_data.stats.intervals import newcombe, newcombe_paired
from robomme_interference_data.stats.sequential import look_levels

# --- equivalence -------------------------------------------------------------------------------


@made.needs_released
def test_the_released_rows_are_equivalent_to_their_own_k0_alone() -> None:
    options = {"system": RETRIEVAL, "expected": Expected.BENCHMARK, "paper": True}
    found = made.score(made.RELEASED, margin=3, **options)
    own = record(found, "equivalence", condition="k7", against_system=RETRIEVAL)
    assert (own["low_90"], own["high_90"]) == newcombe_paired(189, 13, 13, 235, level=0.9)
    assert round(100 * own["high_90"], 1) == 1.9 and own["verdict"] == "equivalent"
    wide = made.score(made.RELEASED, margin=5, **options)
    paper = record(wide, "equivalence", condition="k7", against_system=BASE)
    assert (paper["against_condition"], paper["against_rows"]) == ("k0", "published")
    assert (paper["low_90"], paper["high_90"]) == newcombe(202, 450, 204, 450, 0.9)
    assert paper["verdict"] == "not shown"
    assert (
        "A fall of Retrieval-FrameSamp-Modul of more than 5.0 points is excluded (90% interval of "
        "k7 − k0: −1.9 to +1.9)."
    ) in headlines(wide)["robomme"]


def test_retrieval_is_set_against_the_rows_without_it(tmp_path: Path) -> None:
    given = {(BASE, "k0"): "s" * 40 + "f" * 40, (BASE, "k7"): "f" * 80}
    given |= {(RETRIEVAL, "k0"): "s" * 40 + "f" * 40, (RETRIEVAL, "k7"): "s" * 40 + "f" * 39 + "e"}
    path = made.write_csv(tmp_path / "a.csv", cells(given))
    assert "equivalence" not in made.score(path).tables
    found = made.score(path, margin=10)
    verdicts = {
        (r["system"], r["condition"], r["against_system"], r["against_condition"]): r["verdict"]
        for r in records(found, "equivalence")
    }
    held = [r for r in records(found, "equivalence") if r["p_holm"] < 0.05]
    assert {r["verdict"] for r in held} == {"equivalent", "equivalent†"}
    assert verdicts == {
        (BASE, "k7", BASE, "k0"): "beyond",
        (RETRIEVAL, "k7", RETRIEVAL, "k0"): "equivalent†",
        (RETRIEVAL, "k0", BASE, "k0"): "equivalent",
        (RETRIEVAL, "k7", BASE, "k7"): "beyond†",
        (RETRIEVAL, "k7", BASE, "k0"): "equivalent†",
    }


def counted(both: int, lost: int, gained: int, neither: int) -> Pairs:
    outcomes = [(0, 0)] * both + [(0, 1)] * lost + [(1, 0)] * gained + [(1, 1)] * neither
    return pair(*np.array(outcomes, np.int8).reshape(-1, 2, 1).transpose(1, 0, 2))


def test_p_of_equivalence_by_hand() -> None:
    # The bound nearer to the margin reaches it at the level 1 − 2p.
    pairs = counted(20, 6, 5, 29)  # a fall of 1/60
    p = tost(pairs, 10)
    assert pairs.at(1 - 2 * p).low == pytest.approx(-0.1, abs=1e-6) and 0.05 < p < 0.5
    # Of a gain of a sixth, beyond the margin, it is the other bound, and p is above a half.
    pairs = counted(20, 0, 10, 30)
    p = tost(pairs, 5)
    assert pairs.at(1 - 2 * (1 - p)).low == pytest.approx(0.05, abs=1e-6) and p > 0.5
    assert math.isnan(tost(NO_PAIRS, 5))


@given(st.tuples(*[st.integers(0, 99)] * 4).filter(any), st.integers(1, 40))
def test_p_of_equivalence_agrees_with_the_verdict(
    counts: tuple[int, int, int, int], margin: int
) -> None:
    pairs = counted(*counts)
    p, found = tost(pairs, margin), verdict(pairs, margin)
    if min(abs(p - 0.05), abs(p - 0.95)) > 1e-6:
        assert found == (EQUIVALENT if p < 0.05 else BEYOND if p > 0.95 else OPEN)
    assert tost(pairs, margin + 1) <= p + 1e-9


@pytest.mark.parametrize("margin", [0, -1, 101, math.nan])
def test_a_margin_is_in_points(margin: float) -> None:
    with raises(InvalidOptionError):
        Settings((), margin=margin)


# --- planning ----------------------------------------------------------------------------------


def test_power_by_hand() -> None:
    # Of 6 episodes each flips one way or another with 0.5; six flips alike are found: 2/64 ≤ 0.05.
    # All six against the difference of 0.5 have 0; in its favor 0.5⁶.
    assert power(0.5, 6, 0.0) == pytest.approx(0.5**6)
    # With flips of 0.2: six of 0.6 in favor, or six of 0.1 against it.
    assert power(0.5, 6, 0.2) == pytest.approx(0.6**6 + 0.1**6)
    # Five alike are not enough: 2/32.
    assert power(1.0, 5, 0.0) == 0.0 and smallest(5, 0.0) is None


def test_a_plan_by_hand() -> None:
    found = plan(0.05, 450, 0.06)
    # 1.959964 · √(0.06/450), and about (1.644854 + 1.281552) · √(0.06/450)
    assert found.noise == pytest.approx(0.0226317, abs=1e-7)
    assert found.equal == pytest.approx(0.0337912, abs=0.002)
    # Without flips, the interval of 225, 0, 0 and 225.
    assert plan(0.05, 450, 0.0).equal == newcombe_paired(225, 0, 0, 225, 0.9)[1] > 0
    # The normal approximation, (1.959964 · √0.11 + 0.841621 · √(0.11 − 0.0025))² / 0.05² = 343,
    # has a power of 77% only.
    assert power(0.05, 343, 0.06) < 0.78
    assert power(0.05, found.needed, 0.06) >= 0.8 > power(0.05, found.needed - 1, 0.06)
    # All of six are the fewest that can be found at all.
    assert needed(1.0, 0.0) == 6
    # More than are summed over, by the approximation.
    assert needed(0.005, 0.06) == 20_803
    assert found.smallest is not None and found.smallest < 0.05 and found.power > 0.8
    assert power(found.smallest, 450, 0.06) == pytest.approx(0.8, abs=0.002)


def test_two_learned_systems_need_more_episodes_than_two_runs_of_one() -> None:
    assert (plan(0.05, 450).needed, plan(0.05, 450, 0.06).needed) == (975, 367)
    assert round(plan(0.05, 450).power, 2) == 0.46


def test_the_margin_of_equivalence_is_that_of_a_rate() -> None:
    # Where all others fail, the interval of no flips is that of Wilson's bound of 0 of 450.
    assert plan(0.05, 450, 0.0, rate=0.0).equal == newcombe_paired(0, 0, 0, 450, 0.9)[1]
    assert plan(0.05, 450, 0.06, rate=0.05).equal > plan(0.05, 450, 0.06).equal
    with raises(InvalidOptionError) as raised:
        plan(0.05, 450, 0.25, rate=0.05)
    assert raised.value.command is None


def test_training_runs_are_planned() -> None:
    planned = plan(0.1, 450, 0.25, runs=(3, 0.05)).runs
    # 0.25/450 + 2 · 0.05²/3 = 0.0022222; half: √(1.96² · 0.25/450 + 2.7764² · 2 · 0.05²/3).
    assert planned is not None
    half = (1.959964**2 * 0.25 / 450 + 2.776445**2 * 2 * 0.05**2 / 3) ** 0.5
    assert planned.smallest == pytest.approx(half + 0.841621 * 0.0022222**0.5, abs=1e-5)
    assert planned.power == pytest.approx(NormalDist().cdf((0.1 - half) / 0.0022222**0.5), abs=1e-4)
    assert planned.needed is not None
    enough, few = (
        plan(0.1, 450, runs=(n, 0.05)).runs for n in (planned.needed, planned.needed - 1)
    )
    assert enough is not None and few is not None and enough.power >= 0.8 > few.power
    assert plan(0.01, 450, runs=(3, 0.05)).runs.needed is None
    for runs in ((2, 0.05), (3, 0.0)):
        with raises(InvalidOptionError):
            plan(0.1, 450, runs=runs)


def test_flips_of_a_table_contain_the_difference() -> None:
    done = run("power", "--flips", "0.31", "--difference", "-6", "--json")
    assert json.loads(done.stdout)["flips"] == 0.25
    assert run("power", "--flips", "0.05", "--difference", "6").exit_code != 0


@given(st.integers(1, 200), st.floats(0, 0.5), st.floats(0.01, 0.5))
def test_power_is_a_probability_that_grows(episodes: int, flips: float, margin: float) -> None:
    found = power(margin, episodes, flips)
    assert -1e-9 <= found <= 1 + 1e-9
    assert found <= power(min(1 - flips, margin + 0.2), episodes, flips) + 1e-9


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((0.0, 450, 0.1), "margin 0.0"),
        ((0.05, 0, 0.1), "episodes 0"),
        ((0.05, 10**6, 0.1), "episodes 1000000"),
        ((0.05, 450, 1.1), "flips 1.1"),
        ((0.6, 450, 0.5), "more than all episodes"),
    ],
)
def test_what_cannot_be_planned(given: tuple[float, int, float], message: str) -> None:
    with pytest.raises(InvalidOptionError, match=message):
        plan(*given)


def test_power_on_the_command_line() -> None:
    words = ("power", "--margin", "5", "--episodes", "450", "--flips", "0.06")
    done = run(*words)
    assert done.exit_code == 0
    assert "±2.3 points" in done.stdout and " 367\n" in done.stdout
    assert plan(0.05, 2, 0.9).noise == 1  # no more than 100 points
    value = json.loads(run(*words, "--json").stdout)
    assert value["needed"] == 367 and value["margin"] == 0.05


def test_tables_tell_what_they_could_show(tmp_path: Path) -> None:
    # Ten gained and two lost of 40: 30% differ, and 12 of 12 would have a p of 2/2¹².
    given = {(BASE, "k0"): "f" * 10 + "ss" + "s" * 28, (BASE, "k7"): "s" * 10 + "ff" + "s" * 28}
    found = made.score(made.write_csv(tmp_path / "a.csv", cells(given)))
    end = found.tables["effects"].note.rpartition(". With 40 episodes, ")[2]
    least = float(re.findall(r"a difference of ([0-9.]+) points", end)[0]) / 100
    assert "30.0% differ" in end
    assert power(least, 40, 0.3 - least) == pytest.approx(0.8, abs=0.01)


def test_holms_correction_takes_power() -> None:
    alone, first = plan(0.05, 450, 0.06), plan(0.05, 450, 0.06, tests=66)
    assert first.power == power(0.05, 450, 0.06, 0.05 / 66) < alone.power
    assert first.needed > alone.needed and (first.smallest or 0) > (alone.smallest or 0)


def test_looks_spend_the_level() -> None:
    # The boundaries of Lan and DeMets like O'Brien and Fleming's for five looks, as in gsDesign.
    levels = look_levels(5)
    zs = [NormalDist().inv_cdf(1 - level / 2) for level in levels]
    assert zs == pytest.approx([4.877, 3.357, 2.680, 2.290, 2.031], abs=0.001)
    assert look_levels(1) == pytest.approx((0.05,))
    # Looking costs little power: the exact test at each level, of 5,000 made-up studies.
    alone, often = plan(0.05, 450, 0.06), plan(0.05, 450, 0.06, looks=5)
    assert often.looks == levels and alone.looks == ()
    assert alone.power - 0.06 < often.power < alone.power + 0.02
    done = run("power", "--flips", "0.06", "--looks", "5")
    last = done.stdout.splitlines()[-1]
    assert last.split() == [
        "look",
        "5",
        "after",
        "450",
        "episodes:",
        "significant",
        "if",
        "p",
        "holm",
        "is",
        "below",
        "0.042",
    ]
    with raises(InvalidOptionError):
        plan(0.05, 450, 0.06, looks=21)
