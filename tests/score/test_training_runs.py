"""Training runs as a random effect, and errors that could change what is shown."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from support import scoring as made
from support.messages import raises
from support.null_rows import NullGrid
from support.scoring import BASE, OWN, cells, record, records

from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.score.compare import compare
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.stats.bootstrap import Interval
from robomme_interference_data.stats.runs import (
    ONE_RUN,
    RunSpread,
    independent,
    run_spread,
    student_quantile,
    student_tails,
)

# --- by hand -----------------------------------------------------------------------------------


@pytest.mark.parametrize("freedom", [1.0, 2.0, 2.3, 4.0, 17.5, 400.0])
@pytest.mark.parametrize("level", [0.01, 0.5, 0.95, 0.9999])
def test_students_t_is_that_of_scipy(freedom: float, level: float) -> None:
    t = stats.t.ppf((1 + level) / 2, freedom)
    assert student_quantile(level, freedom) == pytest.approx(t, rel=1e-7)
    assert student_tails(t, freedom) == pytest.approx(1 - level, rel=1e-7)


def test_the_variance_that_runs_add() -> None:
    # Means 1/2, 1/2 and 0; their variance 1/12. Residuals: of rows (1, 1, 0), (1, 0, 0), (0, 1, 0),
    # (0, 0, 0) the squares sum to 8/12 over 2 · 3, so 1/9; (1/12 − 1/36) / 3 = 1/54.
    values = np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    found = run_spread(values)
    residuals = values - values.mean(0) - values.mean(1, keepdims=True) + values.mean()
    noise = (residuals**2).sum() / 6
    assert (found.runs, found.freedom) == (3, 2)
    assert found.deviation == pytest.approx(math.sqrt(1 / 12))
    assert found.variance == pytest.approx((1 / 12 - noise / 4) / 3)
    # An episode that a run lacks takes part in the weights alone: 4/15 + 1/10 twice, and 4/15.
    lacking = run_spread(np.vstack([values, [1.0, math.nan, 1.0]]))
    weights = (11 / 30) ** 2 * 2 + (4 / 15) ** 2
    assert lacking.variance == pytest.approx(found.variance * 3 * weights)
    assert lacking.deviation == found.deviation
    # Runs that share the episodes out: the means 1, 1/2 and 0, with nothing subtracted.
    apart = np.full((6, 3), math.nan)
    apart[[0, 1], 0], apart[[2, 3], 1], apart[[4, 5], 2] = 1.0, (0.0, 1.0), 0.0
    assert run_spread(apart).variance == pytest.approx(1 / 4 / 3)
    assert run_spread(apart).freedom == 2
    # Two runs add nothing: what holds is for their checkpoints.
    assert run_spread(values[:, 1:]) == RunSpread(2, pytest.approx(math.sqrt(1 / 8)))
    # Equal runs, and a single one.
    assert run_spread(values[:, [0, 0, 0]]) == RunSpread(3, 0.0)
    assert repr(run_spread(values[:, :1])) == repr(ONE_RUN)


def test_an_interval_is_widened_by_runs() -> None:
    spread = RunSpread(3, 0.05, 0.0004, 2)
    # Student's t of two degrees is 4.302653.
    down, up = ((half**2 + 4.302653**2 * 0.0004) ** 0.5 for half in (0.03, 0.04))
    found = spread.widen(Interval(0.1, 0.07, 0.14), 0.95)
    assert found == pytest.approx((0.1, 0.1 - down, 0.1 + up), abs=1e-7)
    assert spread.widen(Interval(0.1), 0.95)[0] == 0.1 and math.isnan(
        spread.widen(Interval(0.1), 0.95).low
    )
    assert ONE_RUN.widen(Interval(0.1, 0.0, 0.2), 0.95) == (0.1, 0.0, 0.2)


def test_p_is_that_of_the_interval_that_ends_at_zero() -> None:
    spread = RunSpread(3, 0.05, 0.0004, 2)

    def at(level: float) -> Interval:
        half = 0.01 * stats.norm.ppf((1 + level) / 2)
        return Interval(0.1, 0.1 - half, 0.1 + half)

    p = spread.p(at, 0.0)
    assert spread.widen(at(1 - p), 1 - p).low == pytest.approx(0, abs=1e-5)
    # Nothing but runs: Student's t of 0.1 / 0.02 with two degrees.
    assert spread.p(lambda _: Interval(0.1, 0.1, 0.1), 0.0) == pytest.approx(
        2 * stats.t.sf(5, 2), rel=1e-3
    )
    assert spread.p(at, 0.4) == 0.4  # never less than for fixed runs
    assert ONE_RUN.p(at, 0.01) == 0.01


def test_unrelated_runs_add_up_as_in_welchs_test() -> None:
    first, second = RunSpread(3, 0.1, 0.003, 2), RunSpread(5, 0.1, 0.001, 4)
    found = independent(first, second)
    assert (found.runs, found.variance) == (3, pytest.approx(0.004))
    assert found.freedom == pytest.approx(0.004**2 / (0.003**2 / 2 + 0.001**2 / 4))
    assert independent(first, ONE_RUN).freedom == pytest.approx(2)
    assert independent(ONE_RUN, ONE_RUN).variance == 0


# --- rows --------------------------------------------------------------------------------------


def trained(letters: dict[int, dict[str, str]], system: str = OWN) -> list[Rollout]:
    """Rows of training runs: by training seed and condition an episode a letter."""
    return [
        replace(row, training_seed=seed, policy="python", policy_id=f"{system} {seed}")
        for seed, outcomes in letters.items()
        for row in cells({(system, name): text for name, text in outcomes.items()})
    ]


def scored(folder: Path, rows: list[Rollout]) -> Score:
    return made.score(made.write_parquet(folder / "rows.parquet", rows), draws=2000)


GOOD, MIDDLE, BAD = "s" * 24 + "f" * 6, "s" * 18 + "f" * 12, "s" * 12 + "f" * 18


def test_runs_of_a_system_widen_its_interval(tmp_path: Path) -> None:
    runs = {seed: {"k0": letters} for seed, letters in enumerate((GOOD, MIDDLE, BAD))}
    several = record(scored(tmp_path, trained(runs)), "main", condition="k0")
    assert (several["runs"], several["scope"], several["rate"]) == (3, "training runs", 0.6)
    assert several["run_spread"] == pytest.approx(0.2)
    # Two runs, or the same rows as repeats of one: for these weights alone.
    two = record(scored(tmp_path, trained({0: runs[0], 1: runs[2]})), "main", condition="k0")
    assert (two["runs"], two["scope"]) == (2, "checkpoint")
    repeats = [
        replace(row, training_seed=0, policy_id="one", model_seed=row.training_seed)
        for row in trained(runs)
    ]
    one = record(scored(tmp_path, repeats), "main", condition="k0")
    assert (one["runs"], one["scope"], one["run_spread"]) == (1, "checkpoint", None)
    assert several["low"] < one["low"] and one["high"] < several["high"]
    assert several["high"] <= 1


def test_runs_of_a_system_are_paired_and_those_of_two_are_not(tmp_path: Path) -> None:
    # Each run loses the same six episodes, whatever its rate.
    falls = {
        seed: {"k0": letters, "k7": letters.replace("ssssss", "ffffff", 1)}
        for seed, letters in enumerate((GOOD, MIDDLE, BAD))
    }
    rows = trained(falls)
    found = scored(tmp_path, [*rows, *trained(falls, "other")])
    for system in (OWN, "other"):
        fall = record(found, "effects", system=system, effect="sessions")
        assert (fall["difference"], fall["runs"], fall["scope"]) == (-0.2, 3, "training runs")
        assert fall["primary"] and fall["p"] == 2 / 2**6  # no run falls otherwise than the others
    between = record(found, "matrix", condition="k0")
    assert (between["difference"], between["p"]) == (0, 1)
    assert between["low"] < -0.3 and between["high"] > 0.3
    # The command agrees, over two files.
    own = made.write_parquet(tmp_path / "own.parquet", rows)
    other = made.write_parquet(tmp_path / "other.parquet", trained(falls, "other"))
    table = compare(other, own).table
    of_command = {row["condition"]: row for row in table.records() if row["family"] == "all"}
    assert abs(of_command["k0"]["low"]) == pytest.approx(abs(between["low"]))
    assert of_command["k0"]["scope"] == "training runs"


def test_only_runs_of_both_conditions_are_compared(tmp_path: Path) -> None:
    runs = {0: {"k0": GOOD, "k7": MIDDLE}, 1: {"k0": BAD}, 2: {"k0": BAD}}
    fall = record(scored(tmp_path, trained(runs)), "effects", effect="sessions")
    assert (fall["against_rate"], fall["rate"], fall["runs"]) == (0.8, 0.6, 1)
    assert fall["scope"] == "checkpoint"


def test_a_training_seed_tells_rollouts_apart(tmp_path: Path) -> None:
    rows = trained({0: {"k0": "ss"}, 1: {"k0": "sf"}})
    assert len(scored(tmp_path, rows).rows) == 4
    # Rows without one are of a single run.
    unknown = made.changed(cells({(OWN, "k0"): "sf"}), training_seed=None)
    assert record(scored(tmp_path, unknown), "main", condition="k0")["runs"] == 1


def test_weights_of_different_steps_are_not_one_system(tmp_path: Path) -> None:
    """Also of different training runs; what most rows have counts."""
    rows = trained({seed: {"k0": "ssff"} for seed in range(3)})
    mixed = [replace(row, training_step=500 if row.training_seed == 2 else 600) for row in rows]
    path = made.write_parquet(tmp_path / "mixed.parquet", mixed)
    with raises(FormatError):
        read_rows([path])
    found = read_rows([path], lenient=True)
    assert found.bad_count == 4 and {row.training_step for row in found.rows} == {600}


# --- errors ------------------------------------------------------------------------------------


def test_errors_bound_a_difference_and_may_leave_no_verdict(tmp_path: Path) -> None:
    # Twelve of twelve that finished are kept at k7, if eight errors were failures none is shown.
    outcomes = {(OWN, "k0"): "s" * 8 + "f" * 12, (OWN, "k7"): "s" * 8 + "e" * 8 + "s" * 4}
    fall = record(scored(tmp_path, cells(outcomes)), "effects", effect="sessions")
    # 12 of 12 against 8 of 12; of 20 episodes 12 (or 20) against 8.
    assert (fall["n"], fall["difference"]) == (12, pytest.approx(4 / 12))
    assert (fall["if_failures"], fall["if_successes"]) == (pytest.approx(0.2), pytest.approx(0.6))
    # p is 2/2⁴ twice, and 2/2¹² if they were successes.
    assert fall["p"] == 0.125 and fall["verdict"] == "depends on errors"
    cell = record(scored(tmp_path, cells(outcomes)), "main", condition="k7")
    assert (cell["rate"], cell["if_errors_fail"], cell["if_errors_succeed"]) == (1, 0.6, 1)
    assert record(scored(tmp_path, cells(outcomes)), "decay")["verdict"] == "depends on errors"


def test_errors_that_change_nothing_leave_the_verdict(tmp_path: Path) -> None:
    outcomes = {(OWN, "k0"): "s" * 20, (OWN, "k7"): "f" * 19 + "e"}
    found = scored(tmp_path, cells(outcomes))
    fall = record(found, "effects", effect="sessions")
    assert (fall["verdict"], fall["if_successes"]) == ("shown", -0.95)
    assert record(found, "decay")["verdict"] == "shown"


def test_errors_bound_the_difference_of_two_falls(tmp_path: Path) -> None:
    outcomes = {
        (OWN, "k0"): "s" * 20,
        (OWN, "k7"): "s" * 10 + "e" * 10,
        ("other", "k0"): "s" * 20,
        ("other", "k7"): "s" * 20,
    }
    row = record(scored(tmp_path, cells(outcomes)), "interaction")
    # Over three doublings the other system does not fall, and this one by none or half.
    assert (row["difference"], row["if_successes"]) == (0, 0)
    assert abs(row["if_failures"]) == pytest.approx(0.5 / 3)
    assert row["verdict"] == "depends on errors"


# --- simulations -------------------------------------------------------------------------------

GRIDS = 60

# Runs, and the standard deviation of their rates. `benchmarks/null_scores.py` has all cases.
CASES = [(3, 0.0), (3, 0.1), (5, 0.05)]


@pytest.mark.slow
@pytest.mark.parametrize(("runs", "spread"), CASES)
def test_equal_systems_with_training_runs_seldom_differ(
    tmp_path: Path, runs: int, spread: float
) -> None:
    """Size at most 7%, and coverage at least 92%, less the error of 60 grids of four systems."""
    grid = NullGrid(runs=runs, spread=spread)
    names = ("effects", "matrix", "interaction")
    held, found = list[bool](), {name: list[bool]() for name in names}
    for number in range(GRIDS):
        path = grid.write(tmp_path / "rows.parquet", f"{grid}, {number}")
        score = made.score(path)
        held += [row["low"] <= 0.3 <= row["high"] for row in records(score, "main")]
        for name, of_table in found.items():
            of_table += [row["p"] < 0.05 for row in records(score, name)]
    # Comparisons of a grid share episodes and systems: four of each are counted as independent.
    error = 3 * math.sqrt(0.06 * 0.94 / (4 * GRIDS))
    assert sum(held) / len(held) >= 0.92 - error
    for name, of_table in found.items():
        assert sum(of_table) / len(of_table) <= 0.07 + error, name


def test_a_fall_is_not_complete_if_a_run_lacks_one_of_its_conditions(tmp_path: Path) -> None:
    letters = {("k0", 0): "ss", ("k0", 1): "ss", ("k0", 2): "ff", ("k7", 0): "sf", ("k7", 1): "sf"}
    rows = [
        replace(made.row("alpha", condition, "MoveCube", at, letter), training_seed=run)
        for (condition, run), text in letters.items()
        for at, letter in enumerate(text)
    ]
    scored = made.score(made.write_parquet(tmp_path / "rows.parquet", rows), expected=OWN)
    [fall] = records(scored, "effects")
    assert (fall["runs"], fall["against_rate"], fall["rate"]) == (2, 1.0, 0.5)
    assert not fall["complete"]


def test_conditions_of_different_training_runs_are_not_compared(tmp_path: Path) -> None:
    """k0 of one run and k7 of another are not a fall of either."""
    pair = [row for row in made.rows() if row.condition in ("k0", "k7")]
    apart = [
        replace(row, training_seed=0 if row.condition == "k0" else 1)
        for row in pair
        if row.system == BASE
    ]
    same = [replace(row, system="same", training_seed=0) for row in pair if row.system == BASE]
    found = made.score(made.write_csv(tmp_path / "rows.csv", [*apart, *same]), draws=200)
    effects = {row["system"]: row for row in records(found, "effects")}
    assert (effects[BASE]["n"], effects[BASE]["difference"], effects[BASE]["p"]) == (0, None, None)
    assert effects["same"]["n"] > 0 and effects["same"]["difference"] is not None
    assert [row["system"] for row in records(found, "decay")] == ["same"]
    assert "interaction" not in found.tables


def test_rows_without_a_training_seed_beside_others_are_noted(tmp_path: Path) -> None:
    rows = [row for row in made.rows() if row.system == BASE]
    mixed = [replace(row, training_seed=3, system=OWN) for row in rows]
    mixed[:4] = [replace(row, training_seed=None) for row in mixed[:4]]
    found = made.score(made.write_csv(tmp_path / "rows.csv", [*rows, *mixed]), draws=200)
    [note] = [note for note in found.notes if "training_seed" in note]
    assert display_name(OWN) in note and display_name(BASE) not in note.replace(
        display_name(OWN), ""
    )
