"""Answers to questions: how far above chance they are, and how surely."""

import pytest
from support.scoring import BLANK, OWN, RECALL, record, records

from robomme_interference_data.evaluate.score.report.headline import headline
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.stats.intervals import wilson


def test_right_answers_are_set_against_guesses(questions: Score) -> None:
    own = record(questions, "chance", system=OWN, condition="k0")
    assert (own["n"], own["rate"], own["chance"], own["p"]) == (4, 0.75, 3 / 8, 9 / 64)
    # (3/4 − 3/8) / (5/8), and the same of the interval's ends.
    low, high = wilson(3, 4)
    expected = [0.6, (low - 0.375) / 0.625, (high - 0.375) / 0.625]
    assert [own["above"], own["low"], own["high"]] == pytest.approx(expected)
    # Of the three that count two are right: (3 + 7 x + 5 x² + x³) / 16.
    part = record(questions, "chance", system=OWN, condition="k7")
    assert (part["n"], part["p"], part["complete"]) == (3, 6 / 16, False)
    assert part["chance"] == pytest.approx(5 / 12)
    rest = {r["system"]: (r["above"], r["p"]) for r in questions.tables["chance"].records()}
    assert rest[RECALL] == (1.0, 1 / 64) and rest[BLANK] == (pytest.approx(-0.6), 1.0)
    # In the order of the table: 31/64 of two right, and five tests.
    assert [r["p_holm"] for r in records(questions, "chance")] == [
        *(5 / 64, 1.0, 4 * 9 / 64, 1.0, 1.0)
    ]


def test_bounds_neither_lead_nor_are_best(questions: Score) -> None:
    assert {r["system"] for r in records(questions, "main") if r["rank"]} == {OWN, BLANK}
    assert {r["system"] for r in records(questions, "systems")} == {BLANK}
    assert headline(questions, "questions").startswith(f"{OWN} succeeds in 75.0% of 4")
    (grid,) = questions.grids
    assert "bounds: Questions-Recall-Full." in grid.note
    # Of the three questions of k7, and of all four.
    assert "Guessing would have 37.5% to 41.7%" in grid.note
