"""Only the history tells the answer: a cheat would find whatever else did."""

import dataclasses
from typing import Any

import factories
import numpy as np
import pytest
from rollout_calls import EPISODE, roll
from rollout_doubles import Cheat, World

from robomme_interference_data import load_split
from robomme_interference_data.buffer import Buffer
from robomme_interference_data.evaluate import rollout
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.simulators.base import Observation

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


def lesson() -> Buffer:
    return load_split(factories.split()).load(EPISODE, 0)


def tell_the_policy(patch: pytest.MonkeyPatch) -> None:
    """Eight frames of the demonstration as the first live ones."""
    live = rollout._live

    def leak(policy: Any, *rest: Any) -> Any:
        policy.observe({"front": lesson().frames("front")[:8]}, np.zeros((8, 8), np.float32))
        return live(policy, *rest)

    patch.setattr(rollout, "_live", leak)


def change_live(patch: pytest.MonkeyPatch, **changes: Any) -> None:
    """Change the first live observation, or the goal, that the policy gets."""
    live = rollout._live

    def leak(policy: Any, simulator: Any, first: Observation, goal: str, *rest: Any) -> Any:
        said = changes.pop("goal", goal)
        return live(policy, simulator, dataclasses.replace(first, **changes), said, *rest)

    patch.setattr(rollout, "_live", leak)


def show_a_frame(patch: pytest.MonkeyPatch) -> None:
    change_live(patch, images={"front": lesson().frame(7, "front")})


def show_a_state(patch: pytest.MonkeyPatch) -> None:
    change_live(patch, state=lesson().states[7])


def write_a_state(patch: pytest.MonkeyPatch) -> None:
    change_live(patch, goal=f"go to {' '.join(f'{x:.9f}' for x in lesson().states[5].tolist())}")


def change_info(patch: pytest.MonkeyPatch, name: str, value: Any) -> None:
    told = rollout.RolloutInfo

    def leak(*fields: Any) -> Any:
        info = told(*fields)
        object.__setattr__(info, name, value)
        return info

    patch.setattr(rollout, "RolloutInfo", leak)


def inform_of_a_frame(patch: pytest.MonkeyPatch) -> None:
    change_info(patch, "hint", {"frames": [lesson().frame(20, "wrist")]})


def inform_of_a_state(patch: pytest.MonkeyPatch) -> None:
    change_info(patch, "goal", f"{lesson().states[5].astype(np.float64).tolist()}")


def hand_over_the_simulator(patch: pytest.MonkeyPatch) -> None:
    world = World()
    world.reset(str(EPISODE))
    change_info(patch, "simulator", world)


def feed_the_lesson(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(WorkItem, "k", 0)


LEAKS = [
    *(tell_the_policy, show_a_frame, show_a_state, write_a_state),
    *(inform_of_a_frame, inform_of_a_state, hand_over_the_simulator, feed_the_lesson),
]


@pytest.mark.parametrize("leak", LEAKS)
def test_whatever_leaks_the_cheat_finds_it(leak: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that the test above can fail: a rollout that leaks in any of these ways succeeds."""
    leak(monkeypatch)
    row = roll("no-history", Cheat())
    assert (row.status, row.steps) == ("success", 1)
