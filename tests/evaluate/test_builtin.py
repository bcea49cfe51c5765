"""The policies without weights: what replay keeps, where it starts, and how it moves."""

from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.messages import raises

from robomme_interference_data.errors import PolicyError, UnknownNameError
from robomme_interference_data.evaluate.policies.builtin import (
    FollowSubgoals,
    Noop,
    Privileged,
    Recall,
    ReplayPolicy,
    extrapolate,
    follow,
)
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.evidence import map_evidence
from robomme_interference_data.schema.manifest import SessionEntry, layout_sessions
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import Observation

Vector = NDArray[np.float32]


def state(joint: float, opening: float = 0.04) -> Vector:
    """All joints alike."""
    return np.array([joint] * 7 + [opening], np.float32)


def seen(shade: int, joint: float, opening: float = 0.04) -> Observation:
    return Observation({"front": np.full((32, 32, 3), shade, np.uint8)}, state(joint, opening))


def test_replay_extrapolates_over_the_frames_missing_at_the_end() -> None:
    """Of frames 0 to 309 the last one kept is 300; from 290 to it the joints moved by 0.1."""
    ends = {}
    for extend in (False, True):
        policy = ReplayPolicy("framesamp", extrapolate=extend)
        policy.reset(RolloutInfo("goal", 310, 0))
        joints = np.arange(310) * np.float32(0.01)
        states = np.stack([state(joint) for joint in joints])
        policy.add_history({"front": np.zeros((310, 32, 32, 3), np.uint8)}, states, 310)
        plan = [policy.act(seen(0, 0.0), "")[-1] for _ in range(40)]
        ends[extend] = plan[-1]
    np.testing.assert_allclose(ends[False][:7], 3.0, atol=1e-5)
    np.testing.assert_allclose(ends[True][:7], 3.09, atol=1e-5)


def test_nothing_is_extrapolated_without_missing_frames_or_two_known_ones() -> None:
    two = np.stack([state(0.1), state(0.3, 0.02)])
    for kept, states, last in (([4, 6], two, 6), ([4], two[:1], 9), ([], two[:0], 9)):
        indices = np.array(kept, np.int64)
        found, same = extrapolate(indices, states, last)
        assert found is indices and same is states
    found, longer = extrapolate(np.array([4, 6]), two, 9)
    np.testing.assert_array_equal(found, [4, 6, 9])
    np.testing.assert_allclose(longer[2], [0.6] * 7 + [0.02], rtol=1e-6)


# --- the trajectory ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kept", "joints", "plan"),
    [
        ([0, 4], [0.0, 0.08], [0.0, 0.02, 0.04, 0.06, 0.08]),  # what is missing, between
        # 0.24 rad to the first frame: three steps of 0.08.
        ([7], [0.24], [0.08, 0.16, 0.24]),
    ],
)
def test_kept_frames_are_followed(kept: list[int], joints: list[float], plan: list[float]) -> None:
    found = follow(state(0.0), np.array(kept), np.stack([state(joint) for joint in joints]))
    np.testing.assert_allclose(found[:, 0], plan, atol=1e-6)
    assert (found[:, 7] == 1).all()


def test_the_gripper_closes_and_opens_as_in_the_lesson() -> None:
    openings = [0.04, 0.04, 0.03, 0.02, 0.02, 0.03, 0.03]
    states = np.stack([state(0.0, opening) for opening in openings])
    plan = follow(states[0], np.arange(7), states)
    assert plan[:, 7].tolist() == [1, 1, -1, -1, -1, 1, 1]
    # Between missing frames after the arm: one step to the first frame, two to the second, five
    # to close, two to the third.
    states = np.stack([state(0.0, 0.04), state(0.02, 0.02), state(0.04, 0.02)])
    plan = follow(states[0], np.array([0, 2, 4]), states)
    np.testing.assert_allclose(plan[:, 0], [0, 0.01, *[0.02] * 6, 0.03, 0.04], atol=1e-7)
    assert plan[:, 7].tolist() == [1, 1, 1, -1, -1, -1, -1, -1, -1, -1]


@given(
    st.lists(st.floats(-2, 2, width=32), min_size=1, max_size=8),
    st.lists(st.integers(1, 30), min_size=8, max_size=8),
)
def test_the_plan_ends_at_the_last_state_and_never_jumps(
    joints: list[float], gaps: list[int]
) -> None:
    states = np.stack([state(joint) for joint in joints])
    kept = np.cumsum(gaps)[: len(joints)]
    plan = follow(state(0.0), kept, states)
    moves = np.abs(np.diff(np.concatenate([state(0.0)[None], plan])[:, :7], axis=0))
    assert moves.max() <= 0.08 + 1e-5
    np.testing.assert_allclose(plan[-1, :7], states[-1, :7], atol=1e-6)
    assert len(plan) >= kept[-1] - kept[0] + 1


# --- the policy -------------------------------------------------------------------------------


