"""What a publication may be."""

from typing import Any

import pytest

from robomme_interference_data.cards.publication import Publication
from robomme_interference_data.errors import InvalidOptionError

COMMIT = "0123456789" * 4


def test_what_follows_from_it() -> None:
    about = Publication("people/tiny", "1.2.0", base=f"people/demos@{COMMIT}")
    assert (about.namespace, about.name, about.tag) == ("people", "tiny", "data-1.2.0")
    assert about.url == "https://huggingface.co/datasets/people/tiny"
    assert (about.base_repo, about.base_commit) == ("people/demos", COMMIT)
    assert Publication("people/tiny").base_repo is None


@pytest.mark.parametrize(
    "wrong",
    [
        {"repo_id": "tiny"},
        {"repo_id": "a/b/c"},
        {"repo_id": "a/b b"},
        {"repo_id": "a/b\n"},
        {"repo_id": "a/b.git"},
        {"repo_id": "a/--b"},
        {"repo_id": ""},
        {"repo_id": None},
        {"version": "1.0"},
        {"version": "v1.0.0"},
        {"version": "01.0.0"},
        {"version": "1.0.0\n"},
        {"license": "CC BY 4.0"},
        {"license": "a: b"},
        {"license": ""},
        {"base": "people/demos"},
        {"base": "people/demos@main"},
        {"base": f"people/demos@{COMMIT}@"},
        {"base": f"demos@{COMMIT}"},
    ],
)
def test_what_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidOptionError, match="expected") as caught:
        Publication(**{"repo_id": "people/tiny", **wrong})
    assert repr(next(iter(wrong.values())))[:6] in caught.value.message


@pytest.mark.parametrize("place", [None, ".", "demo/split", 7, f"demos@{COMMIT}"])
def test_a_base_that_is_none_is_left_aside(place: object) -> None:
    assert Publication("people/tiny").made_for(place).base is None


def test_a_base_is_taken_over_once() -> None:
    places = [f"people/{name}@{COMMIT}" for name in ("demos", "others")]
    about = Publication("people/tiny").made_for(places[0])
    assert about.base == about.made_for(places[1]).base == places[0]
