"""`robomme-interference card`."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.cards import RUN
from support.splits import GOLDEN

from robomme_interference_data.cards.publication import Publication
from robomme_interference_data.cards.render import results_text

Run = Callable[..., tuple[int, str, str]]


@pytest.mark.parametrize("folder", ["", "demonstrations"])
def test_a_card_is_printed(run: Run, folder: str) -> None:
    code, out, err = run(
        *("card", GOLDEN / folder, "--repo-id", "people/tiny"),
        *("--version", "2.0.1", "--license", "cc0-1.0"),
    )
    assert (code, err) == (0, "")
    assert out.startswith("---\npretty_name: ")
    assert "license: cc0-1.0\n" in out
    assert "data-2.0.1" in out
    assert "people/tiny" in out


def test_a_card_of_a_run(run: Run) -> None:
    code, out, _ = run("card", RUN)
    assert code == 0
    assert out == results_text(RUN, Publication("namespace/name"))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ((GOLDEN, "--repo-id", "tiny"), "--repo-id 'tiny'"),
        ((GOLDEN, "--version", "2"), "--version '2'"),
        ((GOLDEN, "--license", "MIT License"), "--license 'MIT License'"),
        ((GOLDEN / "distractors",), "dataset of distractors"),
        ((GOLDEN / "demonstrations" / "data",), "holds no split"),
        (("nowhere",), "neither a folder"),
        (("nobody/nothing",), "HF_HUB_OFFLINE"),
    ],
)
def test_what_is_refused(run: Run, given: tuple[str | Path, ...], told: str) -> None:
    code, out, err = run("card", *given)
    assert (code, out) == (1, "")
    assert told in err


def test_a_card_needs_jinja2(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    code, _, err = run("card", GOLDEN)
    assert code == 1
    assert "robomme-interference-data[score]" in err
