"""Only the history tells the answer: a cheat would find whatever else did."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support.runs import EPISODE, roll
from support.worlds import Cheat, World, lesson_images, query_of

from robomme_interference_data import load_buffer
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


class Leaky(Cheat):
    """The cheat in a harness that leaks: each call is changed before it comes."""

    def __init__(self, change: Callable[..., Any], call: str):
        self.change, self.call = change, call

    def reset(self, info: Any) -> None:
        super().reset(self.change(info) if self.call == "reset" else info)

    def observe(self, frames: Any, states: Any) -> None:
        given = self.change(frames, states) if self.call == "observe" else (frames, states)
        super().observe(*given)

    def act(self, observation: Any, goal: str) -> Any:
        given = self.change(observation, goal) if self.call == "act" else (observation, goal)
        return super().act(*given)


def images(camera: str) -> Any:
    return lesson_images(query_of(str(EPISODE))[0])[camera]


def states() -> Any:
    return query_of(str(EPISODE))[1]


def numbers() -> str:
    return " ".join(f"{number:.9f}" for number in states()[5].tolist())


def informed(**changes: Any) -> Callable[[Any], Any]:
    def change(info: Any) -> Any:
        told = dataclasses.replace(info)
        for name, value in changes.items():
            object.__setattr__(told, name, value())
        return told

    return change


def started() -> World:
    world = World()
    world.reset(str(EPISODE))
    return world


LEAKS: dict[str, tuple[str, Callable[..., Any]]] = {
    "frames": ("observe", lambda f, s: ({"front": images("front")[:8]}, np.zeros((8, 8), "f4"))),
    "a frame": ("act", lambda o, g: (dataclasses.replace(o, images={"a": images("wrist")[7]}), g)),
    "a state": ("act", lambda o, g: (dataclasses.replace(o, state=states()[7]), g)),
    "numbers in the goal": ("act", lambda o, g: (o, f"go to {numbers()}")),
    "frames in the info": ("reset", informed(hint=lambda: {"frames": [images("wrist")[20]]})),
    "numbers in the info": ("reset", informed(goal=numbers)),
    "the simulator": ("reset", informed(simulator=started)),
}


@pytest.mark.parametrize("leak", LEAKS)
def test_whatever_leaks_the_cheat_finds_it(leak: str) -> None:
    """So that the test above can fail: a rollout that leaks in any of these ways succeeds."""
    call, change = LEAKS[leak]
    row = roll("no-history", Leaky(change, call))
    assert (row.status, row.steps) == ("success", 1)


def test_a_buffer_that_is_not_empty_is_found_too(
    monkeypatch: pytest.MonkeyPatch, tiny_split: Any
) -> None:
    lesson = load_buffer(EPISODE, "k0", split=tiny_split)
    monkeypatch.setattr(Split, "load", lambda *_, **__: lesson)
    assert roll("no-history", Cheat()).status == "success"
