"""Subgoals: words with places, as released servers take them, and read again."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.subgoal import Subgoal, read_grounded

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
    with pytest.raises(InvalidOptionError, match="points"):
        Subgoal(text, points)
