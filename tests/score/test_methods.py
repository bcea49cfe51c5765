"""The paragraph for a paper, and tables as LaTeX: true of the rows, and nothing cited in vain."""

import re
from pathlib import Path

import pytest
from support import scoring as made
from support.scoring import BASE, OWN

from robomme_interference_data.evaluate.score.report.methods import methods
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.viz.tables import Table


def cited(found: Score) -> set[str]:
    text, entries = methods(found)
    names = set(re.findall(r"@([a-z0-9]+)\]", text))
    assert set(re.findall(r"^@[a-z]+\{([a-z0-9]+),", entries, re.MULTILINE)) == names
    assert entries.count("{") == entries.count("}")
    return names


@pytest.mark.slow
def test_methods_are_those_of_the_rows(full: Score) -> None:
    text, _ = methods(full)
    assert text.startswith(
        "# Methods\n\nWe rolled out 12 systems (π0.5 (baseline), FrameSamp-Modul, "
    )
    for told in (
        "under 5 conditions of RoboMME-Interference [@rathi2026robommeinterference] ",
        "(no-history, k0, ",
        "25,200 rollouts of 450 episodes of 9 families.\n56 of 56 cells (system × condition) are "
        "complete.\nNo rollout ended with an error.",
        "The primary analysis compares k7 with k0",
        "not for other runs of the same training",
        "exact McNemar tests",
        "200 draws of episodes",
        "robomme-interference-data ",
    ):
        assert told in text
    names = cited(full)
    assert {"wilson1927", "mcnemar1947", "holm1979", "fieller1954", "newcombe1998"} <= names
    assert "davison1997" in names  # of several families
    assert not {"fisher1935", "schuirmann1987"} & names  # no repeats, no margin


def test_methods_of_part_of_a_grid_with_repeats(tmp_path: Path) -> None:
    rows = [row for row in made.rows() if row.system in (BASE, OWN)]
    both = made.write_parquet(tmp_path / "a.parquet", [*rows, *made.changed(rows, model_seed=1)])
    found = made.score(both, margin=5.0)
    text, _ = methods(found)
    for told in (
        "with 2 model seeds",
        "6 of 10 cells",
        "2 rollouts ended with an error",
        "of 5 points",
    ):
        assert told in text
    assert {"fisher1935", "kish1965", "schuirmann1987"} <= cited(found)


def test_tables_as_latex() -> None:
    rows = [("a_b & 5%", 0.4489, -0.03, "**1.0%**†"), ("π", None, float("nan"), "–")]
    table = Table(
        "t",
        "Title",
        {"system": "text", "rate": "rate", "low": "points", "best": "text"},
        rows,
        "A note.",
    )
    assert table.latex() == (
        "% Title\n\\begin{tabular}{lrrl}\n\\toprule\nsystem & rate & low & best \\\\\n\\midrule\n"
        "a\\_b \\& 5\\% & 44.9\\% & $-$3.0 & \\textbf{1.0\\%}\\textdagger{} \\\\\n"
        "$\\pi$ &  &  & -- \\\\\n\\bottomrule\n\\end{tabular}\n% A note.\n"
    )
