"""What a score comes to: headlines, the released and published numbers, the tables' files."""

from pathlib import Path

import pytest
from support import scoring as made
from support.pages import RESULTS, table
from support.scoring import BASE, OWN, RETRIEVAL, cells, record

from robomme_interference_data.evaluate.score.config import Expected
from robomme_interference_data.evaluate.score.report.headline import headlines
from robomme_interference_data.evaluate.score.tables.paper import by_family, differing, published
from robomme_interference_data.evaluate.systems import SYSTEMS
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.stats.intervals import wilson

PAPER = made.RELEASED.parents[2] / "paper" / "robomme-interference-paper.tex"


# --- the paper ---------------------------------------------------------------------------------


def test_what_is_not_in_the_paper_is_told(tmp_path: Path) -> None:
    other = made.changed(made.rows(), simulator="robomme", revision="cd" * 32)
    path = made.write_csv(tmp_path / "both.csv", [*made.rows(), *other])
    assert made.score(path, paper=True).notes == (
        "Rows of tabletop are not compared with the paper's RoboMME.",
        f"Not in the paper under these conditions: {OWN}.",
    )
    rows = made.changed(cells({(OWN, "k0"): "sf", (BASE, "k15"): "s"}), simulator="robomme")
    found = made.score(made.write_csv(tmp_path / "a.csv", rows), paper=True)
    assert "paper" not in found.tables
    assert found.notes == (f"Not in the paper under these conditions: {BASE}, {OWN}.",)


def test_published_rates_are_the_papers() -> None:
    rates = published()
    assert len(rates) == 1 + 11 * 5 + 4
    for one in rates:
        # Of all counts of 450 exactly one rounds to the printed rate.
        counts = [n for n in range(451) if f"{n / 450:.1%}" == f"{one.rate:.1%}"]
        assert counts == [round(450 * one.rate)] and one.n == 450
        assert one.interval == wilson(*counts, 450) and one.complete
        assert SYSTEMS[one.system].paper and one.simulator == "robomme"
    best = {
        c: [o.system for o in rates if o.condition == c and o.best] for c in ("no-history", "k0")
    }
    assert len(best["no-history"]) == 12  # 93 to 62 of 450: p = 0.006, of 66 pairs
    # 45.3% and 44.9%, then 35.3% with p = 0.002: 22 of 66 pairs are less likely.
    assert best["k0"] == [BASE, "perceptual-tokendrop-modul", RETRIEVAL]


def test_the_benchmarks_page_has_the_published_rates() -> None:
    page = (RESULTS.parent / "explanation" / "benchmark.md").read_text(encoding="utf-8")
    listed = table(page, "no-history")
    rates = {(one.system, one.condition): f"{100 * one.rate:.1f}" for one in published()}
    names = {SYSTEMS[system].display.split(" (")[0]: system for system, _ in rates}
    shown = {
        (names[row["system"]], condition): rate
        for row in listed
        for condition, rate in row.items()
        if condition != "system" and rate
    }
    assert shown == rates


def test_rates_by_family_are_used_where_they_add_up_to_the_published_ones() -> None:
    known = {(one.system, one.condition): 450 * one.rate for one in published()}
    found: dict[tuple[str, str], list[float]] = {}
    for one in by_family():
        assert one.n == 50 and one.complete and one.simulator == "robomme"
        found.setdefault((one.system, one.condition), []).append(50 * one.rate)
    assert len(found) == 25 and {len(counts) for counts in found.values()} == {9}
    assert all(sum(counts) == pytest.approx(known[key]) for key, counts in found.items())
    # Without distractors none differs, and of FrameSamp-Modul none at all.
    apart = differing()
    assert len(apart) == 20 and not {*apart} & {*found}
    assert {condition for _, condition in apart} == {"k1", "k3", "k7"}
    modul = [(BASE, condition) for condition in (NO_HISTORY, "k0", "k1", "k3", "k7")]
    assert {*modul, ("pi05_baseline", NO_HISTORY)} <= {*found}
    own = [one for one in by_family() if (one.system, one.part) == (BASE, "MoveCube")]
    cube = {one.condition: round(50 * one.rate) for one in own}
    assert cube == {NO_HISTORY: 18, "k0": 43, "k1": 33, "k3": 25, "k7": 16}


