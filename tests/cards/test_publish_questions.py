"""Questions about the past travel with their split: published, fetched, verified, in its card."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.cards import OF_SPLIT
from support.hub_server import HubServer
from support.publishing import UNITS, files, plain_cards, publish, publisher
from support.splits import GOLDEN
from support.tabletop import TABLETOP, copy_tabletop

from robomme_interference_data import load_split
from robomme_interference_data.build_dataset.questions import write_questions
from robomme_interference_data.build_dataset.verify import verify_split
from robomme_interference_data.cards.render import split_files
from robomme_interference_data.data.questions import read_questions
from robomme_interference_data.errors import PublishError


@pytest.fixture
def _published(login: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    login("someone")
    plain_cards(monkeypatch)


def refused(split: Path, version: str | None = None) -> str:
    """Return what is said instead of publishing."""
    with pytest.raises(PublishError) as caught:
        publisher(split, version=version).plan()
    return str(caught.value.hint)


@pytest.mark.usefixtures("_published")
def test_they_are_fetched_with_the_whole_split_or_when_asked_for(
    hub: HubServer, tmp_path: Path, run: Any
) -> None:
    publish(TABLETOP)
    assert files(hub, UNITS)["questions.parquet"] == (TABLETOP / "questions.parquet").read_bytes()
    there = load_split(UNITS, revision="data-1.0.0")
    assert read_questions(there) == read_questions(load_split(TABLETOP))
    assert [*verify_split(there)] == []
    part = ("--families", "MoveCube")
    for options, comes in ((part, False), ((*part, "--questions"), True), ((), True)):
        out = tmp_path / str(len(options))
        assert run("fetch", f"{UNITS}@data-1.0.0", *options, "--to", out)[0] == 0
        assert (out / "questions.parquet").exists() == comes


@pytest.mark.usefixtures("_published")
def test_other_questions_are_another_version(hub: HubServer, tmp_path: Path) -> None:
    split = copy_tabletop(tmp_path / "split")
    questions = [*read_questions(load_split(TABLETOP)).values()]
    (split / "questions.parquet").unlink()
    publish(split)
    write_questions(questions, split)
    assert "--version 1.1.0" in refused(split)  # some were added
    publish(split, version="1.1.0")
    first = questions[0]
    turned = replace(first, right=(first.right + 1) % len(first.options))
    write_questions([turned, *questions[1:]], split)
    assert "--version 2.0.0" in refused(split)  # one is another


def test_the_card_tells_of_them() -> None:
    for split, told in ((TABLETOP, True), (GOLDEN, False)):
        card = split_files(load_split(split), OF_SPLIT)
        assert (b"`questions.parquet`" in card["README.md"]) == told
        assert (b"config_name: questions" in card["README.md"]) == told
        sets = {one["name"]: one for one in json.loads(card["croissant.json"])["recordSet"]}
        assert ("questions" in sets) == told
        if told:
            types = {one["name"]: one["dataType"] for one in sets["questions"]["field"]}
            assert (types["picture"], types["text"]) == ("sc:ImageObject", "sc:Text")
