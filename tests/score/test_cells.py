"""Rates worked out by hand; which cells are complete, missing or not ranked; other conditions."""

from pathlib import Path

from support import scoring as made
from support.scoring import record

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.score.config import Expected
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.schema.conditions import NO_HISTORY


def grid_of(found: Score) -> list[list[str]]:
    return [list(row) for grid in found.grids for row in grid.rows]


def test_best_is_each_that_cannot_be_told_from_the_highest_rate(tmp_path: Path) -> None:
    # Of 24 episodes the first has 12; the second loses one, the third six, the last ten.
    rates = {"one": 12, "two": 11, "three": 6, "four": 2}
    given = {(name, "k0"): "s" * n + "f" * (24 - n) for name, n in rates.items()}
    given[("lone", "k1")] = "s" * 24
    found = made.score(made.write_csv(tmp_path / "a.csv", made.cells(given)))
    best = {c.system: c.best for c in found.cells if not c.part and c.n}
    # Of six pairs: 6 · 2/2¹⁰ and 5 · 2/2⁹ are below 0.05, and 4 · 2/2⁶ is not.
    assert best == {"one": True, "two": True, "three": True, "four": False, "lone": False}
    bold = {row[0] for row in grid_of(found) for cell in row if cell.startswith("**")}
    assert bold == {"one", "two", "three"}


def test_a_cell_is_complete_only_if_every_seed_is(tmp_path: Path) -> None:
    first = made.cells({(made.OWN, "k0"): "ssf", (made.OWN, "k7"): "ssf"})
    second = made.cells({(made.OWN, "k0"): "sff", (made.OWN, "k7"): "se-"}, seed=1)
    found = made.score(made.write_csv(tmp_path / "a.csv", [*first, *second]))
    whole = [cell for cell in found.cells if not cell.part]
    assert [(c.condition, c.n, len(c.missing), c.complete, c.rank) for c in whole] == [
        ("k0", 3, 0, True, 1),
        ("k7", 3, 2, False, None),
    ]
    cell = record(found, "parts", by="family", condition="k7")
    assert (cell["n"], cell["missing_episodes"], cell["error_episodes"]) == (
        *(3, "test 1-2", "test 1"),
    )
    assert not record(found, "effects", condition="k7")["complete"]


def test_cells_without_any_rollout_are_listed(tmp_path: Path) -> None:
    given = {("mine", "k0"): "ss", (made.RETRIEVAL, "k3"): "sf"}
    given[("pi05_baseline", NO_HISTORY)] = "ff"
    path = made.write_csv(tmp_path / "a.csv", made.cells(given))
    found = made.score(path)
    listed = [(r["system"], r["condition"], r["n"]) for r in made.records(found, "main")]
    # pi0.5 has no memory, and the retrieval step nothing to retrieve without history.
    assert listed == [
        ("pi05_baseline", NO_HISTORY, 2),
        (made.RETRIEVAL, "k0", 0),
        (made.RETRIEVAL, "k3", 2),
        ("mine", NO_HISTORY, 0),
        ("mine", "k0", 2),
        ("mine", "k3", 0),
    ]
    coverage = [
        (r["system"], r["condition"], r["n"]) for r in made.records(found, "parts", by="family")
    ]
    assert coverage == listed
    assert made.records(found, "parts", by="family")[-1]["missing_episodes"] == "test 0-1"
    assert grid_of(found)[:2] == [
        ["π0.5 (baseline)", "0.0% [0.0, 65.8]", "n/a", "n/a"],
        ["Retrieval-FrameSamp-Modul", "n/a", "missing†", "50.0% [9.5, 90.5]"],
    ]
    assert found.grids[0].note.startswith("n = 2 in each cell. ")  # said once where all are equal
    found = made.score(path, expected=Expected.BENCHMARK)
    assert [c.system for c in found.cells if not c.part] == [
        *("pi05_baseline", *[made.RETRIEVAL] * 4, *["mine"] * 5)
    ]
    nothing = made.records(found, "parts", by="family", condition="k7")
    assert len(nothing) == 2 * len(FAMILIES)
    assert {r["missing_episodes"] for r in nothing} == {"test 0-49"}


def test_the_benchmarks_grid_is_nine_families_of_fifty_episodes(tmp_path: Path) -> None:
    lines = [f"my-memory,{f},k0,{n},,easy,fail,0,9" for f in FAMILIES for n in range(50)]
    path = made.released(tmp_path / "a.csv", lines)
    assert record(made.score(path, expected=Expected.BENCHMARK), "main", condition="k0")["complete"]
    # An episode beside the grid makes a cell incomplete, as a missing one does.
    more = made.released(tmp_path / "b.csv", [*lines, "my-memory,MoveCube,k0,50,,easy,fail,0,9"])
    found = made.score(more, expected=Expected.BENCHMARK)
    assert not record(found, "main", condition="k0")["complete"]
    lacking = record(found, "parts", condition="k0", part="MoveCube")
    assert (lacking["n"], lacking["other_episodes"]) == (51, "test 50")
    few = made.score(made.released(tmp_path / "c.csv", lines[:12]), expected=Expected.BENCHMARK)
    assert record(few, "main", condition="k0")["missing"] == 450 - 12