def test_a_few_episodes_of_ones_own_are_not_beside_the_papers(tmp_path: Path) -> None:
    rows = made.changed(cells({("replay-full", "k0"): "ssf"}), simulator="robomme")
    found = made.score(made.write_csv(tmp_path / "a.csv", rows), paper=True)
    assert "paper" not in found.tables  # three episodes of one family are no rate over nine


@pytest.mark.skipif(not PAPER.exists(), reason="the paper is not here")
def test_published_rates_are_in_the_papers_source() -> None:
    lines = PAPER.read_text(encoding="utf-8").splitlines()
    names = {one.system: SYSTEMS[one.system].display for one in published()}
    names["pi05_baseline"] = "$\\pi_{0.5}$ (baseline)"
    for retrieval, start in ((False, "System & No history"), (True, "System & k0")):
        first = next(i for i, line in enumerate(lines) if line.strip().startswith(start))
        for system in {s for s in names if (SYSTEMS[s].base is not None) == retrieval}:
            line = next(t for t in lines[first:] if t.strip().startswith(names[system]))
            line = line.replace("\\textbf{", "").replace("}", "").replace("\\\\", "")
            printed = [
                float(cell.strip().removesuffix("\\%"))
                for cell in line.split("&")[1:]
                if "--" not in cell
            ]
            assert printed == [round(100 * o.rate, 1) for o in published() if o.system == system]


@made.needs_released
def test_the_released_rows_give_the_published_numbers() -> None:
    found = made.score(
        made.RELEASED, system=RETRIEVAL, expected=Expected.BENCHMARK, paper=True, draws=10_000
    )
    whole = {cell.condition: cell for cell in found.cells if not cell.part and cell.n}
    assert all(cell.complete and cell.n == 450 for cell in whole.values())
    counts = ((202, 231, 17, 0), (201, 232, 17, 0), (202, 230, 18, 0), (202, 229, 19, 0))
    assert {c: cell.counts[:4] for c, cell in whole.items()} == dict(
        zip(("k0", "k1", "k3", "k7"), counts, strict=True)
    )
    # By hand: see tests/core/test_stats.py.
    assert whole["k0"].interval == pytest.approx((0.403560, 0.495083), abs=1e-6)
    k7 = record(found, "effects", condition="k7")
    assert (k7["n"], k7["gained"], k7["lost"], k7["p"], k7["difference"]) == (450, 13, 13, 1.0, 0.0)
    cells = made.records(found, "parts", part="VideoPlaceButton")
    assert [cell["successes"] for cell in cells] == [26, 28, 25, 30]
    ours = made.records(found, "paper", published_system=RETRIEVAL)
    assert {one["difference"] for one in ours} == {0.0}
    # The published rates by family are counted from these very rows.
    theirs = {
        (cell.condition, cell.part): cell.rate for cell in by_family() if cell.system == RETRIEVAL
    }
    own = made.records(found, "parts", by="family")
    assert {(row["condition"], row["part"]): row["rate"] for row in own if row["n"]} == theirs
    # The ten episodes of docs/results/robomme.md are easier than the other forty.
    four = ("MoveCube", "InsertPeg", "PatternLock", "RouteStick")
    won = [r.episode for r in found.rows if r.success and r.condition == "k0" and r.family in four]
    assert (sum(e < 10 for e in won), sum(e >= 10 for e in won)) == (26, 84)
    assert headlines(found)["robomme"] == (
        "In robomme, Retrieval-FrameSamp-Modul succeeds in 44.9% (40.4 to 49.5) of 450 episodes at "
        "k0 and in 44.9% (40.4 to 49.5) at k7 (95% intervals, for this checkpoint). "
        "No fall of Retrieval-FrameSamp-Modul from k0 to k7 is shown, and up to 2.3 points is not "
        "excluded (95% interval −2.3 to +2.3, p = 1.000). "
        "Next: run a second system on the same episodes, to compare their falls."
    )
