"""What a publication may be, and which version comes next."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.cards.publication import (
    Publication,
    PublishConfig,
    Version,
    versions_of,
)
from robomme_interference_data.errors import InvalidOptionError

COMMIT = "0123456789" * 4


@pytest.mark.parametrize(
    "wrong",
    [
        *({"repo_id": one} for one in ("tiny", "a/b/c", "a/b b", "a/b\n", "a/b.git", "", None)),
        *({"version": one} for one in ("1.0", "v1.0.0", "01.0.0", "1.0.0\n")),
        *({"license": one} for one in ("CC BY 4.0", "cc-by-4", "a: b", "")),
        *({"base": one} for one in ("people/demos", "people/demos@main", f"demos@{COMMIT}")),
    ],
)
def test_what_is_an_error(wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidOptionError, match="expected") as caught:
        Publication(**{"repo_id": "people/tiny", **wrong})
    assert repr(next(iter(wrong.values())))[:6] in caught.value.message


def test_licenses_are_those_of_the_hub() -> None:
    for license in ("other", "mit", "cc-by-4.0", "openrail++"):
        assert Publication("people/tiny", license=license).license == license
    with pytest.raises(InvalidOptionError) as caught:
        Publication("people/tiny", license="cc-by-4")
    assert "'cc-by-4.0'" in str(caught.value.hint) and "licenses" in str(caught.value.hint)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"repo_id": "tiny"}, "repo_id 'tiny'"),
        ({"demonstrations_id": "a/b/c"}, "demonstrations_id 'a/b/c'"),
        ({"demonstrations_id": "people/tiny"}, "are both"),
        ({"repo_id": "people/" + "a" * 90}, "demonstrations_id 'people/a*-demonstrations'"),
        ({"version": ""}, "version ''"),
    ],
)
def test_settings_that_are_an_error(options: dict[str, str], words: str) -> None:
    with pytest.raises(InvalidOptionError, match=words):
        PublishConfig(**{"repo_id": "people/tiny", **options})


@pytest.mark.parametrize("location", [None, ".", "demo/buffers", 7, f"demos@{COMMIT}"])
def test_a_base_is_a_commit_on_the_hub(location: object) -> None:
    publication = Publication("people/tiny").made_for(location)
    assert publication.base is None
    known = publication.made_for(f"people/demos@{COMMIT}")
    assert known.base == known.made_for(f"people/others@{COMMIT}").base == f"people/demos@{COMMIT}"


# --- versions ------------------------------------------------------------------------------------


def test_versions_are_tags() -> None:
    tags = {"v3.0": "a", "data-1.10.0": "b", "data-1.9.9": "c", "data-01.0.0": "d", "data-2": "e"}
    assert list(versions_of(tags).items()) == [
        (Version(1, 9, 9), "c"),
        (Version(1, 10, 0), "b"),
    ]
    texts = ("1.2", "1.2.3 ", "v1.2.3", "1.2.3")
    assert [Version.parse(text) for text in texts] == [None, None, None, Version(1, 2, 3)]


@pytest.mark.parametrize(
    ("before", "now", "following"),
    [
        ({"a": "1"}, {"a": "1"}, "1.2.4"),
        ({"a": "1"}, {"a": "1", "b": "1"}, "1.3.0"),
        ({"a": "1"}, {"a": "2", "b": "1"}, "2.0.0"),
        ({"a": "1", "b": "1"}, {"a": "1"}, "2.0.0"),
    ],
)
def test_the_next_version(before: dict[str, str], now: dict[str, str], following: str) -> None:
    assert str(Version(1, 2, 3).following(before, now)) == following


PARTS = st.dictionaries(st.sampled_from("abc"), st.sampled_from("12"))


@given(st.builds(Version, *[st.integers(0, 50)] * 3), PARTS, PARTS)
def test_the_next_version_is_later(
    version: Version, before: dict[str, str], now: dict[str, str]
) -> None:
    following = version.following(before, now)
    assert version < following <= Version(version.major + 1, 0, 0)
    assert Version.parse(str(version)) == version
    assert versions_of({version.tag: "a"}) == {version: "a"}
