"""Trends over k, and whether they are straight lines."""

from pathlib import Path

import numpy as np
import pytest
from support import scoring as made
from support.scoring import BASE, OWN, cells, record, records

from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.stats.bootstrap import residual_weights, slope_weights


def scored(tmp_path: Path, rates: dict[tuple[str, str], int], of: int = 30) -> Score:
    """Score rates, where what fails under one condition also fails under lower ones."""
    outcomes = {cell: "s" * won + "f" * (of - won) for cell, won in rates.items()}
    return made.score(made.write_parquet(tmp_path / "a.parquet", cells(outcomes)), draws=2000)


def test_a_line_departs_from_no_line() -> None:
    matrix = residual_weights([0, 1, 3, 7])
    for line in ([1, 1, 1, 1], [0, 1, 2, 3]):
        assert matrix @ np.array(line, float) == pytest.approx([0, 0, 0, 0])
    # A fall from k0 to k1 alone: of (1, 0, 0, 0) the line 0.7, 0.4, 0.1, −0.2.
    assert matrix @ np.array([1.0, 0, 0, 0]) == pytest.approx([0.3, -0.4, -0.1, 0.2])
    assert slope_weights([0, 1, 3, 7]) == pytest.approx([-0.3, -0.1, 0.1, 0.3])


def test_a_step_is_a_trend_but_no_line(tmp_path: Path) -> None:
    step = {(BASE, "k0"): 20, (BASE, "k1"): 4, (BASE, "k3"): 4, (BASE, "k7"): 4}
    line = {(OWN, "k0"): 24, (OWN, "k1"): 18, (OWN, "k3"): 12, (OWN, "k7"): 6}
    found = scored(tmp_path, step | line)
    own, base = record(found, "decay", system=OWN), record(found, "decay", system=BASE)
    # Sixteen fall and none rises: 2/2¹⁶, and of 2,000 draws hardly one besides the observed.
    assert base["slope"] == pytest.approx(-0.3 * 16 / 30)
    assert base["p"] <= 3 / 2001 and base["p_holm"] == pytest.approx(2 * base["p"], abs=1 / 2001)
    # All sixteen depart from a line in the same way: as improbable.
    assert base["p_fit"] <= 3 / 2001
    # Six episodes fall at each of three steps: the mean departure is zero.
    assert own["p"] <= 3 / 2001 and own["p_fit"] == 1
    # Neither are the two parallel: the difference departs from a line too.
    row = record(found, "interaction")
    assert 3 / 2001 < row["p_fit"] < 0.05


def test_two_conditions_are_always_on_a_line(tmp_path: Path) -> None:
    found = scored(tmp_path, {(BASE, "k0"): 9, (BASE, "k7"): 3, (OWN, "k0"): 9, (OWN, "k7"): 9})
    assert {one["p_fit"] for one in records(found, "decay")} == {None}
    assert record(found, "interaction")["p_fit"] is None
    assert record(found, "decay", system=OWN)["p"] == 1
