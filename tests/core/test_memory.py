"""Memory rules: which frames they keep, and their one spelling."""

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.schema.sampling import Memory

# Seconds and frames per second that make a whole number of frames from 2.
_RATES = st.integers(1, 1000).map(lambda hundredths: Fraction(hundredths, 100))
TIMED = st.tuples(st.integers(2, 50), _RATES).filter(
    lambda pair: (1000 * pair[0] / pair[1]).denominator == 1
)


def window(frames: int, rate: Fraction) -> Memory:
    """The window of so many frames, by its spelling."""
    return Memory.parse(f"window:{float(frames / rate)}@{float(rate)}")


def kept(text: str, live: int) -> list[int]:
    return list(Memory.parse(text).earlier(live))


def test_frames_by_hand() -> None:
    assert kept("full", 5) == [0, 1, 2, 3, 4]
    assert kept("window", 100) == list(range(69, 100))  # 32 with the live one
    assert kept("framesamp", 30) == list(range(30))
    # numpy truncates linspace(0, 310, 32) to 0, 10, …, 310; the last one is the live frame.
    assert kept("framesamp", 310) == list(range(0, 310, 10))
    assert Memory.parse("window:3").kept([5, 6, 8, 9]) == [8, 9]  # two, and the live one


def test_windows_in_seconds_by_hand() -> None:
    # 60 s at 2 frames per second: 120 frames, every fifth, the oldest one 595 frames old.
    assert kept("window:60@2", 1000) == list(range(405, 1000, 5))
    # As SimpleMemVLA counts, 20 frames a second: every tenth, the oldest one 1190 frames old.
    assert kept("window:120@1", 2000) == list(range(810, 2000, 10))
    # LeRobot's pi05 with memory_frames=6, memory_stride=10.
    assert kept("window:6@1", 1000) == [950, 960, 970, 980, 990]
    # 0.5, 1, 1.5 and 2 s old: 2.5 s is too old.
    assert kept("window:2.5@2", 100) == [80, 85, 90, 95]
    # A frame in two seconds.
    assert kept("window:10@0.5", 100) == [20, 40, 60, 80]
    # 1/3 s is 3⅓ frames: the newest frames that are at least that old are 4, 7 and 10 back.
    assert kept("window:1@3", 100) == [93, 96]
    # 1/7 s is 10/7 frames: 2, 3, 5, 6, 8, 9 back.
    assert kept("window:1@7", 100) == [91, 92, 94, 95, 97, 98]


def test_a_short_history() -> None:
    assert kept("window:60@2", 0) == kept("window:60@2", 4) == []
    assert kept("window:60@2", 5) == [0]
    assert kept("window:60@2", 12) == [2, 7]
    # 594 frames are one too few for the oldest place, 595 are enough.
    assert (len(kept("window:60@2", 594)), kept("window:60@2", 595)[0]) == (118, 0)


def test_places_count_and_not_when_frames_were_recorded() -> None:
    # A history of which a retrieval step chose frames 100 to 119 and 300 to 309.
    received = [*range(100, 120), *range(300, 310)]
    assert Memory.parse("window:3@2").kept(received) == [105, 110, 115, 300, 305]


@given(st.sampled_from(["full", "framesamp", "window"]), st.integers(0, 5000))
def test_a_memory_keeps_existing_frames_in_order(name: str, live: int) -> None:
    found = kept(name, live)
    assert found == sorted(set(found)) and set(found) <= set(range(live))
    assert len(found) == min(live, 31) or name == "full"


@given(TIMED, st.integers(0, 300))
def test_a_window_keeps_what_its_definition_says(pair: tuple[int, Fraction], live: int) -> None:
    frames, rate = pair
    # Ages in frames, of which ten are a second, from the newest frame on.
    ages = range(1, live + 1)
    old_enough = ((age for age in ages if age * rate >= 10 * j) for j in range(1, frames))
    found = [live - age for age in (next(one, None) for one in old_enough) if age is not None]
    assert list(window(*pair).earlier(live)) == found[::-1]


@given(TIMED, st.integers(0, 300), st.integers(1, 300))
def test_a_window_moves_with_the_live_frame(
    pair: tuple[int, Fraction], live: int, later: int
) -> None:
    now, then = window(*pair).earlier(live), window(*pair).earlier(live + later)
    moved = [place - later for place in then if place >= later]
    assert moved == list(now)


@given(TIMED)
def test_every_spelling_of_a_window_is_read_back(pair: tuple[int, Fraction]) -> None:
    memory = window(*pair)
    assert (memory.frames, memory.rate) == pair
    assert Memory.parse(str(memory)) == memory


@pytest.mark.parametrize(
    ("text", "spelled", "label"),
    [
        ("full", "full", "full"),
        ("framesamp", "framesamp:32", "framesamp"),
        ("framesamp:008", "framesamp:8", "framesamp8"),
        ("window:32", "window:32", "window"),
        ("window:60@2", "window:60@2", "window60s2fps"),
        ("window:060.0@2.00", "window:60@2", "window60s2fps"),
        ("window:2.5@2", "window:2.5@2", "window2.5s2fps"),
        ("window:60@0.5", "window:60@0.5", "window60s0.5fps"),
        # At ten frames per second every frame is kept.
        ("window:3.2@10", "window:32", "window"),
        ("window:0.5@10", "window:5", "window5"),
    ],
)
def test_one_spelling(text: str, spelled: str, label: str) -> None:
    memory = Memory.parse(text)
    assert (str(memory), memory.label) == (spelled, label)
    assert Memory.parse(spelled) == memory


@pytest.mark.parametrize(
    "text",
    [
        "framesamp:1",
        "full:9",
        "window:",
        "window:-3",
        "framesamp:5@2",  # only windows have seconds
        "window:5@",
        "window:1e2@2",
        "window:60@20",  # more than there are
        "window:2.5@0.5",  # 1.25 frames
        "window:1@1",  # the live frame alone
        "window:60@0",
    ],
)
def test_sizes_that_are_none(text: str) -> None:
    with raises(InvalidOptionError) as error:
        Memory.parse(text)
    assert error.value.option == "memory"


def test_an_unknown_rule() -> None:
    with raises(UnknownNameError):
        Memory.parse("windw")
