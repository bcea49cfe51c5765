"""The websocket adapter against a server that keeps its own account of the memory."""

import threading
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.policy_calls import (
    INFER,
    RESET,
    added,
    client,
    info,
    observation,
    rollout,
    section,
)
from support.policy_server import PolicyServer
from websockets.sync.server import serve

from robomme_interference_data.errors import PolicyServerError
from robomme_interference_data.evaluate.policies.identity import plain
from robomme_interference_data.evaluate.policies.websocket import WebsocketPolicy


@pytest.fixture
def server() -> Iterator[PolicyServer]:
    with PolicyServer().running() as running:
        yield running


def test_the_calls_of_a_rollout(server: PolicyServer) -> None:
    policy = client(server)
    # 40 frames: two whole chunks of 16, and 8 that wait for the first live observation.
    rollout(policy, 40, [40], [16, 3])
    policy.close()
    assert server.calls == [
        RESET,
        added(16, 40),
        added(16, 40),
        added(9, 40),
        INFER,
        added(16, 0),
        INFER,
        added(3, 0),
        INFER,
    ]
    assert server.memory.exec_start_idx == 40
    assert server.memory.count == 40 + 1 + 16 + 3
    assert server.connections == 1


def test_without_history_one_frame_comes_first(server: PolicyServer) -> None:
    policy = client(server)
    rollout(policy, 0, [], [16])
    policy.close()
    assert server.calls == [RESET, added(1, 0), INFER, added(16, 0), INFER]
    assert server.memory.exec_start_idx == 0


def test_a_full_last_chunk_leaves_the_live_frame_its_own_with_the_total(
    server: PolicyServer,
) -> None:
    policy = client(server)
    rollout(policy, 32, [10, 22], [])
    policy.close()
    assert server.calls == [RESET, added(16, 32), added(16, 32), added(1, 32), INFER]


@settings(max_examples=25)
@given(
    chunks=st.lists(st.integers(1, 40), max_size=5),
    live=st.lists(st.integers(1, 16), max_size=3),
    most=st.integers(1, 20),
)
def test_the_memory_is_the_same_however_the_history_is_cut(
    chunks: list[int], live: list[int], most: int
) -> None:
    with PolicyServer().running() as server:
        policy = client(server, chunk_frames=most)
        rollout(policy, sum(chunks), chunks, live)
        policy.close()
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
    policy = client(server)
    policy.reset(info(3))
    frames, states = section(0, 3)
    policy.add_history(frames, states, 3)
    frames["front"][:] = 255
    states[:] = 9
    policy.observe(*section(3, 4))
    policy.close()
    assert np.array_equal(np.stack(server.memory.states), section(0, 4)[1])
    assert np.array_equal(np.stack(server.memory.frames), section(0, 4)[0]["front"])


def test_actions(server: PolicyServer) -> None:
    policy = client(server)
    policy.reset(info(0))
    policy.observe(*section(5, 6))
    actions = policy.act(observation(5), "pick")
    policy.close()
    # 20 actions that hold joints at 5; a gripper at 5 is open.
    expected = np.array([[5, 5, 5, 5, 5, 5, 5, 1]] * 20)
    assert np.array_equal(actions, expected)


def test_the_metadata_is_what_the_server_says(server: PolicyServer) -> None:
    server.metadata = {"model": "none", "seed": np.int64(7), "mean": np.zeros(2), "b": b"\x00"}
    policy = client(server)
    assert server.connections == 0  # nothing is reached before it is needed
    assert plain(policy.metadata()) == {
        "policy": "websocket",
        "server": f"127.0.0.1:{server.port}",
        "server_metadata": {"model": "none", "seed": 7, "mean": [0.0, 0.0], "b": r"b'\x00'"},
    }
    rollout(policy, 0, [], [])
    policy.close()
    assert server.connections == 1


def test_a_second_rollout_starts_from_nothing(server: PolicyServer) -> None:
    policy = client(server)
    rollout(policy, 20, [20], [16])
    policy.reset(info(5))
    policy.add_history(*section(0, 5), 5)  # left waiting: the rollout ends here
    rollout(policy, 0, [], [])
    policy.close()
    assert server.memory.count == 1
    assert server.connections == 1


# --- errors that the server reports ------------------------------------------------------------


def test_a_traceback_becomes_one_error_with_its_last_line(server: PolicyServer) -> None:
    policy = client(server)
    policy.reset(info(0))
    with pytest.raises(PolicyServerError) as raised:
        policy.act(observation(0), "pick")  # without a frame in the memory
    assert raised.value.message == (
        f"policy server 127.0.0.1:{server.port} reports: "
        "AssertionError: history feats is empty, add buffer first"
    )
    # The memory is lost with the connection: this rollout cannot go on.
    with pytest.raises(PolicyServerError, match="was lost, and its memory with it"):
        policy.observe(*section(0, 1))
    with pytest.raises(PolicyServerError, match="was lost"):
        policy.act(observation(0), "pick")
    assert policy.metadata()["server_metadata"] == {"model": "none", "seed": 7}
    assert server.connections == 1
    # The next one connects again.
    rollout(policy, 3, [3], [])
    policy.close()
    assert server.connections == 2


@pytest.mark.parametrize("call", ["reset", "add_buffer", "infer"])
def test_every_call_checks_for_a_traceback(server: PolicyServer, call: str) -> None:
    def fail(message: dict[str, Any]) -> None:
        if message.get(call) or (call == "infer" and "prompt" in message):
            raise ValueError(f"no {call}\n")

    server.before = fail
    policy = client(server)
    with pytest.raises(PolicyServerError, match=f"reports: ValueError: no {call}"):
        rollout(policy, 2, [2], [])
    policy.close()


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (PolicyServer.CLOSE, "closed the connection: "),
        ("", "reports: an empty text"),
        (b"\xc1", "1 bytes are not a message"),
        (msgpack.packb([1]), "answers with a list, not a map"),
        (msgpack.packb({"a": 1, "b": 2}), "answers without 'actions': a, b"),
        (msgpack.packb({}), "answers without 'actions': an empty map"),
    ],
)
def test_answers_that_are_none(server: PolicyServer, answer: Any, text: str) -> None:
    server.before = lambda message: answer if "prompt" in message else None
    policy = client(server)
    with pytest.raises(PolicyServerError, match=text):
        rollout(policy, 0, [], [])
    policy.close()


def test_a_reset_that_is_not_finished_is_an_error(server: PolicyServer) -> None:
    server.before = lambda message: msgpack.packb({"reset_finished": False})
    policy = client(server)
    with pytest.raises(PolicyServerError, match="answers without 'reset_finished'"):
        policy.reset(info(0))
    policy.close()


def test_a_close_with_1011_alone_is_told(server: PolicyServer) -> None:
    def handle(connection: Any) -> None:
        connection.send(msgpack.packb({}))
        connection.recv()
        connection.close(1011, "out of memory")

    with serve(handle, "127.0.0.1", 0) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        policy = WebsocketPolicy("127.0.0.1", other.socket.getsockname()[1], connect_s=1.0)
        with pytest.raises(PolicyServerError, match=r"received 1011 .* out of memory"):
            policy.reset(info(0))
        policy.close()
        other.shutdown()
