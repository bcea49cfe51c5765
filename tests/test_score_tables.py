"""Scores of made-up rows, worked out by hand, and of the released ones to the last digit."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import score_rows as made

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import BadRowsError
from robomme_interference_data.evaluate.rows import NO_HISTORY
from robomme_interference_data.evaluate.score.cells import main_markdown
from robomme_interference_data.evaluate.score.compare import compare
from robomme_interference_data.evaluate.score.grid import Grid
from robomme_interference_data.evaluate.score.headline import headline
from robomme_interference_data.evaluate.score.paper import published
from robomme_interference_data.evaluate.score.scoring import Score, score
from robomme_interference_data.evaluate.systems import SYSTEMS
from robomme_interference_data.intervals import newcombe, newcombe_paired, wilson
from robomme_interference_data.tables import write_tables

GOLDEN = Path(__file__).parent / "golden" / "score"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Score:
    rows = [*made.rows(), *made.repeat((r for r in made.rows() if r.condition == "k7"), 4)]
    # In the repeat, the base system loses MoveCube/1 and gains MoveCube/2.
    rows = [
        replace(row, status=status, success=status == "success")
        if (row.system, row.model_seed, row.family) == (made.BASE, 4, "MoveCube")
        and (status := {1: "fail", 2: "success"}.get(row.episode))
        else row
        for row in rows
    ]
    path = made.write_parquet(tmp_path_factory.mktemp("rows") / "rollouts.parquet", rows)
    return score([path], grid=Grid.GIVEN, draws=2000)


def find(score: Score, table: str, **equal: Any) -> dict[str, Any]:
    found = [
        record
        for record in score.tables[table].records()
        if all(record[name] == value for name, value in equal.items())
    ]
    assert len(found) == 1, found
    return found[0]


def test_cells_by_hand(small: Score) -> None:
    cell = find(small, "main", system=made.BASE, condition="k1")
    assert (cell["n"], cell["successes"], cell["fails"], cell["timeouts"]) == (12, 5, 6, 1)
    assert cell["rate"] == 5 / 12
    assert (cell["low"], cell["high"]) == wilson(5, 12)
    cell = find(small, "family", system=made.BASE, condition="k0", family="InsertPeg")
    assert (cell["n"], cell["successes"], cell["rank"]) == (6, 2, 1)
    cell = find(small, "difficulty", system=made.BASE, condition="k0", difficulty="hard")
    assert (cell["n"], cell["successes"]) == (4, 1)  # episodes 4 and 5 of both families: s f, f f


def test_an_error_is_neither_and_an_incomplete_cell_is_never_ranked(small: Score) -> None:
    cell = find(small, "main", system=made.OWN, condition="k0")
    assert (cell["n"], cell["successes"], cell["errors"], cell["missing"]) == (10, 2, 1, 2)
    assert cell["rate"] == 0.2
    assert (cell["complete"], cell["rank"]) == (False, None)
    # Both others have 7 of 12: two first places, and no third.
    assert find(small, "main", system=made.BASE, condition="k0")["rank"] == 1
    assert find(small, "main", system=made.RETRIEVAL, condition="k0")["rank"] == 1
    # MoveCube lacks episodes 2 and 5; InsertPeg is whole, and there it is third.
    lacking = find(small, "coverage", system=made.OWN, condition="k0", family="MoveCube")
    assert (lacking["expected"], lacking["n"], lacking["errors"]) == (6, 4, 1)
    assert (lacking["missing_episodes"], lacking["error_episodes"]) == ("test 2 5", "test 2")
    assert find(small, "family", system=made.OWN, condition="k0", family="InsertPeg")["rank"] == 3
    assert "20.0%† [5.7, 51.0] n=10, errors: 1" in main_markdown(small.cells)


def test_repeats_count_as_the_mean_of_their_episode(small: Score) -> None:
    # Seed 0: episodes 0 and 1 of MoveCube; seed 4: 0 and 2. So 1 + ½ + ½ of 12 episodes.
    cell = find(small, "main", system=made.BASE, condition="k7")
    assert (cell["n"], cell["successes"], cell["fails"]) == (12, 4, 20)
    assert cell["rate"] == 2 / 12
    noise = find(small, "noise", system=made.BASE, condition="k7")
    assert (noise["pairs"], noise["flips"], noise["rate"]) == (12, 2, 2 / 12)
    assert (noise["low"], noise["high"]) == wilson(2, 12)
    assert find(small, "noise", system=made.RETRIEVAL, condition="k7")["flips"] == 0
    assert len(small.tables["noise"].rows) == 2


def test_lift_and_retention_by_hand(small: Score) -> None:
    lift = find(small, "lift", system=made.BASE, condition="k0")
    assert (lift["rate"], lift["no_history_rate"]) == (7 / 12, 1 / 12)
    assert lift["lift"] == pytest.approx(6 / 12)
    # MoveCube 1 to 4 and InsertPeg 0 and 1 are gained, none is lost: p = 2 · 1/2⁶
    assert (lift["gained"], lift["lost"], lift["p"]) == (6, 0, 2 / 64)
    # Fewer than ten episodes differ: Newcombe's interval, of 1 pair on both sides and 5 on neither.
    assert (lift["interval"], lift["pairs"], lift["flips"]) == ("newcombe", 12, 6 / 12)
    assert (lift["low"], lift["high"]) == newcombe_paired(1, 6, 0, 5)
    assert lift["retention"] is None
    kept = find(small, "lift", system=made.BASE, condition="k3")
    assert kept["retention"] == pytest.approx((3 - 1) / (7 - 1))
    assert kept["retention_low"] is kept["retention_high"] is None
    # At k7 some episodes have two rollouts: neither interval is made for so few of them.
    kept = find(small, "lift", system=made.BASE, condition="k7")
    assert kept["low"] is kept["high"] is None and kept["interval"] == ""
    # Without history, the system with retrieval is the one without.
    kept = find(small, "lift", system=made.RETRIEVAL, condition="k7")
    assert (kept["no_history_of"], kept["retention"]) == (made.BASE, 1.0)
    # Ten episodes count on both sides: 2 against 1; no sure lift, so no retention.
    own = find(small, "lift", system=made.OWN, condition="k0")
    assert (own["n"], own["lift"], own["complete"]) == (10, pytest.approx(0.1), False)


def test_effects_by_hand(small: Score) -> None:
    effect = find(small, "effects", system=made.BASE, condition="k1", against_system=made.BASE)
    assert effect["difference"] == pytest.approx(-2 / 12)
    assert (effect["gained"], effect["lost"], effect["p"]) == (0, 2, 0.5)
    h = 2 * math.asin(math.sqrt(5 / 12)) - 2 * math.asin(math.sqrt(7 / 12))
    assert effect["cohens_h"] == pytest.approx(h)
    # InsertPeg 1 is lost and InsertPeg 2 gained by retrieval at k0.
    effect = find(small, "effects", system=made.RETRIEVAL, condition="k0")
    assert (effect["against_system"], effect["against_condition"]) == (made.BASE, "k0")
    assert (effect["difference"], effect["gained"], effect["lost"]) == (0.0, 1, 1)
    tests = [record["p"] for record in small.tables["effects"].records()]
    assert len(tests) == 6  # k1, k3, k7 against k0; k7 against k0; k0 and k7 against the base
    smallest = min(small.tables["effects"].records(), key=lambda record: record["p"])
    assert smallest["p_holm"] == min(1.0, 6 * smallest["p"])


def test_decay_by_hand(small: Score) -> None:
    decay = find(small, "decay", system=made.BASE)
    # Weights −0.3, −0.1, 0.1, 0.3 of 7, 5, 3 and 2 of 12: −2.1 − 0.5 + 0.3 + 0.6 = −1.7 of 12
    assert decay["slope"] == pytest.approx(-1.7 / 12)
    # Only MoveCube 1 to 4 and InsertPeg 0 and 1 change over the sessions: too few for an interval.
    assert decay["low"] is decay["high"] is None
    assert (decay["conditions"], decay["n"], decay["complete"]) == ("k0 k1 k3 k7", 12, True)
    assert {record["system"] for record in small.tables["decay"].records()} == {
        made.BASE,
        made.RETRIEVAL,
    }


def test_tables_are_written_as_the_golden_files(
    small: Score, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the note of a comparison holds the paths as they were given
    rows = [replace(row, simulator="robomme") for row in made.rows()]
    paper = score([made.write_csv(Path("all.csv"), rows)], against_paper=True, draws=100)
    for name, system in (("a.csv", made.BASE), ("b.csv", made.RETRIEVAL)):
        made.write_csv(Path(name), [row for row in rows if row.system == system])
    compared = compare(Path("a.csv"), Path("b.csv")).table
    tables = [*small.tables.values(), paper.tables["paper"], compared]
    write_tables(tables, Path("tables"), main_markdown(small.cells))
    written = {path.name: path.read_text(encoding="utf-8") for path in Path("tables").iterdir()}
    golden = {path.name: path.read_text(encoding="utf-8") for path in GOLDEN.iterdir()}
    assert written.keys() == golden.keys()
    for name, text in golden.items():
        assert written[name] == text, name


def test_the_benchmarks_grid_finds_all_of_it_incomplete(small: Score, tmp_path: Path) -> None:
    path = made.write_csv(tmp_path / "a.csv", made.rows())
    found = score([path], draws=100)
    assert not any(cell.complete or cell.rank for cell in found.cells)
    assert find(found, "main", system=made.BASE, condition="k0")["missing"] == 450 - 12
    gone = find(found, "coverage", system=made.BASE, condition="k0", family="RouteStick")
    assert (gone["expected"], gone["n"], gone["missing_episodes"]) == (50, 0, "test 0-49")


def test_episodes_beside_the_grid_make_a_cell_incomplete(tmp_path: Path) -> None:
    lines = [
        f"my-memory,{family},k0,{episode},{place},easy,fail,0,9"
        for place, family in enumerate(FAMILIES)
        for episode in range(50)
    ]
    lines = [line.replace(f",{place},easy", ",,easy") for place, line in enumerate(lines)]
    whole = score([made.released(tmp_path / "a.csv", lines)], draws=100)
    (k0,) = (cell for cell in whole.cells if cell.condition == "k0")
    assert k0.complete
    more = [*lines, "my-memory,MoveCube,k0,50,,easy,success,1,9"]
    found = score([made.released(tmp_path / "b.csv", more)], draws=100)
    (k0,) = (cell for cell in found.cells if cell.condition == "k0")
    assert (k0.n, k0.other, k0.complete) == (451, 1, False)
    lacking = find(found, "coverage", condition="k0", family="MoveCube")
    assert lacking["other_episodes"] == "test 50"


def test_tabletop_rows_are_never_set_against_the_paper(tmp_path: Path) -> None:
    rows = made.rows()
    other = [replace(r, simulator="robomme", revision="cd" * 32) for r in rows]
    path = made.write_csv(tmp_path / "a.csv", rows)
    found = score([path], against_paper=True, draws=100)
    assert found.tables["paper"].rows == ()
    assert "tabletop are not set against" in found.tables["paper"].note
    path = made.write_csv(tmp_path / "b.csv", [*rows, *other])
    found = score([path], against_paper=True, draws=100)
    records = found.tables["paper"].records()
    # Five cells of the base system; two of retrieval, each beside its own and the base's.
    assert len(records) == 9
    assert all(record["n"] == 12 and not record["complete"] for record in records)
    base = find(found, "paper", system=made.BASE, condition="k0")
    assert base["published_rate"] == 204 / 450
    assert (base["difference_low"], base["difference_high"]) == newcombe(7, 12, 204, 450)


def test_published_rates_are_the_papers() -> None:
    rates = published()
    assert len(rates) == 1 + 11 * 5 + 4
    for one in rates:
        # Of all counts of 450 exactly one rounds to the printed rate.
        counts = [n for n in range(451) if f"{100 * n / 450:.1f}" == f"{one.percent:.1f}"]
        assert counts == [one.successes]
        assert SYSTEMS[one.system].paper and one.simulator == "robomme"
    at = {(one.system, one.condition): one.percent for one in rates}
    assert at["perceptual-framesamp-modul", "k7"] == 19.3
    assert at["symbolic-groundsg", "k7"] == 26.0
    assert at["recurrent-ttt-context", "k3"] == 17.3
    assert at["retrieval-framesamp-modul", "k1"] == 44.7


PAPER = made.RELEASED.parents[2] / "paper" / "robomme-interference-paper.tex"


@pytest.mark.skipif(not PAPER.exists(), reason="the paper is not here")
def test_published_rates_are_in_the_papers_source() -> None:
    lines = PAPER.read_text(encoding="utf-8").splitlines()
    names = {one.system: SYSTEMS[one.system].display for one in published()}
    names["pi05_baseline"] = "$\\pi_{0.5}$ (baseline)"
    for table, start in ((3, "System & No history"), (4, "System & k0")):
        first = next(i for i, line in enumerate(lines) if line.strip().startswith(start))
        for system in {one.system for one in published() if one.table == table}:
            line = next(t for t in lines[first:] if t.strip().startswith(names[system]))
            printed = [float(n) for n in _percents(line)]
            assert printed == [
                o.percent for o in published() if (o.table, o.system) == (table, system)
            ]


def _percents(line: str) -> list[str]:
    cells = line.replace("\\textbf{", "").replace("}", "").replace("\\\\", "").split("&")[1:]
    return [cell.strip().removesuffix("\\%") for cell in cells if "--" not in cell]


@made.needs_released
def test_the_released_rows_give_the_published_numbers(tmp_path: Path) -> None:
    found = score([made.RELEASED], system=made.RETRIEVAL, against_paper=True)
    rates = {cell.condition: f"{100 * cell.rate:.1f}" for cell in found.cells}
    assert rates == {"k0": "44.9", "k1": "44.7", "k3": "44.9", "k7": "44.9"}
    assert all(cell.complete and cell.n == 450 for cell in found.cells)
    assert {cell.condition: cell.counts for cell in found.cells} == {
        "k0": (202, 231, 17, 0),
        "k1": (201, 232, 17, 0),
        "k3": (202, 230, 18, 0),
        "k7": (202, 229, 19, 0),
    }
    k7 = find(found, "effects", condition="k7")
    assert (k7["n"], k7["gained"], k7["lost"], k7["p"], k7["difference"]) == (450, 13, 13, 1.0, 0.0)
    # Wilson by hand: see test_score_statistics.py.
    assert tuple(round(x, 6) for x in found.cells[0].interval) == (0.403560, 0.495083)
    families = {(c.part, c.condition): c.counts[0] for c in found.family_cells}
    by_hand = {
        "InsertPeg": [5, 4, 4, 3],
        "MoveCube": [43, 42, 43, 43],
        "PatternLock": [28, 26, 29, 27],
        "RouteStick": [34, 33, 35, 33],
        "VideoPlaceButton": [26, 28, 25, 30],
        "VideoPlaceOrder": [20, 24, 20, 23],
        "VideoRepick": [16, 15, 17, 15],
        "VideoUnmask": [19, 17, 18, 19],
        "VideoUnmaskSwap": [11, 12, 11, 9],
    }
    assert families == {
        (family, condition): count
        for family, counts in by_hand.items()
        for condition, count in zip(("k0", "k1", "k3", "k7"), counts, strict=True)
    }
    for record in found.tables["paper"].records():
        if record["published_system"] == made.RETRIEVAL:
            assert record["difference"] == 0.0
    assert headline(found, "robomme") == (
        "Retrieval-FrameSamp-Modul succeeds in 44.9% of 450 episodes when the history holds the "
        "lesson alone (k0, 95% interval 40.4 to 49.5), and in 44.9% with 7 distractor sessions "
        "behind it (k7): 0.0 points (−2.2 to +2.2; 13 episodes gained, 13 lost, McNemar p = 1). "
        "Without retrieval, FrameSamp-Modul falls from 45.3% to 19.3% (published)."
    )


def test_headlines_of_few_rows(small: Score, tmp_path: Path) -> None:
    assert headline(small, "tabletop").startswith(
        "FrameSamp-Modul succeeds in 58.3% of 12 episodes when the history holds the lesson alone"
    )
    # Both have 7 of 12 at k0. Of 5 + 4 + 5 expected cells, retrieval lacks k1 and k3, and the
    # own memory k1, k3 and k7, and part of k0.
    assert headline(small, "tabletop").endswith(
        "Under k0, Retrieval-FrameSamp-Modul has the same rate. The highest rate at k7 is 58.3%, "
        "of Retrieval-FrameSamp-Modul. 8 of 14 cells are complete."
    )
    rows = [row for row in made.rows() if row.condition == NO_HISTORY]
    found = score([made.write_csv(tmp_path / "a.csv", rows)], grid=Grid.GIVEN, draws=100)
    assert headline(found, "tabletop") == (
        "FrameSamp-Modul succeeds in 8.3% of 12 episodes under no history (95% interval 1.5 to "
        "35.4). Under no history, my-memory has the same rate."
    )
    rows = [r for r in made.rows() if r.status == "error"]
    found = score([made.write_csv(tmp_path / "b.csv", rows)], grid=Grid.GIVEN, draws=100)
    assert headline(found, "tabletop") == "No rollout counts yet. 0 of 1 cells are complete."


def test_systems_without_a_memory_are_neither_ranked_nor_the_headline(tmp_path: Path) -> None:
    def lines(*systems: str) -> Path:
        rows = [
            f"{system},MoveCube,{condition},0,,easy,{outcome},{int(outcome == 'success')},9"
            for system, outcome in zip(systems, ("success", "fail", "timeout"), strict=False)
            for condition in ("k0", "k7")
        ]
        return made.released(tmp_path / f"{len(systems)}.csv", rows)

    found = score([lines("oracle", "guess", "my-memory")], grid=Grid.GIVEN, draws=100)
    assert {c.system: c.rank for c in found.cells} == {
        "oracle": None,
        "guess": None,
        "my-memory": 1,
    }
    assert headline(found, "robomme").startswith("my-memory succeeds in 0.0% of 1 episodes")
    assert "Not ranked either, as they use no memory: Oracle, Guess." in main_markdown(found.cells)
    found = score([lines("oracle")], grid=Grid.GIVEN, draws=100)
    assert headline(found, "robomme").startswith("Oracle succeeds in 100.0% of 1 episodes")


def test_no_rows_are_no_score(tmp_path: Path) -> None:
    with pytest.raises(BadRowsError, match="no rows to score"):
        score([made.write_csv(tmp_path / "a.csv", [])])
