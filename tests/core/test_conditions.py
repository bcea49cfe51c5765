"""Conditions, shifts and subgoals are values: their text, order and sessions."""

import pickle
from collections import Counter
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises

from robomme_interference_data import EpisodeId
from robomme_interference_data.constants import DATASETS, DISTRACTORS
from robomme_interference_data.errors import InvalidIdError, InvalidOptionError
from robomme_interference_data.schema.conditions import (
    DEFAULT_CONDITIONS,
    KINDS,
    datasets_of,
    in_order,
    parse_condition,
)
from robomme_interference_data.schema.manifest import SessionEntry
from robomme_interference_data.schema.shifts import SHIFTS, Shift, parse_shift
from robomme_interference_data.schema.subgoal import Subgoal, read_grounded


def entry(role: str, number: int) -> SessionEntry:
    name = EpisodeId("MoveCube", "train", number)
    return SessionEntry(role, "MoveCube", name, "distractors", "r", number, 0, 32, 1, "s")


class Material:
    """Sessions whose numbers say what they are."""

    def lesson(self, part: str = "lesson") -> SessionEntry:
        return entry("lesson", {"lesson": 99, "first": 91, "second": 92, "last": 90}[part])

    def units(self, k: int, dataset: str = DISTRACTORS) -> Sequence[SessionEntry]:
        first = 0 if dataset == DISTRACTORS else 100
        return [entry("distractor", first + number) for number in range(k)]

    def own_units(self, k: int) -> Sequence[SessionEntry]:
        return [entry("distractor", 200 + number) for number in range(k)]

    def contradiction(self) -> SessionEntry:
        return entry("contradiction", 98)

    def day(self, k: int) -> Sequence[SessionEntry]:
        """Another task, two lessons, and k further tasks, each after a transition."""
        roles = ("distractor", "contradiction", "lesson", *["distractor"] * k)
        tasks = [entry(role, 300 + number) for number, role in enumerate(roles)]
        moved = [entry("transition", 400 + number) for number in range(len(tasks))]
        return [session for pair in zip(moved, tasks, strict=True) for session in pair]


def numbers(name: str) -> list[int]:
    return [one.source.index for one in parse_condition(name).sessions(Material())]


def test_the_papers_conditions() -> None:
    assert DEFAULT_CONDITIONS == ("no-history", "k0", "k1", "k3", "k7")
    assert {name: numbers(name) for name in DEFAULT_CONDITIONS} == {
        "no-history": [],
        "k0": [99],
        "k1": [99, 0],
        "k3": [99, 0, 1, 2],
        "k7": [99, 0, 1, 2, 3, 4, 5, 6],
    }


def test_those_beyond_the_paper() -> None:
    counted = [kind.name for kind in KINDS.values() if kind.counted and kind.name != "k"]
    assert {name: numbers(f"{name}-k3") for name in counted} == {
        "before": [0, 1, 2, 99],
        "middle": [0, 1, 99, 2],
        "held": [99, 90, 90, 90],
        "same": [99, 200, 201, 202],
        "parts": [91, 0, 1, 2, 92],
        "raw": [99, 100, 101, 102],
        "absent": [0, 1, 2],
        "stale": [98, 99, 0, 1, 2],
        "misled": [98, 0, 1, 2],
        "day": [400, 300, 401, 301, 402, 302, 403, 303, 404, 304, 405, 305],
        "day-cut": [300, 301, 302, 303, 304, 305],
    }
    assert numbers("day-alone") == [301, 302]
    assert numbers("middle-k1") == [0, 99]
    assert numbers("misled-k0") == [98]


COUNTED = [name for name, kind in KINDS.items() if kind.counted]


@given(st.sampled_from(COUNTED), st.integers(0, 63))
def test_more_sessions_are_only_added(kind: str, k: int) -> None:
    """Whatever comes more, the lesson stays as it is: conditions of a kind differ by units."""
    name = "k" if kind == "k" else f"{kind}-k"
    fewer, more = (Counter(numbers(f"{name}{count}")) for count in (k, min(k + 1, 63)))
    assert fewer <= more
    sessions = 2 if kind == "day" else 1  # a task, and the transition before it
    assert (more - fewer).total() == (k < 63) * sessions


