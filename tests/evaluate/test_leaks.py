"""Only the history tells the answer: a cheat would find whatever else did."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support.runs import EPISODE, roll
from support.worlds import Cheat, World, lesson_images, query_of

from robomme_interference_data import load_buffer
from robomme_interference_data.evaluate.policies.base import RolloutInfo
from robomme_interference_data.split import Split

pytestmark = pytest.mark.usefixtures("world")


def test_with_the_lesson_the_cheat_succeeds_at_once() -> None:
    policy = Cheat()
    row = roll("k0", policy)
    assert (row.status, row.success, row.steps) == ("success", True, 1)
    assert policy.info.simulator is None  # only privileged policies get it


def test_without_history_even_a_cheat_sees_nothing_of_the_demonstration() -> None:
    for check in (False, True):  # also where the simulator is asked for the demonstration
        row = roll("no-history", Cheat(), check_lesson=check)
        assert (row.status, row.success, row.steps) == ("fail", False, 40)
        assert (row.history_frames, row.lesson_frames, row.lesson_share) == (0, 0, None)


def wrist() -> np.ndarray:
    return lesson_images(query_of(str(EPISODE))[0])["wrist"]


def states() -> np.ndarray:
    return query_of(str(EPISODE))[1]


def started() -> World:
    world = World()
    world.reset(str(EPISODE))
    return world


@pytest.mark.parametrize(
    "leak",
    [
        lambda: ({"front": wrist()[:8]}, np.zeros((8, 8), "f4")),
        lambda: dataclasses.replace(query_of(str(EPISODE))[2], images={"a": wrist()[7]}),
        lambda: dataclasses.replace(query_of(str(EPISODE))[2], state=states()[7]),
        lambda: "go to " + " ".join(f"{number:.9f}" for number in states()[5].tolist()),
        lambda: RolloutInfo("go", 0, 0, started()),
        lambda: {"hint": {"frames": [wrist()[20]]}},
    ],
    ids=["frames", "a frame", "a state", "numbers in a text", "the simulator", "nested"],
)
def test_whatever_leaks_the_cheat_finds_it(leak: Callable[[], Any]) -> None:
    """So that the test above can fail."""
    policy = Cheat()
    policy.reset(RolloutInfo("go", 0, 0))
    assert policy.answer is None
    policy.search(leak())
    assert policy.answer is not None


def test_a_buffer_that_is_not_empty_is_found_too(
    monkeypatch: pytest.MonkeyPatch, tiny_split: Any
) -> None:
    lesson = load_buffer(EPISODE, "k0", split=tiny_split)
    monkeypatch.setattr(Split, "load", lambda *_, **__: lesson)
    assert roll("no-history", Cheat()).status == "success"
