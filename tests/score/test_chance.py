"""Answers to questions: how far above chance they are, and how surely."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from support import scoring as made
from support.scoring import OWN, cells, record, records

from robomme_interference_data.errors import BadRowsError
from robomme_interference_data.evaluate.score.plots.curves import Data
from robomme_interference_data.evaluate.score.plots.figures import draw_figure
from robomme_interference_data.evaluate.score.report.headline import headline
from robomme_interference_data.evaluate.score.report.methods import methods
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.schema.rollouts import Rollout
from robomme_interference_data.stats.intervals import wilson
from robomme_interference_data.viz.figure import open_figure

GOLDEN = made.ROOT / "tests" / "golden" / "score-questions"

# Two questions of two options, then two of four. The right guesses are of the chances
# (1/2 + x/2)² (3/4 + x/4)² = (9 + 24 x + 22 x² + 8 x³ + x⁴) / 64.
CHANCES = (1 / 2, 1 / 2, 1 / 4, 1 / 4)
BLANK, RECALL = f"{OWN}-blank", "questions-recall-full"
OUTCOMES = {
    (RECALL, "k0"): "ssss",
    (OWN, NO_HISTORY): "ssff",
    (OWN, "k0"): "sssf",
    (OWN, "k7"): "ssef",
    (BLANK, "k0"): "ffff",
}


def answers(outcomes: Mapping[tuple[str, str], str], seed: int = 0) -> list[Rollout]:
    """Rows of answers: an error tells no chance."""
    return [
        replace(
            row,
            simulator="questions",
            steps=0,
            chance=None if row.status == "error" else CHANCES[row.episode],
        )
        for row in cells(outcomes, seed)
    ]


def scored(tmp_path: Path, rows: list[Rollout]) -> Score:
    return made.score(made.write_parquet(tmp_path / "a.parquet", rows))


@pytest.fixture
def asked(tmp_path: Path) -> Score:
    return scored(tmp_path, answers(OUTCOMES))


def test_right_answers_are_set_against_guesses(asked: Score) -> None:
    own = record(asked, "chance", system=OWN, condition="k0")
    assert (own["n"], own["rate"], own["chance"], own["p"]) == (4, 0.75, 3 / 8, 9 / 64)
    # (3/4 − 3/8) / (5/8), and the same of the interval's ends.
    low, high = wilson(3, 4)
    expected = [0.6, (low - 0.375) / 0.625, (high - 0.375) / 0.625]
    assert [own["above"], own["low"], own["high"]] == pytest.approx(expected)
    # Of the three that count two are right: (3 + 7 x + 5 x² + x³) / 16.
    part = record(asked, "chance", system=OWN, condition="k7")
    assert (part["n"], part["p"], part["complete"]) == (3, 6 / 16, False)
    assert part["chance"] == pytest.approx(5 / 12)
    rest = {r["system"]: (r["above"], r["p"]) for r in asked.tables["chance"].records()}
    assert rest[RECALL] == (1.0, 1 / 64) and rest[BLANK] == (pytest.approx(-0.6), 1.0)
    # In the order of the table: 31/64 of two right, and five tests.
    assert [r["p_holm"] for r in records(asked, "chance")] == [*(5 / 64, 1.0, 4 * 9 / 64, 1.0, 1.0)]


def test_a_repeated_question_is_one_guess(tmp_path: Path) -> None:
    rows = answers({(OWN, "k0"): "sssf"}) + answers({(OWN, "k0"): "ssff"}, seed=1)
    found = scored(tmp_path, rows)
    # 1 + 1 + 1/2 + 0, rounded down.
    assert (record(found, "chance")["rate"], record(found, "chance")["p"]) == (2.5 / 4, 31 / 64)
    assert "repeats" in found.tables["chance"].note


def test_only_cells_of_questions_are_set_against_chance(tmp_path: Path) -> None:
    assert "chance" not in scored(tmp_path, cells(OUTCOMES)).tables
    given = [
        replace(row, chance=None) if row.episode == 3 else row
        for row in answers({(OWN, "k0"): "sssf", (OWN, "k1"): "sss-"})
    ]
    found = scored(tmp_path, given)
    assert [r["condition"] for r in records(found, "chance")] == ["k1"]


def test_a_chance_of_one_leaves_nothing(tmp_path: Path) -> None:
    rows = made.changed(answers({(OWN, "k0"): "ss"}), chance=1.0)
    found = record(scored(tmp_path, rows), "chance")
    assert (found["above"], found["p"]) == (None, 1.0)


def test_an_episode_has_one_chance(tmp_path: Path) -> None:
    rows = answers({(OWN, "k0"): "sf", (OWN, "k1"): "sf"})
    rows[-1] = replace(rows[-1], chance=0.2)
    with pytest.raises(BadRowsError, match="line 5: chance 0.2 beside 0.5: an episode has one"):
        made.score(made.write_csv(tmp_path / "a.csv", rows))


def test_bounds_neither_lead_nor_are_best(asked: Score) -> None:
    assert {r["system"] for r in records(asked, "main") if r["rank"]} == {OWN, BLANK}
    assert {r["system"] for r in records(asked, "systems")} == {BLANK}
    assert headline(asked, "questions").startswith(f"{OWN} succeeds in 75.0% of 4")
    (grid,) = asked.grids
    assert "bounds: Questions-Recall-Full." in grid.note
    # Of the three questions of k7, and of all four.
    assert "Guessing would have 37.5% to 41.7%" in grid.note


def test_figures_draw_the_chance_level(tmp_path: Path, asked: Score) -> None:
    def levels(found: Score, kind: str) -> list[list[float]]:
        """By panel: the heights of the lines named chance."""
        with open_figure() as figure:
            assert draw_figure(kind, figure, Data(found, found.cells[0].simulator))
            heights = []
            for axes in (axes for axes in figure.axes if axes.axison):
                across = [line for line in axes.lines if [*line.get_xdata()] == [0, 1]]
                heights.append([line.get_ydata()[0] for line in across])
                names = [text.get_text() for text in axes.texts]
                assert names.count("chance") == len(across)
            return heights

    assert levels(asked, "success") == [[37.5]]
    # Two episodes each, easy and medium.
    assert levels(asked, "difficulty") == [[50.0], [25.0]]
    assert levels(scored(tmp_path, cells(OUTCOMES)), "success") == [[]]


def test_methods_tell_of_answers_where_something_was_asked(tmp_path: Path, asked: Score) -> None:
    text, entries = methods(asked)
    assert "We asked 3 systems (Questions-Recall-Full, my-memory, my-memory-blank) about" in text
    assert "20 answers of 4 episodes" in text
    assert "@hong2013" in text and "{hong2013," in entries
    text, _ = methods(scored(tmp_path, cells(OUTCOMES)))
    assert "We rolled out 3 systems" in text and "@hong2013" not in text and "answer" not in text


def test_tables_are_those_of_the_golden_files(asked: Score) -> None:
    table, (grid,) = asked.tables["chance"], asked.grids
    written = {"chance.csv": table.csv(), "chance.md": table.markdown(), "main.md": grid.markdown()}
    golden = {path.name: path.read_text(encoding="utf-8") for path in GOLDEN.iterdir()}
    assert written == golden
