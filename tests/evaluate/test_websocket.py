"""The websocket adapter against a server that keeps its own account of the memory."""

from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.policy_calls import INFER, RESET, added, client, info, observation, rollout, section
from support.policy_server import PolicyServer
from support.runs import run

from robomme_interference_data.errors import PolicyServerError
from robomme_interference_data.evaluate.run.identity import plain


@pytest.mark.parametrize(
    ("history", "chunks", "live", "calls"),
    [
        # Two whole chunks of 16, and 8 frames that wait for the first live observation.
        (
            *(40, [40], [16, 3]),
            [added(16, 40), added(16, 40), added(9, 40), INFER, added(16, 0), INFER, added(3, 0)],
        ),
        # Without history one frame comes first.
        (0, [], [16], [added(1, 0), INFER, added(16, 0)]),
        # A full last chunk leaves the live frame its own, with the total.
        (32, [10, 22], [], [added(16, 32), added(16, 32), added(1, 32)]),
    ],
)
def test_the_calls_of_a_rollout(
    server: PolicyServer, history: int, chunks: list[int], live: list[int], calls: list[Any]
) -> None:
    with client(server) as policy:
        rollout(policy, history, chunks, live)
    assert server.calls == [RESET, *calls, INFER]
    assert server.memory.exec_start_idx == history
    assert server.memory.count == history + 1 + sum(live)
    assert server.connections == 1


@settings(max_examples=25)
@given(
    chunks=st.lists(st.integers(1, 40), max_size=5),
    live=st.lists(st.integers(1, 16), max_size=3),
    most=st.integers(1, 20),
)
def test_the_memory_is_the_same_however_the_history_is_cut(
    chunks: list[int], live: list[int], most: int
) -> None:
    with PolicyServer().running() as server, client(server, chunk_frames=most) as policy:
        rollout(policy, sum(chunks), chunks, live)
        total = sum(chunks) + 1 + sum(live)
        frames, states = section(0, total)
        assert np.array_equal(np.stack(server.memory.frames), frames["front"])
        assert np.array_equal(np.stack(server.memory.states), states)
        assert server.memory.exec_start_idx == sum(chunks)
        sent = [call for call in server.calls if call["call"] == "add_buffer"]
        assert all(1 <= call["frames"] <= most for call in sent)
        # All but the last message before the first action are full.
        first = server.calls.index(INFER)
        assert all(call["frames"] == most for call in server.calls[1 : first - 1])


def test_frames_that_wait_are_not_those_that_the_caller_writes_over(server: PolicyServer) -> None:
    with client(server) as policy:
        policy.reset(info(3))
        frames, states = section(0, 3)
        policy.add_history(frames, states, 3)
        frames["front"][:] = 255
        states[:] = 9
        policy.observe(*section(3, 4))
    assert np.array_equal(np.stack(server.memory.states), section(0, 4)[1])
    assert np.array_equal(np.stack(server.memory.frames), section(0, 4)[0]["front"])


def test_what_the_server_answers_and_says_of_itself(server: PolicyServer) -> None:
    server.metadata = {"model": "none", "seed": np.int64(7), "mean": np.zeros(2), "b": b"\x00"}
    with client(server) as policy:
        assert server.connections == 0  # nothing is reached before it is needed
        assert plain(policy.metadata()) == {
            "policy": "websocket",
            "server": f"127.0.0.1:{server.port}",
            "server_metadata": {"model": "none", "seed": 7, "mean": [0.0, 0.0], "b": r"b'\x00'"},
        }
        policy.reset(info(5))
        policy.add_history(*section(0, 5), 5)  # left waiting: the next rollout starts from nothing
        policy.reset(info(0))
        policy.observe(*section(5, 6))
        # 20 actions that hold joints at 5; a gripper at 5 is open.
        expected = np.array([[5, 5, 5, 5, 5, 5, 5, 1]] * 20)
        assert np.array_equal(policy.act(observation(5), "pick"), expected)
    assert (server.memory.count, server.connections) == (1, 1)


# --- errors that the server reports ------------------------------------------------------------


def test_a_traceback_becomes_one_error_with_its_last_line(server: PolicyServer) -> None:
    with client(server) as policy:
        policy.reset(info(0))
        with pytest.raises(PolicyServerError, match="reports: AssertionError: history feats"):
            policy.act(observation(0), "pick")  # without a frame in the memory
        # The memory is lost with the connection: this rollout cannot go on.
        with pytest.raises(PolicyServerError, match="was lost, and its memory with it"):
            policy.observe(*section(0, 1))
        assert policy.metadata()["server_metadata"] == {}
        assert server.connections == 1
        rollout(policy, 3, [3], [])  # the next one connects again
    assert server.connections == 2


@pytest.mark.parametrize("call", ["reset", "add_buffer", "prompt"])
@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (ValueError("no\n"), "reports: ValueError: no"),
        (PolicyServer.CLOSE, "closed the connection: "),
        ("", "reports: an empty text"),
        (b"\xc1", "1 bytes are not a message"),
        (msgpack.packb([1]), "answers with a list; expected a map"),
        (msgpack.packb({"a": 1, "b": 2}), "answers without '.*': a, b"),
        (msgpack.packb({"reset_finished": False}), "answers without"),
    ],
)
def test_every_answer_is_checked(server: PolicyServer, call: str, answer: Any, text: str) -> None:
    def respond(message: dict[str, Any]) -> Any:
        if call in message and isinstance(answer, Exception):
            raise answer
        return answer if call in message else None

    server.before = respond
    with client(server) as policy, pytest.raises(PolicyServerError, match=text):
        rollout(policy, 2, [2], [])


def test_a_run_keeps_the_servers_account(tmp_path: Path, world: None, server: PolicyServer) -> None:
    """With history and without: the server checks the order of its calls."""
    named = {"system": "perceptual-framesamp-modul", "policy_options": ("checkpoint=a",)}
    conditions = ("no-history", "k1")
    result = run(tmp_path / "run", policy=server.url, conditions=conditions, **named)
    # Before the first rollout it was asked for its kind.
    assert server.calls[:2] == [RESET, {"call": "infer", "prompt": "nothing"}]
    del server.calls[:2]
    # The policy holds still, so every episode ends after 40 steps: asked three times a rollout.
    assert [(row.status, row.error) for row in result.rows] == [("fail", None)] * 4
    assert {call.get("exec_start_idx") for call in server.calls} == {None, 0, 80}
    kinds = [call["call"] for call in server.calls]
    assert (kinds.count("reset"), kinds.count("infer")) == (4, 4 * 3)
