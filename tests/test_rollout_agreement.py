"""What the simulator plays agrees with what the dataset recorded, or the rollout is refused."""

import dataclasses
import re
from typing import Any

import factories
import numpy as np
import pytest
from rollout_calls import EPISODE, roll
from rollout_doubles import Cheat, World

from robomme_interference_data import load_split
from robomme_interference_data.errors import RolloutError
from robomme_interference_data.evaluate.agreement import check_lesson
from robomme_interference_data.simulators.base import Observation

pytestmark = pytest.mark.usefixtures("world")


def test_check_lesson_passes_where_all_is_equal() -> None:
    assert roll("k0", Cheat(), check_lesson=True).status == "success"


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        ("frame", "frame 7 of the lesson's wrist camera is not what the simulator shows"),
        ("state", "the lesson's states are not the simulator's"),
        ("length", "the lesson has 36 frames, the simulator's demonstration 35"),
        ("view", "the first live front view is not the recorded query frame"),
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
        check_lesson(load_split(factories.split()).load(EPISODE, 0), played, first)


@pytest.mark.parametrize("condition", ["no-history", "k3"])
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        ("seed", r"seed is \d+ in the dataset, \d+ in the simulator"),
        ("difficulty", "difficulty is '.*' in the dataset, 'other' in the simulator"),
        ("goal", "goal is '.*' in the dataset, 'do something else' in the simulator"),
        ("length", "length of the lesson is 36 in the dataset, 35 in the simulator"),
        ("state", r"the first live state is 0\.0110 away from the recorded one; .* at most 0\.01$"),
        ("nan", "the first live state is nan away"),
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
            return (
                lesson,
                Observation(first.images, state),
                dataclasses.replace(info, **changes.get(spoil, {})),
            )

    with pytest.raises(RolloutError) as raised:
        roll(condition, Cheat(), simulator=Other())
    assert re.search(message, raised.value.message)
    assert "another version of the simulator" in (raised.value.hint or "")


def test_what_another_machine_or_source_changes_is_let_pass() -> None:
    class Near(World):
        def reset(self, episode_id: str, demonstration: bool = True) -> Any:
            lesson, first, info = super().reset(episode_id, demonstration)
            goals = ("in other words", *info.goals)
            info = dataclasses.replace(info, goal=goals[0], goals=goals)
            return lesson, Observation(first.images, first.state + np.float32(0.009)), info

    assert roll("k0", Cheat(), simulator=Near()).status == "success"
