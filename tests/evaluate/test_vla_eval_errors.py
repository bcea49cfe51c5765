"""Servers of vla-eval that do not fit, fail, or are none."""

import asyncio
import sys
from typing import Any

import numpy as np
import pytest
from support.lazy import lazy
from support.policy_calls import observation
from support.policy_server import PolicyServer

from robomme_interference_data.errors import MissingExtraError, PolicyServerError
from robomme_interference_data.evaluate.policies.registry import make_policy

servers = lazy("support.vla_eval_servers")
specs = lazy("vla_eval.specs")

# --- what does not fit -------------------------------------------------------------------------


def dims(size: int, form: str) -> Any:
    return specs.DimSpec("part", size, form)


@pytest.mark.parametrize(
    ("kind", "parts", "words"),
    [
        ("actions", {"position": (3, "delta_xyz")}, r"position \(3 values, delta_xyz\); expected"),
        ("actions", {"actions": (7, "raw")}, r"actions \(7 values, raw\); expected 8 values"),
        ("actions", {"joints": (7, "joint_delta_pos")}, "joints .*joint_delta_pos.* expected 7"),
        ("actions", {"joints": (7, "joint_positions")}, "7 action values; expected 8"),
        (
            "actions",
            {"joints": (7, "joint_positions"), "gripper": (1, "binary_close_positive")},
            "gripper .*binary_close_positive.*expected 1 values, binary_close_negative",
        ),
        ("observations", {"state": (9, "raw")}, r"state \(9 values, raw\); expected 8 values"),
        ("observations", {"state": (8, "eef_pos3_quat4_gripper1")}, "state .*eef_pos3"),
        ("observations", {"head": (0, "rgb_hwc_uint8")}, "observation head .*expected image, "),
        ("params", {"send_subgoal": True}, "asks for send_subgoal, which is not sent"),
    ],
)
def test_a_server_that_does_not_fit_is_an_error(kind: str, parts: Any, words: str) -> None:
    if kind != "params":
        parts = {name: dims(*part) for name, part in parts.items()}
    match = f"Noting.* does not fit.*{words}"
    with (
        servers.running(servers.Noting(**{kind: parts})) as port,
        pytest.raises(PolicyServerError, match=match),
    ):
        servers.made(port)


def test_servers_that_fit() -> None:
    for parts in ({"actions": (0, "raw")}, {"joints": (7, "joint_positions"), "gripper": None}):
        actions = {
            name: dims(*part) if part else specs.GRIPPER_CLOSE_NEG for name, part in parts.items()
        }
        state = {"state": specs.STATE_JOINT, "agentview": specs.IMAGE_RGB}
        params = {"send_subgoal": False, "absolute_action": True}
        with servers.connected(
            servers.Noting(params, actions=actions, observations=state)
        ) as policy:
            servers.play(policy)


# --- errors ------------------------------------------------------------------------------------


def test_an_error_ends_a_rollout_and_the_next_one_connects_again() -> None:
    def broken(obs: Any) -> Any:
        if len(server.events) < 4:
            raise KeyError("no such layer")
        return np.zeros(8)

    server = servers.Noting(answer=broken)
    with servers.connected(server) as policy:
        with pytest.raises(
            PolicyServerError, match="observation_failed: KeyError: 'no such layer'"
        ):
            servers.play(policy)
        with pytest.raises(PolicyServerError, match="was lost"):
            policy.act(observation(1), "pick")
        servers.play(policy)
    assert len({session for session, _, _ in server.events}) == 2


def test_an_error_at_the_start_of_an_episode() -> None:
    class Full(servers.Noting):  # type: ignore[misc, name-defined]
        async def on_episode_start(self, config: Any, ctx: Any) -> None:
            raise MemoryError("full")

    match = "episode_start_failed: MemoryError: full"
    with servers.connected(Full()) as policy, pytest.raises(PolicyServerError, match=match):
        servers.play(policy)


def test_a_server_that_is_started_again_must_be_the_same() -> None:
    with servers.running(servers.Noting(servers.ALL)) as port:
        policy = servers.made(port)
        servers.play(policy)
    with servers.running(servers.Noting(servers.ALL), port):
        servers.play(policy)
    with servers.running(servers.Noting(), port):
        with pytest.raises(PolicyServerError, match="it began with"):
            servers.play(policy)
        policy.close()


class Twice:
    """Answers each observation twice."""

    async def on_observation(self, obs: Any, ctx: Any) -> None:
        for _ in range(2):
            await ctx.send_action({"actions": np.zeros(8)})


class Silent:
    """Never answers."""

    async def on_observation(self, obs: Any, ctx: Any) -> None:
        await asyncio.sleep(0)


class Empty:
    """Answers without actions."""

    def predict(self, obs: Any, ctx: Any) -> Any:
        return {"joints": np.zeros(8)}


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (Twice, r"sends action 3; expected action 4"),
        (Silent, r"did not answer within 0\.3 s"),
        (Empty, "answers without actions: joints"),
    ],
)
def test_answers_that_do_not_fit(fault: type, words: str) -> None:
    server = type("Odd", (fault, servers.Noting), {})()
    with (
        servers.connected(server, "response_s=0.3") as policy,
        pytest.raises(PolicyServerError, match=words),
    ):
        servers.play(policy, live=2)


def test_another_version_of_the_protocol(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vla_eval.protocol.messages.PROTOCOL_VERSION", 2)
    match = "version 2 of vla-eval.*expected version 1"
    with servers.running(servers.Noting()) as port, pytest.raises(PolicyServerError, match=match):
        servers.made(port)


def test_a_server_of_another_kind(server: PolicyServer) -> None:
    with pytest.raises(PolicyServerError, match="is no server of vla-eval: .*missing"):
        servers.made(server.port)


def test_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    package = "robomme_interference_data.evaluate.vla_eval"
    for name in [one for one in sys.modules if one.startswith((package, "vla_eval"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "vla_eval", None)
    with pytest.raises(MissingExtraError, match="needs vla_eval") as raised:
        make_policy("vla-eval:ws://127.0.0.1:1", ["checkpoint=mine/1"])
    assert "robomme-interference-data[vla-eval]" in str(raised.value.hint)