def fed(memory: str, shades: list[int], joints: list[float]) -> ReplayPolicy:
    policy = ReplayPolicy(memory)
    policy.reset(RolloutInfo("goal", len(shades), 0))
    frames = np.stack([np.full((32, 32, 3), shade, np.uint8) for shade in shades])
    states = np.stack([state(joint) for joint in joints])
    for start in range(0, len(shades), 7):  # chunks do not matter
        part = slice(start, start + 7)
        policy.add_history({"front": frames[part]}, states[part], len(shades))
    return policy


def test_replay_starts_at_the_first_of_the_nearest_views() -> None:
    policy = fed("full", [10, 90, 50, 200], [0.0, 0.01, 0.02, 0.03])
    actions = policy.act(seen(88, 0.01), "goal")
    assert actions.shape == (16, 8) and actions.dtype == np.float32
    np.testing.assert_allclose(actions[:4, 0], [0.01, 0.02, 0.03, 0.03], atol=1e-6)
    actions = fed("full", [10, 50, 10], [0.0, 0.02, 0.05]).act(seen(10, 0.0), "goal")
    np.testing.assert_allclose(actions[:3, 0], [0.0, 0.02, 0.05], atol=1e-6)
    # A window has lost what came before.
    policy = fed("window", [200] + [0] * 40, [0.5] + [0.0] * 40)
    assert (policy.act(seen(200, 0.0), "goal")[:, 0] == 0).all()


def test_replay_continues_over_calls_then_holds_until_a_reset() -> None:
    joints = [0.01 * step for step in range(20)]
    policy = fed("full", [0] * 20, joints)
    got = np.concatenate([policy.act(seen(0, 0.0), "goal") for _ in range(3)])[:, 0]
    np.testing.assert_allclose(got, joints + [0.19] * 28, atol=1e-6)
    policy.reset(RolloutInfo("goal", 0, 0))
    held = policy.act(seen(0, 0.2, 0.0), "goal")  # without history
    np.testing.assert_array_equal(held, np.tile([*[np.float32(0.2)] * 7, -1], (16, 1)))


def test_noop_holds_and_a_privileged_policy_needs_the_simulator() -> None:
    held = Noop().act(seen(0, 0.2, 0.0), "goal")
    np.testing.assert_array_equal(held, np.tile([*[np.float32(0.2)] * 7, 1], (16, 1)))
    with raises(PolicyError):
        Privileged("oracle").act(seen(0, 0.0), "goal")


# --- recall --------------------------------------------------------------------------------------


class Recorder:
    """A simulator that records the last call."""

    def act(self, policy: str, known: dict[int, str] | None = None) -> Vector:
        self.call = policy, known
        return np.zeros(8, np.float32)


@pytest.mark.parametrize(
    ("memory", "known"),
    [
        ("full", {1: "from the left", 0: "takes peg 2"}),
        ("framesamp:32", {1: "from the left"}),  # every tenth frame of 310
        ("window:32", {}),  # from 279 on
        ("window:30@1", {1: "from the left"}),  # 20, 30, …, 300
        ("window:31@1", {1: "from the left"}),  # and 10
        ("window:60@2", {0: "takes peg 2", 1: "from the left"}),  # 15, 20, …
    ],
)
def test_recall_knows_the_evidence_that_its_memory_keeps(
    memory: str, known: dict[int, str]
) -> None:
    entry = SessionEntry("lesson", "A", EpisodeId("A", "test", 0), "d", "r", 0, 0, 300, 1, "s")
    spans = EvidenceSpan(0, "takes peg 2", 11, 20), EvidenceSpan(1, "from the left", 20, 31)
    evidence = map_evidence(layout_sessions([entry]), lambda entry: spans)
    simulator, policy = Recorder(), Recall(memory)
    policy.reset(RolloutInfo("goal", 310, 0, simulator, evidence))  # type: ignore[arg-type]
    assert policy.act(seen(0, 0), "goal").shape == (1, 8)
    assert simulator.call == ("recall", known)
    assert policy.metadata() == {"policy": "recall", "memory": memory}
    assert (policy.cameras, policy.history_cameras) == ((), ())  # it looks at nothing


def test_recall_needs_evidence() -> None:
    with raises(PolicyError):
        Recall().reset(RolloutInfo("goal", 0, 0, Recorder(), None))  # type: ignore[arg-type]
    with raises(UnknownNameError):
        Recall("framesmap")


@pytest.mark.parametrize(("points", "text"), [(True, "take it at <7, 9>"), (False, "take it")])
def test_points_of_subgoals_can_be_hidden(points: bool, text: str) -> None:
    followed = []

    class Scripted:
        def follow_subgoal(self, subgoal: Subgoal | None) -> Vector:
            followed.append(subgoal and subgoal.grounded)
            return np.zeros(8, np.float32)

    policy = FollowSubgoals(points=points)
    policy.reset(RolloutInfo("goal", 0, 0, simulator=cast(Simulator, Scripted())))
    view = replace(seen(0, 0.0), subgoal=Subgoal("take it at <point>", ((7, 9),)))
    assert policy.act(view, "goal").shape == (1, 8)
    policy.act(view, "goal")
    written_again = replace(view, subgoal=Subgoal("take it at <point>", ((7, 9),)))
    policy.act(written_again, "goal")
    assert followed == [text, None, text]
