"""What docs/results/robomme.md tells is what its rows say."""

import re

import pytest
from support import scoring as made
from support.pages import RESULTS, table

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.score.scoring import Score

PAGE = (RESULTS / "robomme.md").read_text(encoding="utf-8")
FILES = sorted(RESULTS.glob("*.csv"))


@pytest.fixture(scope="module")
def found() -> Score:
    return made.score(*FILES, paper=True)


def test_successes_are_those_of_the_rows(found: Score) -> None:
    cells = {(cell.system, cell.condition, cell.part): cell for cell in found.cells if cell.n}
    told = set()
    for row in table(PAGE, "system"):
        system, condition = row.pop("system").strip("`"), row.pop("condition")
        for family, text in row.items():
            if text == "–":
                continue
            cell = cells[system, condition, family]
            low, high = (round(100 * end) for end in cell.interval)
            assert text == f"{cell.counts[0]} of {cell.n}, {low} to {high}%", (
                system,
                condition,
                family,
            )
            told.add((system, condition, family))
    assert told == {key for key in cells if key[2] in FAMILIES}
    assert all(row.counts[3] == 0 for row in found.cells)  # no error


def test_published_rates_are_of_the_same_kind_of_memory(found: Score) -> None:
    for row in table(PAGE, "family"):
        ours, theirs = (row[name].strip("`") for name in ("ours", "released"))
        kept = "retrieval-framesamp-modul" if "retrieval" in ours else "perceptual-framesamp-modul"
        assert theirs == kept and "framesamp" in ours
        key = {"family": row["family"], "condition": row["condition"], "system": ours}
        one = made.record(found, "paper_family", published_system=theirs, **key)
        told = (row["n"], row["rate"], row["rate of 50"], row["difference"])
        ends = (one["difference"], one["difference_low"], one["difference_high"])
        change, low, high = (f"{100 * end:+.0f}" for end in ends)
        rates = (f"{100 * one['rate']:.0f}%", f"{100 * one['published_rate']:.0f}%")
        assert told == (str(one["n"]), *rates, f"{change} ({low} to {high})")
    assert len(table(PAGE, "family")) == 12


def test_changes_by_family_are_those_of_the_score(found: Score) -> None:
    for row in table(PAGE, "lesson's family"):
        key = {"system": "replay-framesamp", "condition": "k7", "family": row["lesson's family"]}
        one = made.record(found, "family_effects", **key)
        ends = (one["difference"], one["low"], one["high"])
        change, low, high = (f"{100 * end:+.0f}" for end in ends)
        assert [*row.values()][1:] == [
            *(str(one[name]) for name in ("pairs", "gained", "lost")),
            f"{change} ({low} to {high})",
            f"{one['p_holm']:.2g}",
        ]
    assert len(table(PAGE, "lesson's family")) == 3


def test_every_failure_is_told_and_who_solves_it(found: Score) -> None:
    """Those of MoveCube in a sentence; of the others every episode."""
    solved = {
        (row.system, row.condition, row.family, row.episode): row.status == "success"
        for row in found.rows
        if row.family != "MoveCube"
    }
    told = []
    for row in table(PAGE, "system | condition | solved by"):
        by, *here = (row[name].strip("`") for name in ("solved by", "system", "condition"))
        for family, numbers in re.findall(r"([A-Z]\w+) ([\d, ]+)", row["episodes"]):
            for number in map(int, numbers.strip(", ").split(",")):
                told.append((*here, family, number))
                system = "replay-full" if by == "none" else by
                assert solved[system, here[1], family, number] == (by != "none"), (by, *told[-1])
    assert sorted(told) == sorted(key for key, well in solved.items() if not well)
