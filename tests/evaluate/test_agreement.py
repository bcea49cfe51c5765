"""The simulator must agree with the dataset; nothing but the history shows the answer."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from support.messages import raises
from support.runs import EPISODE, roll
from support.worlds import Cheat, World, query_of

from robomme_interference_data import load_buffer
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.errors import RunError
from robomme_interference_data.evaluate.rollout.agreement import check_lesson
from robomme_interference_data.simulators.episode import Observation

pytestmark = pytest.mark.usefixtures("world")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        ("frame", "frame 7 of the lesson's wrist camera"),
        ("state", "the lesson's states are not"),
        ("view", "observation is not the recorded one in front"),
        ("wrist not rendered", None),
        ("under a shift", None),
    ],
)
def test_check_lesson_names_what_differs(spoil: str, message: str | None) -> None:
    lesson, first, _ = World().reset(str(EPISODE))
    images = {name: frames.copy() for name, frames in lesson.images.items()}
    states, front = lesson.states.copy(), first.images["front"]
    if spoil == "frame":
        images["wrist"][7, 0, 0, 0] ^= 1
    if spoil == "state":
        states[3, 2] += 1e-6
    if spoil in ("view", "under a shift"):
        first = Observation({**first.images, "front": front ^ 1}, first.state)
    played = dataclasses.replace(lesson, images=images, states=states)
    query = query_of(str(EPISODE))[0]
    if spoil == "under a shift":
        check_lesson(query, played, first, views=False)
    elif message is None:
        check_lesson(query, played, Observation({"front": front}, first.state))
    else:
        with raises(RunError):
            check_lesson(query, played, first)


class Other(World):
    """A simulator of another version: a joint is off, frames are missing, metadata differ."""

    def __init__(self, off: float = 0.0, missing: int = 0, **facts: Any):
        super().__init__()
        self.off, self.missing, self.facts = off, missing, facts

    def reset(self, episode_id: str, demonstration: bool = True) -> Any:
        lesson, first, info = super().reset(episode_id, demonstration)
        lesson = dataclasses.replace(lesson, states=lesson.states[self.missing :])
        state = first.state + np.float32(self.off) * (np.arange(8) == 4)
        return lesson, Observation(first.images, state), dataclasses.replace(info, **self.facts)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": -1}, "in the dataset, -1 in the simulator"),
        ({"difficulty": "other"}, "difficulty is 'easy' in the dataset, 'other' in the simulator"),
        ({"goals": ("sing",)}, "'sing' in the simulator"),
        ({"missing": 1}, "demonstration is 48 in the dataset, 47 in the simulator"),
        ({"off": 0.011}, "is 0.0110 away from the recorded one"),
        ({"off": np.nan}, "is nan away"),
    ],
)
def test_another_version_of_the_simulator_is_an_error(
    changes: dict[str, Any], message: str
) -> None:
    for condition in ("no-history", "k3"):
        with pytest.raises(RunError) as raised:
            roll(condition, Cheat(), simulator=Other(**changes))
        assert message in raised.value.message
        assert "another version of the simulator" in (raised.value.hint or "")


def test_differences_between_machines_and_sources_pass() -> None:
    goals = "in other words", query_of(str(EPISODE))[0].goal
    near = Other(off=0.009, goals=goals)
    assert roll("k0", Cheat(), simulator=near).status == "success"


# --- leaks -------------------------------------------------------------------------------------


def test_a_cheat_succeeds_with_the_lesson() -> None:
    policy = Cheat()
    row = roll("k0", policy, check_lesson=True)
    assert (row.status, row.success, row.steps) == ("success", True, 1)
    assert policy.info.simulator is None  # only privileged policies get it


def test_without_history_a_cheat_finds_nothing_of_the_demonstration() -> None:
    for check in (False, True):  # also where the simulator is asked for the demonstration
        row = roll("no-history", Cheat(), check_lesson=check)
        assert (row.status, row.success, row.steps) == ("fail", False, 40)
        assert (row.history_frames, row.lesson_frames, row.lesson_share) == (0, 0, None)


def test_a_cheat_finds_a_buffer_that_should_be_empty(
    monkeypatch: pytest.MonkeyPatch, tiny_buffers: Any
) -> None:
    lesson = load_buffer(EPISODE, "k0", buffer_set=tiny_buffers)
    monkeypatch.setattr(BufferSet, "load", lambda *_, **__: lesson)
    assert roll("no-history", Cheat()).status == "success"
