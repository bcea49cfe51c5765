"""The logistic model within episodes: by hand, by refits, and where its true effects are known."""

import math
import re
import sys
from collections import defaultdict
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
from support import scoring as made
from support.scoring import BASE, OWN, cells, record, records, run

from robomme_interference_data.errors import MissingExtraError
from robomme_interference_data.evaluate.score.report.methods import methods
from robomme_interference_data.evaluate.score.tables.model import Fit, fit_within
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.stats.bootstrap import Floats

PAGE = Path(__file__).parents[2] / "docs" / "results" / "simulated-grids.md"


def scored(tmp_path: Path, outcomes: dict[tuple[str, str], str], **values: object) -> made.Score:
    rows = made.changed(cells(outcomes), **values)
    return made.score(made.write_csv(tmp_path / "a.csv", rows), model=True)


def test_of_two_conditions_it_is_the_ratio_of_gained_and_lost(tmp_path: Path) -> None:
    # 12 episodes gained and 4 lost: an odds ratio of 3. The score of an episode is 1/4 or −3/4, so
    # information and sum of squares are 16 · 3/16 = 3, and the variance is 1/3 · 16/15.
    outcomes = {
        (OWN, NO_HISTORY): "f" * 12 + "s" * 4 + "sf" * 9 + "e",
        (OWN, "k0"): "s" * 12 + "f" * 4 + "sf" * 9 + "s",
        ("oracle", NO_HISTORY): "s" * 35,
        ("oracle", "k0"): "s" * 35,
    }
    found = scored(tmp_path, outcomes)
    row = record(found, "model")  # references have no rows
    assert (row["system"], row["term"], row["episodes"]) == (OWN, "history", 16)
    assert row["odds_ratio"] == pytest.approx(3, rel=1e-6)
    error = math.sqrt(16 / 45)
    bounds = [3 * math.exp(sign * 1.959964 * error) for sign in (-1, 1)]
    assert [row["low"], row["high"]] == pytest.approx(bounds, rel=1e-4)
    assert row["p"] == pytest.approx(2 * scipy.stats.norm.sf(math.log(3) / error), rel=1e-4)
    assert row["sample_low"] is None and row["spread"] is None  # of one family
    assert {"chamberlain1980", "mackinnon2023"} <= {*re.findall(r"\w+", methods(found)[1])}


def test_without_a_finite_estimate_cells_are_empty(tmp_path: Path) -> None:
    # All twenty gain history and none loses it; of sessions 6 are lost and 2 gained.
    outcomes = {
        (OWN, NO_HISTORY): "f" * 20,
        (OWN, "k0"): "s" * 18 + "f" * 2,
        (OWN, "k7"): "f" * 6 + "s" * 14,
    }
    found = scored(tmp_path, outcomes, difficulty=None)
    rows = {one["term"]: one for one in records(found, "model")}
    assert [*rows] == ["history", "sessions"]  # no episode has a known difficulty
    assert {rows["history"][name] for name in ("odds_ratio", "low", "high", "p")} == {None}
    assert rows["sessions"]["odds_ratio"] < 1 and rows["sessions"]["p"] < 1


def test_too_few_episodes_have_no_estimate(tmp_path: Path) -> None:
    found = scored(tmp_path, {(BASE, "k0"): "sssss", (BASE, "k7"): "sffff"})
    assert {one["odds_ratio"] for one in records(found, "model")} == {None}
    assert {one["episodes"] for one in records(found, "model")} == {4}
    found = scored(tmp_path, {(BASE, "k0"): "sss", (BASE, "k7"): "e-e"})
    assert not found.tables.get("model")


def test_without_statsmodels_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = made.write_csv(tmp_path / "a.csv", made.rows())
    monkeypatch.setitem(sys.modules, "statsmodels.discrete.conditional_models", None)
    done = run("score", path, "--model", "--out", tmp_path / "o")
    assert isinstance(done.exception, MissingExtraError)
    assert "robomme-interference-data[model]" in (done.exception.hint or "")
    assert not (tmp_path / "o").exists()


