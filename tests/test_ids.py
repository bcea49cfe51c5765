"""Episode ids and condition names: parse and format, order, refusals."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.constants import FAMILIES, MAX_K, SPLITS
from robomme_interference_data.errors import InterferenceError, InvalidIdError
from robomme_interference_data.ids import EpisodeId, condition_name, parse_condition

families = st.from_regex(r"[A-Za-z][A-Za-z0-9_.-]{0,20}", fullmatch=True)
episodes = st.builds(EpisodeId, families, st.sampled_from(SPLITS), st.integers(0, 10**18 - 1))


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("VideoRepick/test/7", ("VideoRepick", "test", 7)),
        ("MoveCube/train/0", ("MoveCube", "train", 0)),
        ("my-robot.v2_a/val/123456789012345678", ("my-robot.v2_a", "val", 123456789012345678)),
    ],
)
def test_parse(text: str, parts: tuple[str, str, int]) -> None:
    episode = EpisodeId.parse(text)
    assert (episode.family, episode.split, episode.index) == parts
    assert str(episode) == text


@given(episodes)
def test_parse_and_format_are_inverses(episode: EpisodeId) -> None:
    assert EpisodeId.parse(str(episode)) == episode


@pytest.mark.parametrize(
    "text",
    [
        "",
        "VideoRepick",
        "VideoRepick/test",
        "VideoRepick/test/",
        "VideoRepick/test/7/8",
        "VideoRepick/test/-1",
        "VideoRepick/test/+1",
        "VideoRepick/test/07",  # one id, one spelling
        "VideoRepick/test/1.0",
        "VideoRepick/test/1_0",
        "VideoRepick/test/ 7",
        "VideoRepick/test/7\n",
        "VideoRepick/test/٧",  # a digit, but not an ASCII one
        "VideoRepick/test/1000000000000000000",
        "VideoRepick/test/" + "1" * 5000,
        "VideoRepick/testing/7",
        "VideoRepick/Test/7",
        "/test/7",
        "7Up/test/7",
        "../etc/7",
        "Video Repick/test/7",
        "Vidéo/test/7",
        "A\n/test/7",
    ],
)
def test_refused(text: str) -> None:
    with pytest.raises(InvalidIdError) as caught:
        EpisodeId.parse(text)
    assert isinstance(caught.value, ValueError)


def test_refusal_says_what_was_expected() -> None:
    with pytest.raises(InvalidIdError, match=r"'VideoRepick' is not an episode id") as caught:
        EpisodeId.parse("VideoRepick")
    assert caught.value.hint == "Expected <Family>/<split>/<index>, for example VideoRepick/test/7."
    with pytest.raises(InvalidIdError, match=r"expected one of train, val, test") as caught:
        EpisodeId.parse("VideoRepick/tset/7")
    assert caught.value.hint == "Did you mean 'test'?"


@pytest.mark.parametrize("index", [-1, 10**18])
def test_index_out_of_range(index: int) -> None:
    with pytest.raises(InvalidIdError, match=f"{index} is out of range"):
        EpisodeId("VideoRepick", "test", index)


@given(st.text(max_size=40))
def test_any_text_is_an_id_or_one_error(text: str) -> None:
    try:
        episode = EpisodeId.parse(text)
    except InterferenceError:
        return
    assert str(episode) == text


def test_canonical_order() -> None:
    ordered = [
        # the nine in the paper's order, not by name
        *(f"{family}/test/0" for family in FAMILIES),
        # other families by name; splits in the order train, val, test; indices as numbers
        "Aaa/train/0",
        "Aaa/val/3",
        "Aaa/test/2",
        "Aaa/test/10",
        "Bbb/train/0",
    ]
    shuffled = ordered[:]
    random.Random(0).shuffle(shuffled)
    assert [str(episode) for episode in sorted(map(EpisodeId.parse, shuffled))] == ordered


@given(episodes, episodes)
def test_order_is_total(one: EpisodeId, other: EpisodeId) -> None:
    assert (one < other) + (other < one) + (one == other) == 1


@given(st.integers(0, MAX_K))
def test_conditions(k: int) -> None:
    assert condition_name(k) == f"k{k}"
    assert parse_condition(condition_name(k)) == k


@pytest.mark.parametrize(
    "text", ["", "k", "3", "K3", "k03", "k-1", "k64", "k100", "k3 ", "k" + "9" * 5000, "no-history"]
)
def test_unknown_conditions(text: str) -> None:
    with pytest.raises(InvalidIdError, match="not a condition with history"):
        parse_condition(text)
