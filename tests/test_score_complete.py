"""Cells that are missing or not complete: listed, and never the ones that lead."""

from collections.abc import Mapping
from pathlib import Path

import score_rows as made

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.score.cells import main_markdown
from robomme_interference_data.evaluate.score.grid import Grid
from robomme_interference_data.evaluate.score.headline import headline
from robomme_interference_data.evaluate.score.scoring import Score, score


def scored(
    path: Path,
    cells: Mapping[tuple[str, str], str],
    grid: Grid = Grid.GIVEN,
    against_paper: bool = False,
) -> Score:
    """Score cells of MoveCube: a letter an episode, as in `score_rows`."""
    lines = [
        f"{system},MoveCube,{condition},{place},,easy,{made.STATUS[letter]},{int(letter == 's')},9"
        for (system, condition), letters in cells.items()
        for place, letter in enumerate(letters)
        if letter != "-"
    ]
    return score(
        [made.released(path / "a.csv", lines)],
        grid=grid,
        draws=200,
        against_paper=against_paper,
    )


def test_a_lucky_episode_does_not_lead(tmp_path: Path) -> None:
    found = scored(
        tmp_path,
        {("lucky", "k0"): "s----", ("a-memory", "k0"): "sssff", ("a-memory", "k7"): "sffff"},
    )
    assert headline(found, "robomme").startswith("a-memory succeeds in 60.0% of 5 episodes")
    # Expected of each: k0 and k7, which any row is of.
    assert headline(found, "robomme").endswith("2 of 4 cells are complete.")


def test_without_a_complete_cell_nothing_leads(tmp_path: Path) -> None:
    found = scored(
        tmp_path, {("one", "k0"): "sss--", ("other", "k0"): "s---f", ("other", "k7"): "ffff-"}
    )
    assert headline(found, "robomme") == (
        "No cell is complete, so no system leads. Nearest to it is other under k7: 1 of 5 episodes "
        "are missing. 0 of 4 cells are complete."
    )
    found = scored(tmp_path, {("one", "k0"): "sss--"}, Grid.BENCHMARK)
    assert headline(found, "robomme") == (
        "No cell is complete, so no system leads. Nearest to it is one under k0: 447 of 450 "
        "episodes are missing. 0 of 5 cells are complete."
    )


def test_an_incomplete_end_is_marked_and_no_other_is_the_highest(tmp_path: Path) -> None:
    found = scored(
        tmp_path,
        {
            ("a", "k0"): "sssss",
            ("a", "k7"): "sssf-",
            ("b", "k0"): "ssfff",
            ("b", "k7"): "sffff",
        },
    )
    text = headline(found, "robomme")
    assert "in 75.0% with 7 distractor sessions behind it (k7, not complete, over the 4 ep" in text
    assert "highest" not in text and "b" not in text.split()


def test_equal_rates_are_named(tmp_path: Path) -> None:
    ends = {("a", "k7"): "sffff", ("b", "k7"): "fffsf", ("c", "k7"): "ffffs"}
    found = scored(
        tmp_path, {("a", "k0"): "sssff", ("b", "k0"): "ffsss", ("c", "k0"): "sssff", **ends}
    )
    text = headline(found, "robomme")
    assert text.startswith("a succeeds in 60.0% of 5 episodes when")
    assert text.endswith(
        "Under k0, b and c have the same rate. Under k7, b and c have the same rate."
    )
    found = scored(tmp_path, {("a", "k1"): "sf", ("b", "k1"): "fs", ("b", "k7"): "ff"})
    assert headline(found, "robomme").startswith(
        "a succeeds in 50.0% of 2 episodes under k1 (95% interval 9.5 to 90.5). Under k1, b has "
        "the same rate."
    )


def test_cells_without_any_rollout_are_listed(tmp_path: Path) -> None:
    cells = {
        ("mine", "k0"): "ss",
        (made.RETRIEVAL, "k3"): "sf",
        ("pi05_baseline", "no-history"): "ff",
    }
    found = scored(tmp_path, cells)
    listed = [(c.system, c.condition, c.n, c.missing, c.complete) for c in found.cells]
    # pi0.5 has no memory, and the retrieval step nothing to retrieve without history.
    assert listed == [
        ("pi05_baseline", "no-history", 2, 0, True),
        (made.RETRIEVAL, "k0", 0, 2, False),
        (made.RETRIEVAL, "k3", 2, 0, True),
        ("mine", "no-history", 0, 2, False),
        ("mine", "k0", 2, 0, True),
        ("mine", "k3", 0, 2, False),
    ]
    coverage = [
        (r["system"], r["condition"], r["n"], r["missing_episodes"])
        for r in found.tables["coverage"].records()
    ]
    assert coverage[1] == (made.RETRIEVAL, "k0", 0, "test 0-1")
    assert [row[:3] for row in coverage] == [row[:3] for row in listed]
    shown = main_markdown(found.cells).splitlines()
    assert shown[2] == "| π0.5 (baseline) | 0.0% [0.0, 65.8] n=2 | – | – |"
    assert shown[3].startswith("| Retrieval-FrameSamp-Modul | – | missing† | 50.0% [9.5, 90.5]")
    # In no other table, as there is nothing to say of their parts.
    assert len(found.tables["family"].rows) == 3

    found = scored(tmp_path, cells, Grid.BENCHMARK)
    conditions = [(c.system, c.condition) for c in found.cells]
    assert conditions == [
        ("pi05_baseline", "no-history"),
        *((made.RETRIEVAL, c) for c in ("k0", "k1", "k3", "k7")),
        *(("mine", c) for c in ("no-history", "k0", "k1", "k3", "k7")),
    ]
    assert all(
        row["missing_episodes"] == "test 0-49"
        for row in found.tables["coverage"].records()
        if row["condition"] == "k7"
    )
    assert len(found.tables["coverage"].rows) == len(FAMILIES) * len(conditions)


def test_beside_the_paper_only_its_whole_grid_is_complete(tmp_path: Path) -> None:
    cells = {(made.BASE, "k0"): "ssf"}
    found = scored(tmp_path, cells, Grid.GIVEN, against_paper=True)
    assert found.cells[0].complete
    (row,) = found.tables["paper"].records()
    assert (row["n"], row["published_n"], row["complete"]) == (3, 450, False)
    lines = [
        f"{made.BASE},{family},k0,{episode},,easy,fail,0,9"
        for family in FAMILIES
        for episode in range(50)
    ]
    whole = score([made.released(tmp_path / "b.csv", lines)], draws=10, against_paper=True)
    assert whole.tables["paper"].records()[0]["complete"]
