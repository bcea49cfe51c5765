"""Servers of vla-eval as policies: what they get, what is executed, their runs, their faults."""

import asyncio
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import worlds
from support.lazy import lazy
from support.messages import raises
from support.policy_calls import observation, section
from support.policy_server import PolicyServer
from support.runs import header, run, run_one
from websockets.exceptions import ConnectionClosedOK

from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingExtraError,
    PolicyServerError,
    RunError,
)
from robomme_interference_data.evaluate.policies.identity import lock_servers
from robomme_interference_data.evaluate.policies.registry import make_policy

servers = lazy("support.vla_eval_servers")
specs = lazy("vla_eval.specs")

NAMED = ("checkpoint=mine/1",)


def expect(got: Any, **expected: Any) -> None:
    """Compare an observation of a server with what is expected, arrays exactly."""
    assert got.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_equal(got[name], value, name)


# --- what a server gets ------------------------------------------------------------------------


def test_a_server_that_asks_for_everything() -> None:
    server = servers.Noting(servers.ALL, answer=lambda obs: obs["states"])
    with servers.connected(server) as policy:
        assert policy.cameras == policy.history_cameras == ("front", "wrist")
        assert policy.wants_history and not policy.every_frame
        first, second = servers.play(policy, history=5, live=2)
        np.testing.assert_array_equal(first, np.full((1, 8), 5))
        np.testing.assert_array_equal(second, np.full((1, 8), 6))
        servers.play(policy)
    frames, states = section(0, 7)

    def live(index: int) -> dict[str, Any]:
        images = {"agentview": frames["front"][index], "wrist": observation(index).images["wrist"]}
        return {"images": images, "task_description": "pick", "states": states[index]}

    (one, event, start), *rest = server.events
    assert (event, start) == ("start", {"task": {"name": "pick", "seed": 3}})
    expect(
        rest[0][2],
        **live(5),
        episode_restart=True,
        video_history=list(frames["front"][:5]),
        wrist_video_history=[
            *section(0, 2)[0]["wrist"],
            *section(2, 4)[0]["wrist"],
            *section(4, 5)[0]["wrist"],
        ],
        state_history=states[:5],
    )
    expect(rest[1][2], **live(6))
    expect(rest[4][2], **live(0), episode_restart=True)  # without history no key
    assert [name for _, name, _ in server.events] == [
        *("start", "observation", "observation", "end"),
        *("start", "observation", "end"),
    ]
    assert {session for session, _, _ in server.events} == {one}


@pytest.mark.parametrize(
    ("params", "spec", "cameras", "state", "history"),
    [
        ({}, {}, ("front",), False, False),
        ({"send_state": True, "send_wrist_image": False}, {}, ("front",), True, False),
        ({}, {"image": "IMAGE_RGB", "language": "LANGUAGE"}, ("front",), False, False),
        ({}, {"wrist": "IMAGE_RGB", "state": "RAW"}, ("front", "wrist"), True, False),
        ({"send_state": False}, {"wrist_image": "IMAGE_RGB", "state": "RAW"}, None, False, False),
        ({}, {"video_history": "IMAGE_RGB"}, ("front",), False, True),
    ],
)
def test_a_server_gets_what_it_asks_for(
    params: Any, spec: Any, cameras: Any, state: bool, history: bool
) -> None:
    declared = {name: getattr(specs, constant) for name, constant in spec.items()}
    server = servers.Noting(params, observations=declared)
    cameras = cameras or ("front", "wrist")
    with servers.connected(server) as policy:
        assert (policy.cameras, policy.wants_history) == (cameras, history)
        assert policy.history_cameras == (cameras if history else ())
        servers.play(policy)
    got = server.events[1][2]
    assert len(got["images"]) == len(cameras) and ("states" in got) is state


# --- what is executed --------------------------------------------------------------------------


