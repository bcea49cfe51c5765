"""What docs/results/day.md states is what its rows say, of the versions that the code has."""

import csv
import re
from collections import Counter
from pathlib import Path

import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from support import scoring as made
from support.pages import RESULTS, table

from robomme_interference_data.constants import ABILITIES, PROTOCOL_VERSION
from robomme_interference_data.schema.days import LEAST_FRAMES
from robomme_interference_data.stats.intervals import newcombe_paired
from robomme_interference_data.stats.significance import holm

PAGE = (RESULTS / "day.md").read_text(encoding="utf-8")
FOLDER = RESULTS / "day"
MEMORIES = ("full", "framesamp-128", "framesamp-32", "window-60s")
LAST = "day-k7"


def read(name: str) -> list[dict[str, str]]:
    with (FOLDER / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_spans_of_the_days() -> None:
    """`build` says whether a day's buffers can fit before it plays the day: by `LEAST_FRAMES`."""
    spans = read("spans.csv")
    frames = Counter[str]()
    for span in spans:
        least = LEAST_FRAMES.get(span["part"], 10)
        assert int(span["frames"]) >= least, span
        frames[span["day"].split("/")[1]] += int(span["frames"])
    assert {span["part"] for span in spans} == {"transition", *LEAST_FRAMES}
    assert f"{frames['test']:,} frames ({frames['test'] / 600:.0f} minutes)" in PAGE


def ceilings(part: str, condition: str) -> dict[str, dict[str, str]]:
    return {
        row["memory"]: row
        for row in read("ceilings.csv")
        if (row["part"], row["condition"]) == (part, condition)
    }


def percent(value: str) -> str:
    return f"{100 * float(value):.1f}%"


def test_ceilings_by_ability() -> None:
    listed = table(PAGE, "ability | queries")
    assert [row["ability"].strip("`") for row in listed] == [*ABILITIES, "all"]
    for row in listed:
        part = row["ability"].strip("`")
        found, without = ceilings(part, LAST), ceilings(part, "no-history")
        assert row["queries"] == found["full"]["queries"]
        known = {"absent": "100.0%", "all": "17.4%"}.get(part, "0.0%")
        assert {percent(cell["success"]) for cell in without.values()} == {known}
        assert percent(found["full"]["success"]) == "100.0%"
        for memory in MEMORIES[1:]:
            assert row[f"`{memory}`"] == percent(found[memory]["success"])


def test_ceilings_by_distance() -> None:
    listed = table(PAGE, "condition | `framesamp-128`")
    assert len(listed) == 6
    for row in listed:
        found = ceilings("all", row["condition"].strip("`"))
        assert percent(found["full"]["success"]) == "100.0%"
        for memory in MEMORIES[1:]:
            assert row[f"`{memory}`"] == percent(found[memory]["success"])


@pytest.fixture(scope="module")
def successes() -> Counter[tuple[str, str]]:
    rows = pq.read_table(FOLDER / "asked.parquet").to_pylist()
    assert {row["protocol_version"] for row in rows} == {PROTOCOL_VERSION}
    return Counter((row["system"], row["condition"]) for row in rows if row["success"])


def test_the_observer_reaches_its_ceiling(successes: Counter[tuple[str, str]]) -> None:
    """Asked with a few options, it is right as often as among all answers, or more often."""
    for memory in MEMORIES:
        for condition in ("no-history", "day-alone", "day-k0", LAST, "day-cut-k7"):
            expected = float(ceilings("all", condition)[memory]["success"])
            count = successes[f"observer-{memory}", condition]
            assert count / 149 > expected - 0.02
            if memory == "full" and condition != "no-history":
                assert count == 149


def test_retrieval(successes: Counter[tuple[str, str]]) -> None:
    graded = {
        (row["rule"].partition("/")[0], row["part"], row["condition"]): row
        for row in read("retrieval.csv")
    }
    for row in table(PAGE, "rule | hit"):
        rule = row["rule"].strip("`")
        found, cut = (graded[rule, "all", name] for name in (LAST, "day-cut-k7"))
        for head, column in (
            ("hit", "hit"),
            ("purity", "purity"),
            ("coverage", "coverage"),
            ("evidence kept", "evidence_kept"),
        ):
            assert row[head] == f"{100 * float(found[column]):.0f}%"
        assert row["kept under `day-cut-k7`"] == f"{100 * float(cut['evidence_kept']):.0f}%"
        for memory in ("full", "framesamp-32"):
            if rule != "oracle":
                count = successes[f"observer-{memory}-{rule}", LAST]
                assert row[f"`observer-{memory}`"] == str(count)
    for row in table(PAGE, "evidence kept of"):
        ability = row["evidence kept of"].strip("`")
        for rule in ("max", "window", "windows3", "changes", "oracle"):
            kept = graded[rule, ability, LAST]["evidence_kept"]
            assert row[f"`{rule}`"] == f"{100 * float(kept):.0f}%"


def test_controls(successes: Counter[tuple[str, str]]) -> None:
    for system in ("questions-abstain", "questions-guess"):
        assert successes[system, LAST] == 26
    assert successes["observer-window-60s", LAST] == 26
    assert successes["observer-window-60s-windows3", LAST] == 126
    assert successes["observer-framesamp-32", LAST] == 117
    assert successes["observer-framesamp-32", "day-cut-k7"] == 114


@pytest.mark.parametrize(
    ("file", "first", "second", "gained", "lost"),
    [
        ("asked", ("observer-framesamp-32", "day-cut-k7"), ("observer-framesamp-32", LAST), 8, 5),
        (
            "asked",
            ("observer-framesamp-32", LAST),
            ("observer-framesamp-32-windows3", LAST),
            20,
            16,
        ),
        ("asked", ("observer-window-60s", LAST), ("observer-window-60s-windows3", LAST), 100, 0),
        ("acted", ("replay-framesamp", "day-alone"), ("replay-framesamp", LAST), 0, 29),
        ("acted", ("replay-framesamp", LAST), ("retrieval-replay-framesamp-changes", LAST), 7, 2),
        ("acted", ("replay-framesamp", LAST), ("retrieval-replay-framesamp-windows3", LAST), 10, 1),
    ],
)
def test_paired_changes(
    file: str, first: tuple[str, str], second: tuple[str, str], gained: int, lost: int
) -> None:
    rows = pq.read_table(FOLDER / f"{file}.parquet").to_pylist()
    before, after = (
        {
            (row["family"], row["episode"]): row["success"]
            for row in rows
            if (row["system"], row["condition"]) == key
        }
        for key in (first, second)
    )
    assert before.keys() == after.keys()
    changes = Counter((before[query], after[query]) for query in before)
    assert (changes[False, True], changes[True, False]) == (gained, lost)
    interval = newcombe_paired(changes[True, True], gained, lost, changes[False, False])
    low, high = (f"{100 * abs(bound):.1f}" for bound in sorted(interval, key=abs))
    assert re.search(rf"{low} to \+?{high}[^(]*; {gained} gained, {lost} lost", PAGE)


def test_rollouts() -> None:
    score = made.score(FOLDER / "acted.parquet")
    cells = {(cell.system, cell.condition, cell.part): cell for cell in score.cells if cell.n}
    listed = table(PAGE, "history | MoveCube (17)")
    assert len(listed) == 5
    for row in listed:
        condition, _, rule = row.pop("history").partition(", retrieval ")
        system = f"retrieval-replay-framesamp-{rule.strip('`')}" if rule else "replay-framesamp"
        for head, text in row.items():
            part, _, n = head.removesuffix(")").partition(" (")
            cell = cells[system, condition.strip("`"), "" if part == "all" else part]
            assert (text, n) == (str(cell.counts[0]), str(cell.n))
    # McNemar's exact p of 10 gained and 1 lost, of 7 and 2, of 1 and 1.
    corrected = holm([24 / 2**11, 92 / 2**9, 1.0])
    assert f"p = {corrected[0]:.3f} for three rules" in PAGE


def test_learner(tmp_path: Path) -> None:
    rows = pq.read_table(FOLDER / "learned.parquet").to_pylist()
    assert {row["protocol_version"] for row in rows} == {PROTOCOL_VERSION}
    seeds = {row["training_seed"] for row in rows}
    right = Counter((row["system"], row["condition"]) for row in rows if row["success"])
    asked = Counter((row["system"], row["condition"]) for row in rows)
    for row in table(PAGE, "trained on | `day-alone`"):
        system = {"`day-alone`": "learned-alone"}.get(row.pop("trained on"), "learned-stream")
        for head, text in row.items():
            condition, _, rule = head.partition(", ")
            cell = (f"{system}-{rule.strip('`')}" if rule else system, condition.strip("`"))
            assert asked[cell] == 149 * len(seeds)
            assert text == f"{100 * right[cell] / asked[cell]:.1f}%"
    alone = [row for row in rows if row["system"] == "learned-alone"]
    by_ability = Counter(
        (row["condition"], row["ability"] == "absent") for row in alone if row["success"]
    )
    assert (by_ability["day-alone", True], by_ability["day-k0", True]) == (78, 0)
    table_of_rows = pq.read_table(FOLDER / "learned.parquet")
    shown = table_of_rows.filter(pc.not_equal(table_of_rows["ability"], "absent"))
    pq.write_table(shown, tmp_path / "shown.parquet")
    cells = made.score(tmp_path / "shown.parquet", draws=2000).cells
    [cell] = [
        each
        for each in cells
        if (each.system, each.condition, each.part) == ("learned-alone", "day-alone", "")
    ]
    low, high = (f"{100 * bound:.1f}" for bound in cell.interval)
    chances = [row["chance"] for row in shown.to_pylist() if row["condition"] == "day-alone"]
    chance = f"{100 * sum(chances) / len(chances):.1f}%"
    text = f"{100 * cell.rate:.1f}% of those that have one ({low} to {high}; guessing: {chance})"
    assert text in PAGE


def test_shortcuts() -> None:
    rows = [row for row in read("shortcuts.csv") if row["condition"] == LAST]
    for row in table(PAGE, "guessed | queries"):
        target = row["guessed"]
        found = {
            line["cue"]: line
            for line in rows
            if (line["target"], line["ability"]) == (target, "all")
        }
        assert {line["queries"] for line in found.values()} == {row["queries"]}
        for cue, line in found.items():
            assert row[cue] == f"{line['right']} ({float(line['expected']):.1f})"
    answers = [row for row in rows if row["target"] == "answer" and row["ability"] != "all"]
    [update] = [row for row in answers if (row["ability"], row["cue"]) == ("update", "task")]
    assert min(answers, key=lambda row: float(row["p"])) == update
    stated = f"{update['right']} of {update['queries']} right, {float(update['expected']):.1f}"
    assert stated in PAGE and f"p = {float(update['p']):.4f} uncorrected" in PAGE
    least = min(holm([float(row["p"]) for row in answers]))
    assert f"{len(answers)} tests of the answers is {least:.2f}" in PAGE
