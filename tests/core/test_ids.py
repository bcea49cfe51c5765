"""Episode ids and lists of numbers: parse and format are inverses, and typos get a hint."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises

from robomme_interference_data import EpisodeId
from robomme_interference_data.constants import FAMILIES, SPLITS
from robomme_interference_data.errors import InvalidIdError, InvalidOptionError
from robomme_interference_data.ids import count_numbers, format_numbers, nth_number, parse_numbers

IDS = st.builds(
    EpisodeId,
    st.sampled_from(FAMILIES) | st.from_regex(r"[A-Za-z][A-Za-z0-9_.-]{0,8}", fullmatch=True),
    st.sampled_from(SPLITS),
    st.integers(0, 10**18 - 1),
    st.none() | st.integers(0, 10**18 - 1),
) | st.builds(
    EpisodeId,
    st.sampled_from(FAMILIES),
    st.sampled_from(SPLITS),
    st.integers(0, 10**18 - 1),
    st.none(),
    st.integers(0, 10**18 - 1),
)


@given(IDS)
def test_round_trip(episode: EpisodeId) -> None:
    assert EpisodeId.parse(str(episode)) == episode
    assert EpisodeId.parse(episode) is episode


@pytest.mark.parametrize(
    "given",
    [
        *("", "MoveCube", "MoveCube/test", "MoveCube/test/1/2/3", "MoveCube/test/01", "/test/1"),
        *("MoveCube/test/-1", "MoveCube/test/1.0", "MoveCube/test/", "MoveCube/tset/1"),
        *("9Family/test/1", "Move Cube/test/1", "MoveCube/test/1 ", "MoveCube/test/٣", "../test/1"),
        *("MoveCube/test/1234567890123456789", None, 7, ("MoveCube", "test", 1)),
        *("all/test/1", "easy/test/1"),  # names of other rows of tables
        *("MoveCube/test/1@0", "MoveCube/test/1@", "MoveCube/test/1@08", "MoveCube/test/1@8@9"),
        *("MoveCube/test/1/2@8", "MoveCube@8/test/1", "MoveCube/test/1@-8"),
    ],
)
def test_what_is_no_id(given: Any) -> None:
    with pytest.raises(InvalidIdError):
        EpisodeId.parse(given)


@pytest.mark.parametrize("number", [-1, 10**18, True, "3", 1.0])
def test_indices_and_answers_are_numbers(number: Any) -> None:
    with raises(InvalidIdError):
        EpisodeId("MoveCube", "test", number)
    with raises(InvalidIdError):
        EpisodeId("MoveCube", "test", 1, number)
    with raises(InvalidIdError):
        EpisodeId("MoveCube", "test", 1, None, number)


def test_starts_of_units() -> None:
    unit = EpisodeId.parse("MoveCube/train/1@1000")
    assert unit == EpisodeId("MoveCube", "train", 1, start=1000)
    assert str(unit) == "MoveCube/train/1@1000"
    assert unit.scene == EpisodeId("MoveCube", "train", 1) != unit
    assert str(EpisodeId("MoveCube", "train", 1, start=0)) == "MoveCube/train/1"


def test_answers_scenes_and_a_misspelled_split() -> None:
    assert EpisodeId.parse("MoveCube/test/1/2") == EpisodeId("MoveCube", "test", 1, 2)
    assert str(EpisodeId("MoveCube", "test", 1, 0)) == "MoveCube/test/1/0"
    assert EpisodeId("MoveCube", "test", 1, 2).scene == EpisodeId("MoveCube", "test", 1)
    with pytest.raises(InvalidIdError) as caught:
        EpisodeId.parse("MoveCube/tset/1")
    assert caught.value.hint == "Did you mean 'test'?"


def test_canonical_order() -> None:
    texts = [
        *("VideoRepick/train/0", "VideoRepick/test/2", "VideoRepick/test/2/0"),
        *("VideoRepick/test/2/1", "VideoRepick/test/10"),
        *("VideoRepick/test/10@9", "VideoRepick/test/10@10", "VideoRepick/test/11"),
        *("RouteStick/train/0", "AFamily/val/0", "Other/train/1"),
    ]
    ids = [EpisodeId.parse(text) for text in texts]
    assert sorted(reversed(ids)) == ids


@given(st.sets(st.integers(0, 300), min_size=1))
def test_numbers_round_trip(numbers: set[int]) -> None:
    text, expected = format_numbers(sorted(numbers)), sorted(numbers)
    assert parse_numbers(text) == tuple(expected)
    nth = [nth_number(text, n) for n in range(len(numbers) + 1)]
    assert nth == [*expected, None]
    assert format_numbers([0, 1, 2, 5]) == "0-2,5"


@pytest.mark.parametrize(
    ("text", "numbers"),
    [("0-3", (0, 1, 2, 3)), ("0,3,10-12", (0, 3, 10, 11, 12)), (" 5 , 5-6", (5, 6)), ("7", (7,))],
)
def test_numbers(text: str, numbers: tuple[int, ...]) -> None:
    assert parse_numbers(text) == numbers
    assert count_numbers(text) in (len(numbers), len(numbers) + 1)  # 5 comes twice in one of them


@pytest.mark.parametrize("text", ["", "a", "3-1", "1-", "-1", "1,,2", "1 2", "1.5", "1-2-3"])
def test_what_is_no_list_of_numbers(text: str) -> None:
    with pytest.raises(InvalidOptionError) as caught:
        parse_numbers(text)
    assert str(caught.value).count(repr(text)) <= 1
    with pytest.raises(InvalidOptionError):
        count_numbers(text)


@pytest.mark.parametrize("text", ["0-99999999", "0-1000000"])
def test_too_many_numbers_are_called_that(text: str) -> None:
    for parse in (parse_numbers, count_numbers):
        with raises(InvalidOptionError):
            parse(text)