def test_a_chunk_is_given_action_by_action_or_whole() -> None:
    def chunk(obs: Any) -> Any:
        asked.append(obs)
        return np.arange(20.0)[:, None].repeat(8, 1)

    asked: list[Any] = []
    with servers.connected(servers.Noting(answer=chunk, chunk_size=3)) as policy:
        actions = servers.play(policy, live=7)
        assert [one.tolist() for one in actions] == [[[n] * 8] for n in (0, 1, 2, 0, 1, 2, 0)]
        assert len(asked) == 3
    with servers.connected(servers.Noting(answer=chunk)) as policy:
        (actions,) = servers.play(policy)
        assert actions.shape == (20, 8)  # a rollout executes 16 of them


def test_the_faults_of_its_mme_vla_server() -> None:
    """docs/how-to/connect-a-policy.md lists them: it is true as long as this passes."""
    server = servers.MmeVlaModelServer()
    with (
        servers.running(server) as port,
        closing(servers.made(port)) as one,
        closing(servers.made(port)) as other,
    ):
        servers.play(one, history=5, live=12)
        servers.play(other)
    (_, reset), (_, added), *_ = server.calls
    assert reset is None and added["images"].shape == (5, 1, 224, 224, 3)
    assert not added["state"].any()  # not the states of the history
    assert [name for name, _ in server.calls] == [
        *("reset", "add_buffer", "infer", "infer"),  # live frames are not added
        *("reset", "infer"),  # another client empties the memory; nothing is in it at first
    ]


def test_a_server_with_one_queue_mixes_up_its_clients() -> None:
    """docs/how-to/connect-a-policy.md describes such servers."""
    with (
        servers.running(servers.OneQueue()) as port,
        closing(servers.made(port)) as one,
        closing(servers.made(port)) as other,
    ):
        (alone,) = servers.play(one, history=5)
        servers.play(other)  # an episode without history, which fills the queue
        beside = one.act(observation(5), "pick")
    np.testing.assert_array_equal(alone[0, :7], [3] * 7)  # the pose of the history's frame 3
    np.testing.assert_array_equal(beside[0, :7], [0] * 7)  # the other's


# --- in a run ----------------------------------------------------------------------------------


@pytest.mark.usefixtures("world")
def test_a_run_resumes_with_the_same_checkpoint_only(tmp_path: Path) -> None:
    with servers.running(servers.Remembering()) as port:
        settings: dict[str, Any] = {"policy": f"vla-eval:ws://127.0.0.1:{port}"}
        result = run(tmp_path / "run", policy_options=NAMED, **settings)
        assert {(row.condition, row.status) for row in result.rows} == {
            *(("no-history", "fail"), ("k0", "success"))
        }
        identity = header(tmp_path / "run")["identity"]
        assert (identity["policy"], identity["policy_options"]) == (
            *("vla-eval", {"checkpoint": "mine/1", "other_states": "refuse"}),
        )
        (start,) = header(tmp_path / "run")["invocations"]
        assert start["policy"]["server"] == f"127.0.0.1:{port}"
        assert start["versions"]["vla-eval"]
        assert run(tmp_path / "run", policy_options=NAMED, **settings).rows == result.rows
        with raises(RunError):
            run(tmp_path / "run", policy_options=("checkpoint=other",), **settings)
        for changes in (
            {"policy_options": ()},
            {"policy_options": ("checkpoint= ",)},
            {"policy_options": NAMED, "system": None},
            {"policy_options": NAMED, "system": "perceptual-framesamp-modul"},
            {"policy_options": NAMED, "subgoals": "oracle"},
            {"policy_options": NAMED, "workers": 2, "policies": 1},
        ):
            with raises(InvalidOptionError):
                run(tmp_path / "other", **settings, **changes)


@pytest.mark.usefixtures("world")
def test_a_server_without_memory_runs_without_history_only(tmp_path: Path) -> None:
    with servers.running(servers.Blind()) as port:
        settings = {"policy": f"vla-eval:ws://127.0.0.1:{port}", "policy_options": NAMED}
        with raises(InvalidOptionError):
            run(tmp_path / "run", **settings)
        (row,) = run_one(tmp_path / "run", **settings).rows
        assert (row.status, row.steps) == ("fail", worlds.STEPS)


