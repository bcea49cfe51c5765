"""Steps to success: of successes, and compared where both sides succeed."""

from dataclasses import replace
from pathlib import Path

import pytest
from support import scoring as made
from support.scoring import OWN, cells, record, records

from robomme_interference_data.schema.rollouts import Rollout


def taken(condition: str, letters: str, steps: list[int], seed: int = 0) -> list[Rollout]:
    rows = cells({(OWN, condition): letters}, seed)
    return [replace(row, steps=n) for row, n in zip(rows, steps, strict=True)]


def test_steps_are_of_successes_and_compared_where_both_succeed(tmp_path: Path) -> None:
    rows = taken("k0", "sssf", [10, 20, 60, 900]) + taken("k7", "ssfs", [30, 10, 999, 500])
    found = made.score(made.write_csv(tmp_path / "a.csv", rows))
    start, later = (record(found, "steps", condition=c) for c in ("k0", "k7"))
    assert (start["n"], start["median"], start["mean"]) == (3, 20, 30)
    assert start["difference"] is None and start["p"] is None
    assert (later["n"], later["median"], later["mean"]) == (3, 30, 180)
    # Episodes 0 and 1: 20 more and 10 fewer. Any signs of 20 and 10 are 10 or more from 0.
    assert (later["pairs"], later["difference"]) == (2, 5)
    assert later["p"] == later["p_holm"] == 1
    assert later["low"] is None  # fewer than ten differ


def test_repeats_count_with_the_mean_of_their_successes(tmp_path: Path) -> None:
    rows = taken("k0", "ss", [10, 20]) + taken("k0", "sf", [30, 999], seed=1)
    found = made.score(made.write_csv(tmp_path / "a.csv", rows))
    assert record(found, "steps")["mean"] == 20


def test_slower_successes_are_found(tmp_path: Path) -> None:
    rows = taken("k0", "s" * 20, [100] * 20) + taken("k7", "s" * 20, [*range(101, 121)])
    found = made.score(made.write_csv(tmp_path / "a.csv", rows), draws=2000)
    row = record(found, "steps", condition="k7")
    assert row["difference"] == pytest.approx(10.5) and row["p"] <= 2 / 2001
    assert 0 < row["low"] < 10.5 < row["high"]


def test_answers_take_no_steps(questions: made.Score, small: made.Score) -> None:
    assert "steps" not in questions.tables
    assert len(records(small, "steps")) == 9
