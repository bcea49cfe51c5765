"""Headlines and first screens: of known findings, and with the numbers of the tables alone."""

import csv
import io
import re
from itertools import chain
from pathlib import Path

import pytest
from support import findings
from support import scoring as made
from support.screens import first_screen

from robomme_interference_data.evaluate.score.plots.figures import draw_figures
from robomme_interference_data.evaluate.score.quotes import Quote, Sentence
from robomme_interference_data.evaluate.score.report.headline import headline
from robomme_interference_data.evaluate.score.report.page import write_report
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.viz.tables import Table

GOLDEN = made.ROOT / "tests" / "golden" / "first_screens.md"
SCALE = {"rate": (100, 1), "points": (100, 1), "count": (1, 0), "p": (1, 3), "number": (1, 4)}


@pytest.fixture(scope="module")
def scores(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Score]:
    """The score of each finding."""
    folder = tmp_path_factory.mktemp("findings")
    return {name: findings.scored(name, folder) for name in findings.FINDINGS}


def screens(scores: dict[str, Score], folder: Path) -> str:
    """The first screens of findings."""
    texts = []
    for name, found in scores.items():
        out = folder / name
        write_report(found, draw_figures(found, out / "figures"), out / "report.html")
        page = (out / "report.html").read_text(encoding="utf-8")
        texts.append(f"# {name}\n\n{first_screen(page)}")
    return "\n".join(texts)


@pytest.mark.slow
def test_first_screens_are_the_golden_ones(
    scores: dict[str, Score], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    found = screens(scores, tmp_path)
    if request.config.getoption("--write-messages"):
        GOLDEN.write_text(found, encoding="utf-8", newline="\n")
    assert found == GOLDEN.read_text(encoding="utf-8")


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
        text = text.replace(name, "")
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
