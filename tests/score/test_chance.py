"""Answers to questions: how far above chance they are, and how surely."""

from support.scoring import BLANK, OWN, records

from robomme_interference_data.evaluate.score.report.headline import headline
from robomme_interference_data.evaluate.score.scoring import Score


def test_bounds_neither_lead_nor_are_best(questions: Score) -> None:
    assert {r["system"] for r in records(questions, "main") if r["rank"]} == {OWN, BLANK}
    best = {r["system"]: r["best_system"] for r in records(questions, "main", condition="k0")}
    assert best[BLANK] == OWN
    # Of the three questions that count under k7, too.
    assert f"{OWN} succeeds in 66.7% at k0" in headline(questions, "questions")[0].text
    (grid,) = questions.grids
    assert "References, not ranked: Questions-Recall-Full." in grid.note
    # Of the three questions of k7, and of all four.
    assert "37.5% to 41.7%" in grid.note
