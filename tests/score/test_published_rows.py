"""Every file of rows in the repository scores, and so do the files that the paper released."""

import csv
from pathlib import Path

import pytest
from support import scoring as made
from support.messages import raises
from support.pages import RESULTS

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.score.config import Expected
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.evaluate.score.tables.paper import differing
from robomme_interference_data.evaluate.systems import SYSTEMS

RATES = made.RELEASED.parent / "by_family_condition.csv"
NO_ROWS = {
    "day/ceilings.csv",
    "day/retrieval.csv",
    "day/shortcuts.csv",
    "day/spans.csv",
    "robomme/ceilings.csv",
    "robomme/lessons.parquet",
    "robomme/shortcuts.csv",
    "tabletop/encoders.csv",
    "training/rates.csv",
}
FILES = [
    path
    for path in sorted(RESULTS.rglob("*.*"))
    if path.suffix in (".csv", ".parquet") and path.relative_to(RESULTS).as_posix() not in NO_ROWS
]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(RESULTS).as_posix())
def test_rows_in_the_repository_score(path: Path) -> None:
    """Without options beside the grid, and with as few draws as there can be."""
    found = made.score(path, draws=2)
    assert found.rows.bad_count == 0 and found.tables["main"].rows


def test_outcomes_of_rows_with_a_status_alone() -> None:
    found = made.score(RESULTS / "robomme/rollouts.parquet", draws=2)
    counts = {
        (row["system"], row["condition"]): (row["successes"], row["n"], row["errors"])
        for row in made.records(found, "main")
        if row["n"]
    }
    assert counts["oracle", "no-history"] == (449, 450, 0)
    assert counts["recall-window", "k1"] == (16, 90, 0)
    assert counts["follow-subgoals-oracle-simple", "no-history"] == (31, 44, 1)


HEADER = "variant,family,condition,episode,difficulty,success,status,seed,steps,notes"
"""Columns that the analysis of the paper reads, then others, whose values are not known."""


def canonical(folder: Path, lines: list[str]) -> Path:
    path = folder / "canonical_rollouts.csv"
    path.write_text("\n".join([HEADER, *lines]) + "\n")
    return path


@pytest.mark.parametrize(("won", "lost"), [("True", "False"), ("true", "false"), ("1", "0")])
def test_success_as_text_is_the_outcome(tmp_path: Path, won: str, lost: str) -> None:
    lines = [
        f"pi05_baseline,MoveCube,no-history,0,easy,{won},done,?,many,",
        f"pi05_baseline,MoveCube,no-history,1,hard,{lost},done,?,many,",
    ]
    rows = read_rows([canonical(tmp_path, lines)])
    assert [(row.status, row.success, row.steps, row.difficulty) for row in rows] == [
        ("success", True, None, "easy"),
        ("fail", False, None, "hard"),
    ]


@pytest.mark.parametrize("success", ["", "nan", "maybe", "0.5"])
def test_an_outcome_that_is_not_known_is_a_bad_row(tmp_path: Path, success: str) -> None:
    line = "pi05_baseline,MoveCube,no-history,{},easy,{},done,?,many,"
    path = canonical(tmp_path, [line.format(0, success), line.format(1, "True")])
    with raises(FormatError):
        read_rows([path])
    found = read_rows([path], lenient=True)
    assert (len(found), found.bad_count) == (1, 1)


@made.needs_released
def test_released_rows_of_all_systems_score_without_options(tmp_path: Path) -> None:
    """Rows with the published successes of each family: as many as the authors' file has."""
    with RATES.open(newline="") as file:
        cells = [cell for cell in csv.DictReader(file) if cell["variant"] in SYSTEMS]
    lines = [
        f"{cell['variant']},{cell['family']},{cell['condition']},{episode},easy,"
        f"{episode < int(cell['successes'])},done,?,many,"
        for cell in cells
        for episode in range(int(cell["n"]))
    ]
    assert len(lines) == 18_450
    found = made.score(canonical(tmp_path, lines), expected=Expected.BENCHMARK, paper=True, draws=2)
    rates = {(r["system"], r["condition"]): r["successes"] for r in made.records(found, "main")}
    assert (rates["pi05_baseline", "no-history"], rates["perceptual-framesamp-modul", "k7"]) == (
        *(78, 87),  # of 450, from the authors' grid_summary.csv
    )
    assert len(rates) == 41 and all(row["complete"] for row in made.records(found, "main"))
    # The systems are those of the table, so the published rates are their own.
    own = [r for r in made.records(found, "paper") if r["system"] == r["published_system"]]
    equal = {(r["system"], r["condition"]) for r in own if r["difference"] == 0}
    assert len(own) == 41 and {*rates} - equal == {*differing()}
    # Rows name no buffer set: systems are not paired, conditions of one are.
    assert {row["gained"] for row in made.records(found, "matrix")} == {None}
    assert all(row["gained"] is not None for row in made.records(found, "effects"))


@made.needs_released
def test_released_rows_with_retrieval_score_by_the_name_of_their_file(tmp_path: Path) -> None:
    rows = read_rows([made.RELEASED])
    assert rows.names("system") == ["retrieval-framesamp-modul"] and len(rows) == 1800
    assert rows.names("memory") == ["framesamp:32"] and rows.names("family") == sorted(FAMILIES)
    copy = tmp_path / "rows.csv"
    copy.write_bytes(made.RELEASED.read_bytes())
    with raises(FormatError):
        read_rows([copy])
