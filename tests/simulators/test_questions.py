"""Questions mark the things of the task where they are after the lesson."""

import math
from typing import Any

import pytest
from support.families import families

from robomme_interference_data.simulators.tabletop.simulator import TabletopSimulator

PLACES: dict[str, list[tuple[int, int, int]]] = {
    "VideoRepick": [(0, 0, 0)],
    "VideoPlaceOrder": [(1, 0, 0)],
    "VideoPlaceButton": [(1, 0, 0)],
    "VideoUnmask": [(0, 0, 0)],
    "VideoUnmaskSwap": [(0, 0, 0)],
    "MoveCube": [],
    "InsertPeg": [(0, 0, 0), (1, 0, 1)],
    "PatternLock": [(number, 0, number) for number in range(6)],
    "RouteStick": [(number, -1, 2 * number) for number in range(5)],
}
"""In a hard episode: the step of the answer, which of its points, and which mark."""

BEFORE = 0.03
"""Distance in m from which a peg approaches the box."""


@pytest.mark.slow
@pytest.mark.parametrize("family", families("VideoUnmaskSwap", "InsertPeg"))
def test_the_right_option_alone_is_marked_where_it_is(
    blind: TabletopSimulator, family: str
) -> None:
    """Also after a swap, when a thing is no longer where it was shown."""
    blind.reset(f"{family}/test/2", demonstration=False)
    scene, answer = blind.env.episode, blind.env.answer
    right = scene.choice(answer)
    for step, at, mark in PLACES[family]:
        place: Any = scene.step(answer, step).at[at]
        near = 0.003 + BEFORE * ((family, step) == ("InsertPeg", 1))
        marked = {
            choice
            for choice in map(scene.choice, scene.answers)
            if math.dist(place[:2], scene.option(choice).marks[mark][:2]) < near
        }
        assert right in marked
        assert len(PLACES[family]) > 1 or marked == {right}
    assert not getattr(scene, "swaps", ()) or right != answer
