"""What a score comes to: headlines, the released and published numbers, the tables' files."""

from pathlib import Path

import pytest
from support import scoring as made
from support.scoring import BASE, OWN, RETRIEVAL, cells, record

from robomme_interference_data.evaluate.score.config import Expected
from robomme_interference_data.evaluate.score.report.headline import headline
from robomme_interference_data.evaluate.score.report.strongest import strongest
from robomme_interference_data.evaluate.score.tables.paper import by_family, differing, published
from robomme_interference_data.evaluate.systems import SYSTEMS
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.stats.intervals import wilson

PAPER = made.RELEASED.parents[2] / "paper" / "robomme-interference-paper.tex"


def told(
    tmp_path: Path, outcomes: dict[tuple[str, str], str], expected: Expected = Expected.OBSERVED
) -> str:
    rows = cells(outcomes)
    return headline(
        made.score(made.write_csv(tmp_path / "a.csv", rows), expected=expected), "tabletop"
    )


# --- headlines ---------------------------------------------------------------------------------


HEADLINES = {
    "a lucky episode does not lead": (
        {("lucky", "k0"): "s----", ("a-memory", "k0"): "sssff", ("a-memory", "k7"): "sffff"},
        ("a-memory succeeds in 60.0% of 5 episodes", "2 of 4 cells"),  # k0 and k7 of each
    ),
    "nothing complete": (
        {("one", "k0"): "sss--", ("other", "k0"): "s---f", ("other", "k7"): "ffff-"},
        ("no system leads", "other under k7: 1 of 5 episodes are missing", "0 of 4 cells"),
    ),
    "an end that is not complete": (
        {("a", "k0"): "sssss", ("a", "k7"): "sssf-", ("b", "k0"): "ssfff", ("b", "k7"): "sffff"},
        (
            "a succeeds in 100.0% of 5 episodes",
            "in 75.0% with 7 distractor sessions after it (k7, incomplete, over its 4 episodes): "
            "−25.0 points (−74.1 to +34.6; 0 episodes gained, 1 lost, McNemar p = 1, "
            "corrected for the falls of 2 systems, provisional).",
            "3 of 4 cells are complete.",
        ),
    ),
    "equal rates": (
        {
            **{("a", "k0"): "sssff", ("b", "k0"): "ffsss", ("c", "k0"): "sssff"},
            **{("a", "k7"): "sffff", ("b", "k7"): "fffsf", ("c", "k7"): "ffffs"},
        },
        (
            "a succeeds in 60.0% of 5 episodes",
            "Under k0, b and c are not distinguishable from the best. Under k7, b and c are not",
        ),
    ),
    "without k0": (
        {("a", "k1"): "sf", ("b", "k1"): "fs", ("b", "k7"): "ff"},
        ("a succeeds in 50.0% of 2 episodes under k1 (95% interval 7.7 to 92.3, corrected for",),
    ),
    "without history": (
        {(BASE, NO_HISTORY): "sfffffffffff"},
        ("FrameSamp-Modul succeeds in 8.3% of 12 episodes under no history (95% interval 1.5",),
    ),
    "a reference does not lead": (
        {("oracle", "k0"): "s", (OWN, "k0"): "f"},
        ("my-memory succeeds in 0.0% of 1",),
    ),
    "references above the highest rate are named": (
        {
            ("a", "k0"): "sss",
            ("a", "k7"): "fff",
            ("b", "k0"): "ssf",
            ("b", "k7"): "sff",
            ("oracle", "k7"): "sss",
            ("guess", "k7"): "fff",
        },
        (
            "The highest rate at k7 is 33.3%, of b, without the references, of which Oracle is "
            "higher.",
        ),
    ),
    "a reference alone": ({("oracle", "k0"): "s"}, ("Oracle succeeds in 100.0% of 1 episodes",)),
}


def test_the_leaders_fall_is_corrected_for_how_it_was_chosen(tmp_path: Path) -> None:
    given = {(name, "k0"): "s" * 12 for name in ("a", "b", "c")}
    given |= {(name, "k7"): "f" * n + "s" * (12 - n) for name, n in (("a", 8), ("b", 1), ("c", 0))}
    given |= {("oracle", "k0"): "s" * 12, ("oracle", "k7"): "s" * 12}
    # 3 · 2/2⁸
    assert "8 lost, McNemar p = 0.023, corrected for the falls of 3 systems)." in told(
        tmp_path, given
    )


@pytest.mark.parametrize(("outcomes", "facts"), HEADLINES.values(), ids=HEADLINES.keys())
def test_headlines(
    tmp_path: Path, outcomes: dict[tuple[str, str], str], facts: tuple[str, ...]
) -> None:
    text = told(tmp_path, outcomes)
    assert text.startswith("In tabletop, ") and all(fact in text for fact in facts)


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
    assert headline(found, "robomme") == (
        "In robomme, Retrieval-FrameSamp-Modul succeeds in 44.9% of 450 episodes if the history "
        "holds only the lesson (k0, 95% interval 40.4 to 49.5), and in 44.9% with 7 distractor "
        "sessions after it (k7): 0.0 points (−2.3 to +2.3; 13 episodes gained, 13 lost, McNemar "
        "p = 1). "
        "Without retrieval, FrameSamp-Modul falls from 45.3% to 19.3% (published)."
    )


def test_the_strongest_effect_is_the_largest_significant_one(tmp_path: Path) -> None:
    """The reference loses more, and is left out."""
    outcomes = {
        ("a", "k0"): "s" * 20,
        ("a", "k7"): "f" * 12 + "s" * 8,
        ("a", "k1"): "f" * 3 + "s" * 17,
        ("oracle", "k0"): "s" * 20,
        ("oracle", "k7"): "f" * 20,
    }
    found = made.score(made.write_csv(tmp_path / "a.csv", cells(outcomes)))
    text = strongest(found, "tabletop")
    assert "strongest paired effect is on a: k7 minus k0, −60.0 points" in text
    assert "corrected for 2 effects" in text
    alone = made.score(made.write_csv(tmp_path / "b.csv", cells({("a", "k0"): "sf"})))
    assert strongest(alone, "tabletop") == ""