@pytest.mark.usefixtures("world")
def test_a_fault_of_the_server_is_an_error_row_that_is_repeated(tmp_path: Path) -> None:
    def answer(obs: Any) -> Any:
        if "VideoRepick" in obs["task_description"]:
            return np.zeros(7)
        if len(dropped) < 1:
            dropped.append(obs)
            raise ConnectionClosedOK(None, None)
        return np.zeros(8)

    dropped: list[Any] = []
    errors = []
    with servers.running(servers.Noting(answer=answer)) as port:
        policy, only = f"vla-eval:ws://127.0.0.1:{port}", ("no-history",)
        for _ in range(2):
            result = run(tmp_path / "run", policy=policy, policy_options=NAMED, conditions=only)
            errors.append({row.family: str(row.error) for row in result.rows if row.error})
    first, second = errors
    assert "PolicyServerError" in first["MoveCube"] and "closed the conn" in first["MoveCube"]
    assert second.keys() == {"VideoRepick"}
    assert "PolicyError" in second["VideoRepick"] and "shape (1, 7)" in second["VideoRepick"]


@pytest.mark.usefixtures("world")
def test_a_server_with_one_client_has_one_worker_and_one_run(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"policy_options": NAMED, "conditions": ("no-history",)}
    for shared in (False, True):
        with servers.running(servers.MmeVlaModelServer(use_history=not shared)) as port:
            settings["policy"] = f"vla-eval:ws://127.0.0.1:{port}"
            with lock_servers(settings["policy"], tmp_path / "other"):  # of another run
                if shared:
                    result = run(tmp_path / "shared", workers=2, **settings)
                else:
                    with raises(PolicyServerError):
                        run(tmp_path / "run", **settings)
            if not shared:
                with raises(InvalidOptionError):
                    run(tmp_path / "run", workers=2, **settings)
                result = run(tmp_path / "run", **settings)
            assert result.counts["fail"] == 2


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
    with servers.running(servers.Noting(**{kind: parts})) as port, raises(PolicyServerError):
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
        with raises(PolicyServerError):
            servers.play(policy)
        with raises(PolicyServerError):
            policy.act(observation(1), "pick")
        servers.play(policy)
    assert len({session for session, _, _ in server.events}) == 2


def test_an_error_at_the_start_of_an_episode() -> None:
    class Full(servers.Noting):  # type: ignore[misc, name-defined]
        async def on_episode_start(self, config: Any, ctx: Any) -> None:
            raise MemoryError("full")

    with servers.connected(Full()) as policy, raises(PolicyServerError):
        servers.play(policy)


def test_a_server_that_is_started_again_must_be_the_same() -> None:
    with servers.running(servers.Noting(servers.ALL)) as port:
        policy = servers.made(port)
        servers.play(policy)
    with servers.running(servers.Noting(servers.ALL), port):
        servers.play(policy)
    with servers.running(servers.Noting(), port):
        with raises(PolicyServerError):
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


@pytest.mark.parametrize("fault", [Twice, Silent, Empty])
def test_answers_that_do_not_fit(fault: type) -> None:
    server = type("Odd", (fault, servers.Noting), {})()
    with servers.connected(server, "response_s=0.3") as policy, raises(PolicyServerError):
        servers.play(policy, live=2)


def test_another_version_of_the_protocol(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vla_eval.protocol.messages.PROTOCOL_VERSION", 2)
    with servers.running(servers.Noting()) as port, raises(PolicyServerError):
        servers.made(port)


def test_a_server_of_another_kind(server: PolicyServer) -> None:
    with raises(PolicyServerError):
        servers.made(server.port)


def test_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    package = "robomme_interference_data.evaluate.vla_eval"
    for name in [one for one in sys.modules if one.startswith((package, "vla_eval"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "vla_eval", None)
    with raises(MissingExtraError) as raised:
        make_policy("vla-eval:ws://127.0.0.1:1", ["checkpoint=mine/1"])
    assert "robomme-interference-data[vla-eval]" in str(raised.value.hint)
