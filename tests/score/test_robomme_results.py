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


def test_every_failure_is_told(found: Score) -> None:
    """Those of MoveCube, and without history, in a line each; of the others every episode."""
    told = {
        (row["system"].strip("`"), row["condition"], family, int(number))
        for row in table(PAGE, "system | condition | episodes")
        for family, numbers in re.findall(r"([A-Z]\w+) ([\d, ]+)", row["episodes"])
        for number in re.findall(r"\d+", numbers)
        if family != "MoveCube"
    }
    failed = {
        (row.system, row.condition, row.family, row.episode)
        for row in found.rows
        if row.status != "success" and row.family != "MoveCube" and row.condition != "no-history"
    }
    assert told == failed
