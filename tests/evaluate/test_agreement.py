"""What the simulator plays agrees with what the dataset recorded, or the rollout is refused."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from support.runs import EPISODE, roll
from support.worlds import Cheat, World, query_of

from robomme_interference_data.errors import RolloutError
from robomme_interference_data.evaluate.agreement import check_lesson
from robomme_interference_data.simulators.base import Observation

pytestmark = pytest.mark.usefixtures("world")


def test_check_lesson_passes_where_all_is_equal() -> None:
    for condition, status in (("k0", "success"), ("no-history", "fail")):
        assert roll(condition, Cheat(), check_lesson=True).status == status


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        ("frame", "frame 7 of the lesson's wrist camera"),
        ("state", "the lesson's states are not"),
        ("length", "the lesson's states are not"),
        ("view", "the first live front view is not"),
    ],
)
def test_check_lesson_names_what_differs(spoil: str, message: str) -> None:
    lesson, first, _ = World().reset(str(EPISODE))
    images = {name: frames.copy() for name, frames in lesson.images.items()}
    states = lesson.states.copy()
    if spoil == "frame":
        images["wrist"][7, 0, 0, 0] ^= 1
    if spoil == "state":
        states[3, 2] += 1e-6
    if spoil == "length":
        states = states[1:]
    if spoil == "view":
        first = Observation({**first.images, "front": first.images["front"] ^ 1}, first.state)
    played = dataclasses.replace(lesson, images=images, states=states)
    with pytest.raises(RolloutError, match=message):
        check_lesson(query_of(str(EPISODE))[0], played, first)


def test_cameras_that_are_not_drawn_are_not_compared() -> None:
    lesson, first, _ = World().reset(str(EPISODE))
    first = Observation({"front": first.images["front"]}, first.state)
    check_lesson(query_of(str(EPISODE))[0], lesson, first)


@pytest.mark.parametrize("condition", ["no-history", "k3"])
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        ("seed", "seed is"),
        ("difficulty", "difficulty is 'easy' in the dataset, 'other' in the simulator"),
        ("goal", "'do something else' in the simulator"),
        ("length", "length of the demonstration is 48 in the dataset, 47 in the simulator"),
        ("state", "is 0.0110 away from the recorded one"),
        ("nan", "is nan away"),
    ],
)
def test_another_version_of_the_simulator_is_noticed(
    condition: str, spoil: str, message: str
) -> None:
    class Other(World):
        def reset(self, episode_id: str, demonstration: bool = True) -> Any:
            lesson, first, info = super().reset(episode_id, demonstration)
            state = first.state.copy()
            state[4] += {"state": 0.011, "nan": np.nan}.get(spoil, 0)
            changes: dict[str, dict[str, Any]] = {
                "seed": {"seed": info.seed + 1},
                "difficulty": {"difficulty": "other"},
                "goal": {"goal": "do something else", "goals": ("do something else",)},
            }
            if spoil == "length":
                lesson = dataclasses.replace(lesson, states=lesson.states[1:])
            info = dataclasses.replace(info, **changes.get(spoil, {}))
            return lesson, Observation(first.images, state), info

    with pytest.raises(RolloutError) as raised:
        roll(condition, Cheat(), simulator=Other())
    assert message in raised.value.message
    assert "another version of the simulator" in (raised.value.hint or "")


def test_what_another_machine_or_source_changes_is_let_pass() -> None:
    class Near(World):
        def reset(self, episode_id: str, demonstration: bool = True) -> Any:
            lesson, first, info = super().reset(episode_id, demonstration)
            goals = ("in other words", *info.goals)
            info = dataclasses.replace(info, goal=goals[0], goals=goals)
            return lesson, Observation(first.images, first.state + np.float32(0.009)), info

    assert roll("k0", Cheat(), simulator=Near()).status == "success"
