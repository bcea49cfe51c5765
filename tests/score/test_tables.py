"""Tables are those of the golden folders, whose numbers were worked out or computed elsewhere."""

from dataclasses import replace
from pathlib import Path

import pytest
from support import scoring as made
from support.scoring import BASE, RETRIEVAL

from robomme_interference_data.evaluate.score.compare import compare
from robomme_interference_data.evaluate.score.config import Expected
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.viz.tables import Table

GOLDEN = made.ROOT / "tests" / "golden"


def of_paper() -> tuple[list[Table], Score]:
    """All tables of rows with a repeat, that of the paper, and a comparison of two runs."""
    rows = made.rows()
    again = made.changed((row for row in rows if row.condition == "k7"), model_seed=4)
    # In the repeat, the base system loses MoveCube/1 and gains MoveCube/2.
    lost = {1: "fail", 2: "success"}
    again = [
        replace(row, status=lost[row.episode], success=row.episode == 2)
        if (row.system, row.family) == (BASE, "MoveCube") and row.episode in lost
        else row
        for row in again
    ]
    found = made.score(made.write_parquet(Path("small.parquet"), [*rows, *again]), draws=2000)
    robomme = made.changed(rows, simulator="robomme")
    paper = made.score(
        made.write_csv(Path("all.csv"), robomme), expected=Expected.BENCHMARK, paper=True
    )
    sides = [
        made.write_csv(Path(name), [row for row in robomme if row.system == system])
        for name, system in (("a.csv", BASE), ("b.csv", RETRIEVAL))
    ]
    return [*found.tables.values(), paper.tables["paper"], compare(*sides).table], found


@pytest.mark.parametrize("name", ["score", "score-kinds", "score-questions"])
def test_tables_are_those_of_the_golden_files(
    name: str, kinds: Score, questions: Score, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the note of a comparison holds the paths as they were given
    golden = {path.name: path.read_text(encoding="utf-8") for path in (GOLDEN / name).iterdir()}
    tables, found = of_paper() if name == "score" else ([], kinds)
    if name == "score-questions":
        found = questions
    tables = tables or [found.tables[stem] for stem in sorted({n.split(".")[0] for n in golden})]
    written = {f"{table.name}.csv": table.csv() for table in tables}
    written |= {f"{table.name}.md": table.markdown() for table in tables}
    written["main.md"] = found.grids[0].markdown()
    if name == "score":
        assert written.keys() == golden.keys()
    for one, text in golden.items():
        assert written[one] == text, one