# --- known effects -----------------------------------------------------------------------------

TRUE = np.array([1.0, -0.35, -0.1, -0.2])
"""Of history, sessions, and of sessions in medium and hard episodes beyond easy ones."""


def simulated(spread: float, seed: int) -> tuple[Floats, Fit]:
    """Fit a grid of the model: normal effects of episodes (sd 1.2) and families (0.8).

    Families differ by `spread` in the slope over sessions, as a standard deviation.
    """
    generator = np.random.default_rng(seed)
    episodes, families = np.tile(np.arange(450), 5), np.tile(np.arange(450) // 50, 5)
    history = np.repeat([0.0, 1, 1, 1, 1], 450)
    sessions, level = np.repeat([0.0, 0, 1, 2, 3], 450), episodes % 3
    columns = np.stack([history, sessions, sessions * (level == 1), sessions * (level == 2)], 1)
    odds = columns @ TRUE - 0.7 - 0.4 * level + generator.normal(0, 1.2, 450)[episodes]
    odds += generator.normal(0, 0.8, 9)[families]
    odds += generator.normal(0, spread, 9)[families] * sessions
    won = generator.random(len(odds)) < 1 / (1 + np.exp(-odds))
    return columns, fit_within(won, columns, episodes, families)


def test_the_effects_of_a_grid_are_found() -> None:
    _, fit = simulated(0.15, 1)
    assert fit.families == 9 and 250 < fit.episodes < 450
    assert (np.abs(fit.effects - TRUE) < 3.5 * fit.errors).all()
    assert (fit.errors < 0.25).all() and (fit.sample_errors < 0.35).all()
    assert 0 <= fit.spread[1] < 0.4


def test_the_jackknife_is_that_of_refits() -> None:
    generator = np.random.default_rng(3)
    episodes, families = np.tile(np.arange(180), 3), np.tile(np.arange(180) % 4, 3)
    columns = np.repeat([[0.0], [1.0], [2.0]], 180, axis=0)
    slopes = np.array([0.2, 0.4, 0.6, 1.0])[families]
    odds = generator.normal(size=180)[episodes] - slopes * columns[:, 0]
    won = generator.random(540) < 1 / (1 + np.exp(-odds))
    fit = fit_within(won, columns, episodes, families)
    changes = [
        fit_within(*(one[families != left] for one in (won, columns, episodes, families))).effects
        - fit.effects
        for left in range(4)
    ]
    expected = np.sqrt(3 / 4 * np.square(changes).sum(axis=0))
    assert fit.sample_errors == pytest.approx(expected, rel=0.05)


@cache
def coverage(spread: float, grids: int = 100) -> dict[str, Floats]:
    """Share of 95% intervals that hold the true effects, by kind."""
    held = defaultdict[str, list[Floats]](list)
    student = scipy.stats.t.ppf(0.975, 8)
    for grid in range(grids):
        _, fit = simulated(spread, grid)
        apart = np.abs(fit.effects - TRUE)
        held["these"].append(apart < 1.959964 * fit.errors)
        held["sample"].append(apart < student * fit.sample_errors)
    return {name: np.mean(one, axis=0) for name, one in held.items()}


@pytest.mark.slow
@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_the_intervals_hold_the_true_effects(spread: float) -> None:
    found = coverage(spread)
    kinds = [found["these"], found["sample"]]
    slopes = " | ".join(f"{100 * one[1]:.0f}%" for one in kinds)
    others = " | ".join(f"{100 * one[[0, 2, 3]].mean():.1f}%" for one in kinds)
    assert f"| {spread:g} | {slopes} | {others} |" in PAGE.read_text(encoding="utf-8")
    limit = 0.95 - 3 * math.sqrt(0.05 * 0.95 / 100)
    assert (found["sample"] >= limit).all()
    if not spread:
        assert (found["these"] >= limit).all()