@given(st.sampled_from(list(KINDS)), st.integers(0, 63))
def test_names(kind: str, k: int) -> None:
    name = {"k": f"k{k}"}.get(kind, f"{kind}-k{k}" if kind in COUNTED else kind)
    condition = parse_condition(name)
    counted = k if kind in COUNTED else 0
    assert (condition.name, condition.k, str(condition)) == (name, counted, name)
    assert condition.kind is KINDS[kind]
    assert parse_condition(condition) is condition
    assert pickle.loads(pickle.dumps(condition)) == condition


@pytest.mark.parametrize(
    "given",
    [
        *("", "k", "k64", "k-1", "k03", "K3", "no-history-k0", "day-alone-k3", "x-k3", " k3"),
        *("before", "before-k64", "before-3", 3),
    ],
)
def test_what_is_no_condition(given: Any) -> None:
    with pytest.raises(InvalidIdError, match="is not a condition"):
        parse_condition(given)


def test_order() -> None:
    given = ["k7", "stale-k0", "k10", "before-k1", "no-history", "k0"]
    names = [one.name for one in in_order(given)]
    assert names == ["no-history", "k0", "k7", "k10", "before-k1", "stale-k0"]
    for names in ([], ["k1", "k1"]):
        with raises(InvalidOptionError):
            in_order(names)


def test_what_a_buffer_set_must_hold() -> None:
    def needed(*names: str) -> tuple[str, ...]:
        return datasets_of(map(parse_condition, names))

    assert needed("no-history", "before-k3") == ("demonstrations", "distractors")
    every = "demonstrations", "distractors", "distractors-raw", "contradictions"
    assert needed("misled-k0", "k0", "raw-k1") == every
    assert needed("day-k3", "day-alone") == ("demonstrations", "distractors", "days")
    assert (*every, "shifted", "executions", "days") == DATASETS  # none needs the two before

    assert all(kind.name == name and kind.holds and kind.asks for name, kind in KINDS.items())


# --- shifts and subgoals -------------------------------------------------------------------------


def test_shifts_are_written_as_they_are_read() -> None:
    assert parse_shift("light:2") == Shift("light", 2)
    assert parse_shift("none") is None
    assert list(map(str, SHIFTS)) == [
        *("light:1", "light:2", "light:3", "camera:1", "camera:2", "camera:3"),
        *("clutter:1", "clutter:2", "clutter:3", "colors:1", "colors:2", "colors:3"),
    ]
    assert tuple(parse_shift(str(shift)) for shift in SHIFTS) == SHIFTS


@pytest.mark.parametrize(
    "text", ["", "light", "light:0", "light:4", "Light:2", "fog:1", "light:2 ", None]
)
def test_invalid_shifts(text: Any) -> None:
    with raises(InvalidOptionError):
        parse_shift(text)


_PIXELS = st.tuples(st.integers(0, 255), st.integers(0, 255))


def test_with_and_without_places() -> None:
    subgoal = Subgoal("put the cube at <point> on the target at <point>", ((12, 200), (0, 7)))
    assert subgoal.grounded == "put the cube at <12, 200> on the target at <0, 7>"
    assert subgoal.simple == "put the cube on the target"
    assert Subgoal("wait").grounded == Subgoal("wait").simple == "wait"


@given(st.lists(st.tuples(st.sampled_from(["go to", "put it at"]), _PIXELS), max_size=4))
def test_what_is_written_is_read_again(parts: list[tuple[str, tuple[int, int]]]) -> None:
    text = " then ".join(["start", *(f"{words} <point>" for words, _ in parts)])
    subgoal = Subgoal(text, tuple(point for _, point in parts))
    assert read_grounded(subgoal.grounded) == subgoal


@pytest.mark.parametrize(
    ("text", "points"), [("", ()), ("<point>", ((1, 2),)), ("at <point>", ()), ("go", ((1, 2),))]
)
def test_words_and_points_must_go_together(text: str, points: tuple[tuple[int, int], ...]) -> None:
    with raises(InvalidOptionError):
        Subgoal(text, points)


def test_a_condition_in_large_letters_is_recognized() -> None:
    for text, meant in (("K3", "k3"), ("No-History", "no-history"), (" k0", "k0")):
        with pytest.raises(InvalidIdError) as raised:
            parse_condition(text)
        assert raised.value.hint is not None
        assert raised.value.hint.startswith(f"Did you mean {meant!r}? ")
