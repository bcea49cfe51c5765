"""Headlines and first screens: of known findings, and with the numbers of the tables alone."""

import csv
import io
import re
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from support import findings
from support import scoring as made
from support.browser import open_page
from support.screens import first_screen

from robomme_interference_data.evaluate.score.plots.data import Data
from robomme_interference_data.evaluate.score.plots.figures import draw_figure
from robomme_interference_data.evaluate.score.report.headline import headline
from robomme_interference_data.evaluate.score.report.page import write_report
from robomme_interference_data.evaluate.score.report.quotes import Quote, Sentence
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.viz.figure import open_figure, save_figure
from robomme_interference_data.viz.tables import Table

GOLDEN = made.ROOT / "tests" / "golden" / "first_screens.md"
SCALE = {"rate": (100, 1), "points": (100, 1), "count": (1, 0), "p": (1, 3), "number": (1, 4)}


@pytest.fixture(scope="module")
def scores(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Score]:
    """The score of each finding."""
    folder = tmp_path_factory.mktemp("findings")
    return {name: findings.scored(name, folder) for name in findings.FINDINGS}


@pytest.fixture(scope="module")
def pages(scores: dict[str, Score], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The report of each finding, with the figure of its first screen."""
    folder = tmp_path_factory.mktemp("reports")
    written = {}
    for name, found in scores.items():
        figures = {}
        with open_figure() as figure:
            if draw_figure("family_falls", figure, Data(found, "tabletop")):
                figures["family_falls-tabletop"] = folder / f"{name}.svg"
                save_figure(figure, folder / f"{name}.svg")
        written[name] = folder / f"{name}.html"
        write_report(found, figures, written[name])
    return written


@pytest.mark.slow
def test_first_screens_are_the_golden_ones(
    pages: dict[str, Path], request: pytest.FixtureRequest
) -> None:
    """Run with `--write-messages`, it writes them."""
    texts = {name: first_screen(path.read_text(encoding="utf-8")) for name, path in pages.items()}
    found = "\n".join(f"# {name}\n\n{text}" for name, text in texts.items())
    if request.config.getoption("--write-messages"):
        GOLDEN.write_text(found, encoding="utf-8", newline="\n")
    assert found == GOLDEN.read_text(encoding="utf-8")


@pytest.mark.slow
def test_first_screens_fit_a_desktop(pages: dict[str, Path]) -> None:
    wide = "[...document.querySelectorAll('.screen :is(.wide, .picture)')]"
    with open_page() as page:
        size = {"width": 1280, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        page.call("Emulation.setDeviceMetricsOverride", **size)
        for name, path in pages.items():
            page.events.clear()
            page.open(path)
            assert page.run("document.documentElement.scrollWidth") <= 1280, name
            # Nothing is cut off to the right, and no part is empty.
            assert page.run(f"{wide}.filter(e => e.scrollWidth > e.clientWidth + 1).length") == 0
            assert page.run(f"{wide}.filter(e => e.clientHeight < 40).length") == 0
            # The headline is above the fold.
            end = "document.querySelector('.headline').getBoundingClientRect().bottom"
            assert page.run(end) < 600, name
            assert page.complaints() == []


# --- numbers -----------------------------------------------------------------------------------


def is_of(table: Table, quote: Quote) -> bool:
    """Whether a number is that of the table's file, as it is rounded; without sign, its size."""
    if not quote.column:
        return quote.text == f"{len(set(quote.rows)):,}"
    (place,) = quote.rows
    value = float(list(csv.DictReader(io.StringIO(table.csv())))[place][quote.column])
    scale, digits = SCALE[table.columns[quote.column]]
    if quote.text == "< 0.001":
        return value < 0.001
    text = quote.text.removesuffix("%").replace(",", "").replace("\N{MINUS SIGN}", "-")
    if text[0] not in "+-":
        value = abs(value)
    return abs(float(text) - scale * value) <= 0.5001 * 10**-digits


def numbers(sentence: Sentence, systems: list[str]) -> list[str]:
    """The numbers in a sentence, besides those in names of systems and conditions, and levels."""
    text = sentence.text
    for name in sorted(map(display_name, systems), key=len, reverse=True):
        text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", "", text)
    text = re.sub(r"\b([a-z]+-)?k[0-9]+\b|9[05]% interval", "", text)
    return re.findall(
        r"< 0\.001|[+\N{MINUS SIGN}]?[0-9][0-9.,]*[0-9]%?|[+\N{MINUS SIGN}]?[0-9]%?", text
    )


def check(found: Score) -> None:
    """Every number of every sentence is in the table that it is quoted from."""
    for outcomes in found.all_outcomes:
        sentences = headline(found, outcomes.simulator)
        assert 1 < len(sentences) <= 4
        for sentence in sentences:
            assert re.match(r"[A-Z].*\.$", sentence.text)
            assert numbers(sentence, list(outcomes.systems)) == [q.text for q in sentence.quotes]
            for quote in sentence.quotes:
                tables = {**found.tables}
                assert is_of(tables[quote.table], quote), (sentence.text, quote)


def test_every_number_of_a_finding_is_in_a_table(scores: dict[str, Score]) -> None:
    for found in scores.values():
        check(found)
    # Each finding has numbers.
    texts = chain(*(headline(found, "tabletop") for found in scores.values()))
    assert sum(len(sentence.quotes) for sentence in texts) > 50


def test_every_number_of_other_scores_is_in_a_table(
    small: Score, kinds: Score, questions: Score, full: Score
) -> None:
    for found in (small, kinds, questions, full):
        check(found)


def test_every_number_of_offline_runs_is_in_a_table(tmp_path: Path) -> None:
    errors = {("mine", "k0"): 0.2, ("mine", "no-history"): 0.1, ("hold", "no-history"): 0.15}
    rows = [
        replace(made.recording(condition, number, (error + number / 1000,)), system=system)
        for (system, condition), error in errors.items()
        for number in range(12)
    ]
    found = made.score(made.write_parquet(tmp_path / "a.parquet", rows))
    check(found)
    # The mean of 0.2 to 0.211, and of the others.
    worse = str(headline(found, "recordings")[1])
    assert "mine (0.2055) is worse than itself without history (0.1055) and than Hold" in worse
    rows.append(replace(made.recording("k0", 12, None), system="mine"))
    broken = made.score(made.write_parquet(tmp_path / "b.parquet", rows))
    check(broken)
    first, lacking, _ = map(str, headline(broken, "recordings"))
    assert "mine has an action error of 0.1055" in first and "1 broke" in lacking


# --- which systems a sentence is about -----------------------------------------------------------


Cell = tuple[str, str]


def sentences(tmp_path: Path, outcomes: dict[Cell, str], **options: Any) -> list[Sentence]:
    """The headline of cells of one family: a letter an episode."""
    path = made.write_csv(tmp_path / "a.csv", made.cells(outcomes))
    found = made.score(path, **options)
    check(found)
    return headline(found, "tabletop")


def test_a_lucky_episode_does_not_lead(tmp_path: Path) -> None:
    given = {("lucky", "k0"): "s----", ("mine", "k0"): "sssff", ("mine", "k7"): "sffff"}
    rates, falls, lacking, _ = sentences(tmp_path, given)
    assert "mine succeeds in 60.0%" in rates.text
    assert "lucky" not in rates.text + falls.text and "lucky" in lacking.text


def test_rates_of_an_incomplete_fall_are_over_the_episodes_of_both_cells(tmp_path: Path) -> None:
    given = {("a", "k0"): "sssss", ("a", "k7"): "sssf-", ("b", "k0"): "ssfff", ("b", "k7"): "sffff"}
    rates, falls, lacking, step = sentences(tmp_path, given)
    assert "b succeeds" in rates.text and "of b" in falls.text
    # Over four episodes, 4 of which succeed under k0 and 3 under k7.
    assert "over the 4 episodes that finished under both, a succeeds in 100.0% at k0" in (
        lacking.text
    )
    assert "75.0% at k7" in lacking.text and "evaluate" in step.text
    alone = {cell: letters for cell, letters in given.items() if cell[0] == "a"}
    rates, falls, *_ = sentences(tmp_path, alone)
    assert "over the 4 episodes" in rates.text and "provisional" in falls.text


def test_all_systems_have_a_verdict_of_their_own(tmp_path: Path) -> None:
    given = {(name, "k0"): "s" * 12 for name in ("a", "b", "c")}
    given |= {(name, "k7"): "f" * n + "s" * (12 - n) for name, n in (("a", 12), ("b", 1), ("c", 0))}
    given |= {("oracle", "k0"): "s" * 12, ("oracle", "k7"): "f" * 12}  # a reference
    rates, falls, *_ = sentences(tmp_path, given)
    assert rates.text.startswith("In tabletop, 3 systems succeed")
    # Of a, p is 2/2¹² for each of nine or fewer comparisons.
    assert falls.text == "A fall is shown for 1 of 3: a; no fall is shown for 2 of 3: b and c."


@pytest.mark.parametrize(
    ("outcomes", "rates", "step"),
    [
        ({("a", "k1"): "sf", ("b", "k1"): "fs", ("b", "k7"): "ff"}, "under k1", "run k0"),
        ({("a", "no-history"): "sffffffffffff"}, "under no history", "run k0"),
        ({("a", "k0"): "sfs"}, "under k0", "run k7"),
        ({("oracle", "k0"): "s", ("a", "k0"): "f"}, "a succeeds in 0.0%", "run k7"),
        (
            {("oracle", "k0"): "s", ("oracle", "k7"): "f"},
            "Oracle succeeds in 100.0%",
            "no reference",
        ),
    ],
)
def test_without_a_fall_only_rates_are_stated(
    tmp_path: Path, outcomes: dict[Cell, str], rates: str, step: str
) -> None:
    first, *_, last = sentences(tmp_path, outcomes)
    assert rates in first.text and step in last.text


def test_nobody_whose_rollouts_all_broke_has_a_rate(tmp_path: Path) -> None:
    path = made.write_csv(tmp_path / "a.csv", made.cells({("a", "k0"): "e", ("b", "k0"): "s"}))
    rates, lacking, _ = headline(made.score(path), "tabletop")
    assert "a in" not in rates.text and "1 broke" in lacking.text


def test_a_fall_whose_interval_holds_0_is_not_called_below(tmp_path: Path) -> None:
    """Of three tests, alpha's p of 0.031 is the largest, and its interval has a level of 98.3%."""
    given = {
        ("alpha", "k0"): "s" * 14 + "f" * 46,
        ("alpha", "k7"): "f" * 14 + "s" * 4 + "f" * 42,
        ("beta", "k0"): "s" * 60,
        ("beta", "k7"): "f" * 60,
    }
    _, falls, *_ = sentences(tmp_path, given)
    alpha, beta = falls.text.split("; ")
    assert "alpha's k7 minus its own k0 is \N{MINUS SIGN}16.7 points" in alpha
    assert " to +" in alpha and "p = 0.031" in alpha and "points below" in beta


def test_no_more_sessions_than_k7_are_primary(tmp_path: Path) -> None:
    given = {("a", name): "sfsf" for name in ("k0", "k7", "k31")}
    rates, falls, _ = sentences(tmp_path, given)
    assert "k31" not in rates.text + falls.text
