"""Comparisons by family: apart, with families weighing alike, and as a sample of such families."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import scoring as made

from robomme_interference_data.evaluate.score.compare import compare
from robomme_interference_data.evaluate.score.plots.data import Data
from robomme_interference_data.evaluate.score.tables.families import over_families

MOVE, PEG = made.FAMILIES


def test_a_sample_of_families_is_less_sure_than_these() -> None:
    # All of one family are gained, none of the other: within them nothing varies, but of two drawn
    # families both are the first, or the second, in a quarter of the draws each.
    values = np.array([1.0] * 12 + [0.0] * 12)[:, None]
    ((alike, *bounds, spread, p),) = over_families(values, np.repeat([3, 5], 12), "key")
    # Without either family, the mean is that of the other; their variance is 1/2.
    assert (alike, *bounds) == (0.5, 0.5, 0.5, 0.0, 1.0, 0.0, 1.0)
    assert spread == pytest.approx(np.sqrt(0.5))
    assert p == 1 / 2001  # nothing varies within families


def test_whether_families_differ_by_hand() -> None:
    # Means 1/2 and 0, residuals ±1/2, with n / (n − 1) ±√½. Sums of the flipped residuals are 0 in
    # half of the draws, and ±√2 in the others: as far as 1, which was observed.
    values = np.array([1.0, 0.0, 0.0, 0.0])[:, None]
    ((*_, low, high, spread, p),) = over_families(values, np.array([0, 0, 1, 1]), "key")
    assert p == pytest.approx(1 / 2, abs=0.04)
    # The variance of the means is 1/8, their noise on average 1/2 / 2 / 2 = 1/8.
    assert (low, high, spread) == (0, 0.5, 0)
    # Episodes that do not count change nothing.
    more = np.array([np.nan, 1.0, 0.0, 0.0, np.nan, 0.0])[:, None]
    assert over_families(more, np.repeat([0, 1], 3), "key") == over_families(
        values, np.array([0, 0, 1, 1]), "key"
    )
    # Where families are alike, every draw is as far apart.
    ((*_, p),) = over_families(np.ones((4, 1)), np.array([0, 1, 0, 1]), "key")
    assert p == 1.0


def test_families_that_never_ran_take_no_part_in_draws() -> None:
    numbers = np.random.default_rng(0)
    three = np.sign(numbers.normal([[-0.6], [0.0], [0.5]], size=(3, 50))).reshape(-1, 1)
    nine = np.concatenate([three, np.full((300, 1), np.nan)])
    labels = np.repeat(np.arange(9), 50)
    assert over_families(nine, labels, "key") == over_families(three, labels[:150], "key")
    # Beside a comparison of all nine, too.
    both = np.concatenate([nine, np.ones((450, 1))], axis=1)
    assert over_families(both, labels, "key")[0] == over_families(three, labels[:150], "key")[0]


def test_families_of_another_benchmark_are_scored_like_the_papers(tmp_path: Path) -> None:
    names = {"MoveCube": "ShellGame", "InsertPeg": "RememberColor"}
    rows = [replace(row, family=names[row.family], simulator="cue:make") for row in made.rows()]
    # One row of the paper's grid beside them: it comes first, then the others by name.
    rows.append(replace(made.rows()[0], simulator="cue:make", seed=99))
    own = made.score(made.write_parquet(tmp_path / "own.parquet", rows))
    paper = made.score(made.write_parquet(tmp_path / "paper.parquet", made.rows()))
    assert own.outcomes["cue:make"].families == ("MoveCube", "RememberColor", "ShellGame")
    rates = {
        (row["system"], row["condition"], row["part"]): (row["n"], row["successes"])
        for row in made.records(own, "parts", by="family")
    }
    for row in made.records(paper, "parts", by="family"):
        # Errors and missing rows included: 5 of 6, 2 of 5, 0 of 5, …
        key = (row["system"], row["condition"], names[row["part"]])
        assert rates[key] == (row["n"], row["successes"])
    of_own = made.records(own, "parts", part="ShellGame")
    assert of_own[0]["expected"] == made.EPISODES


def test_figures_and_comparisons_have_the_families_of_the_rows(tmp_path: Path) -> None:
    rows = [replace(row, family=f"Other{row.family}", simulator="cue:make") for row in made.rows()]
    path = made.write_parquet(tmp_path / "own.parquet", rows)
    data = Data(made.score(path), "cue:make")
    assert data.parts(data.families) == ["OtherInsertPeg", "OtherMoveCube"]
    found = compare(path, conditions=("k0", "k7")).table.records()
    assert {row["family"] for row in found} == {"all", "OtherInsertPeg", "OtherMoveCube"}
