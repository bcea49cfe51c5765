"""Names of families that are made from texts."""

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises

from robomme_interference_data.build_dataset.sources.lerobot.families import (
    families_by_task,
    recorded_splits,
)
from robomme_interference_data.build_dataset.sources.lerobot.family_names import (
    families_of,
    family_of,
    words_of,
)
from robomme_interference_data.errors import SourceError
from robomme_interference_data.ids import EpisodeId


@pytest.mark.parametrize(
    ("text", "family"),
    [
        ("Pick up the red cup.", "PickUpTheRedCup"),
        ("pick  up the\nRED cup!", "PickUpTheRedCup"),
        ("pick-up the (red) cup", "PickUpTheRedCup"),
        ("move by -3 cm", "MoveBy-3Cm"),
        ("move 1.5 m", "Move1.5M"),
        ("3 cups", "Task3Cups"),
        ("Öffne die Schublade 🗄️", "OffneDieSchublade"),
        ("so100_pick-place", "So100PickPlace"),
        # SHA-256 of "日本語", and of sixty letters a
        ("日本語", "Task-77710aed"),
        ("a" * 60, "A" + "a" * 39 + "-11ee3912"),
    ],
)
def test_families_by_hand(text: str, family: str) -> None:
    assert family_of(text) == family


@given(st.text(min_size=1))
def test_any_text_with_words_makes_a_family(text: str) -> None:
    if not words_of(text):
        return
    family = family_of(text)
    assert EpisodeId(family, "train", 0).family == family
    assert len(family) <= 53
    for form in ("NFC", "NFD"):
        assert family_of(unicodedata.normalize(form, text)) == family
    assert family_of(f"  {text} ") == family


@given(st.lists(st.text(alphabet="ab1.- öA", min_size=1), max_size=4))
def test_different_words_never_share_a_family(texts: list[str]) -> None:
    try:
        families = families_of(texts)
    except SourceError:
        return
    words = {family: words_of(text) for text, family in families.items()}
    assert all(words_of(text) == words[family] for text, family in families.items())


@pytest.mark.parametrize("texts", [["öffne", "offne"], ["a 1 5", "a 15"], ["..."]])
def test_texts_that_cannot_be_families(texts: list[str]) -> None:
    with raises(SourceError):
        families_of(texts)


def test_families_by_task() -> None:
    tasks = [["Open the drawer."], ["open  the drawer"], ["push", "Push!"]]
    assert families_by_task(tasks, "here") == {
        "Open the drawer.": "OpenTheDrawer",
        "open the drawer": "OpenTheDrawer",
        "push": "Push",
        "Push!": "Push",
    }
    for wrong in ([["open"], []], [["open", "close"]]):
        with raises(SourceError):
            families_by_task(wrong, "here")


@pytest.mark.parametrize(
    ("given", "splits"),
    [
        ({"train": "0:3"}, ["train"] * 3),
        ({"train": "0:1", "val": "1:2", "test": "2:3"}, ["train", "val", "test"]),
        ({"train": "0:3", "test": "2:9"}, ["train", "train", "test"]),
        ({}, ["train"] * 3),
        (None, ["train"] * 3),
        ({"validation": "5:7", "test": "1"}, ["train"] * 3),
    ],
)
def test_splits_that_a_dataset_records(given: object, splits: list[str]) -> None:
    assert recorded_splits(given, 3, "here") == splits


@pytest.mark.parametrize("given", [{"validation": "1:2"}, {"val": "0:2", "test": "1:3"}])
def test_splits_that_are_not_known(given: object) -> None:
    with raises(SourceError):
        recorded_splits(given, 3, "here")
