"""The websocket adapter against a server that keeps its own account of the memory."""

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import policy_server
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from policy_server import Memory, PolicyServer
from websockets.sync.client import connect
from websockets.sync.server import serve

from robomme_interference_data.errors import InvalidOptionError, PolicyError, PolicyServerError
from robomme_interference_data.evaluate.policies import connection
from robomme_interference_data.evaluate.policies.base import RolloutInfo
from robomme_interference_data.evaluate.policies.connection import API_KEY_VARIABLE
from robomme_interference_data.evaluate.policies.websocket import WebsocketPolicy
from robomme_interference_data.simulators.base import Observation

SIZE = 8
RESET = {"call": "reset"}
INFER = {"call": "infer", "prompt": "pick"}


def added(frames: int, exec_start_idx: int) -> dict[str, Any]:
    return {"call": "add_buffer", "frames": frames, "exec_start_idx": exec_start_idx}


@pytest.fixture
def server() -> Iterator[PolicyServer]:
    with PolicyServer().running() as running:
        yield running


def client(server: PolicyServer, **options: Any) -> WebsocketPolicy:
    return WebsocketPolicy("127.0.0.1", server.port, **({"backoff_s": 0.01} | options))


def section(start: int, stop: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Frames and states that tell their number."""
    numbers = np.arange(start, stop)
    front = np.zeros((len(numbers), SIZE, SIZE, 3), np.uint8)
    front[:, 0, 0, :] = np.stack([numbers % 256, numbers // 256, 0 * numbers], 1)
    states = np.repeat(numbers[:, None], 8, 1).astype(np.float32)
    return {"front": front, "wrist": front[::-1]}, states


def observation(number: int) -> Observation:
    frames, states = section(number, number + 1)
    return Observation({name: image[0] for name, image in frames.items()}, states[0])


def info(history: int) -> RolloutInfo:
    return RolloutInfo(goal="pick", history_frames=history, seed=3)


def rollout(policy: WebsocketPolicy, history: int, chunks: list[int], live: list[int]) -> None:
    """Play a rollout: history in chunks, the first live observation, then live ones."""
    policy.reset(info(history))
    at = 0
    for chunk in chunks:
        policy.add_history(*section(at, at + chunk), history)
        at += chunk
    for frames in [1, *live]:
        policy.observe(*section(at, at + frames))
        at += frames
        policy.act(observation(at - 1), "pick")


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
    expected = np.array([[5, 5, 5, 5, 5, 5, 5, 1]] * 20, np.float32)
    assert actions.dtype == np.float32
    assert np.array_equal(actions, expected)


def test_the_metadata_is_what_the_server_says(server: PolicyServer) -> None:
    server.metadata = {"model": "none", "seed": np.int64(7), "mean": np.zeros(2), "b": b"\x00"}
    policy = client(server)
    assert server.connections == 0  # nothing is reached before it is needed
    assert policy.metadata() == {
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
        (msgpack.packb({"actions": [1.0]}), r"actions of shape \(1,\) and dtype float64"),
        (
            msgpack.packb({"actions": np.zeros((2, 7))}, default=policy_server.encode),
            r"actions of shape \(2, 7\)",
        ),
        (
            msgpack.packb({"actions": np.zeros((0, 8))}, default=policy_server.encode),
            r"actions of shape \(0, 8\)",
        ),
        (
            msgpack.packb({"actions": np.full((1, 8), np.nan)}, default=policy_server.encode),
            "not finite",
        ),
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

    with serve(handle, "127.0.0.1", 0, process_request=healthy) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        policy = WebsocketPolicy("127.0.0.1", other.socket.getsockname()[1], attempts=1)
        with pytest.raises(PolicyServerError, match=r"received 1011 .* out of memory"):
            policy.reset(info(0))
        policy.close()
        other.shutdown()


def healthy(connection: Any, request: Any) -> Any:
    return connection.respond(200, "OK\n") if request.path == "/healthz" else None


# --- servers that are not there, or slow -------------------------------------------------------


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_nobody_listens() -> None:
    port = free_port()
    policy = WebsocketPolicy("127.0.0.1", port, attempts=3, backoff_s=0.01)
    with pytest.raises(PolicyServerError) as raised:
        policy.reset(info(0))
    assert f"policy server 127.0.0.1:{port} cannot be reached: " in raised.value.message
    assert raised.value.message.endswith("(attempts: 3)")
    assert "docs/systems.md" in (raised.value.hint or "")


def test_a_server_that_starts_late_is_waited_for() -> None:
    server = PolicyServer(port=free_port())
    policy = client(server, attempts=200, backoff_s=0.005)
    failed: list[BaseException] = []

    def play() -> None:
        try:
            rollout(policy, 0, [], [])
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=play)
    thread.start()
    time.sleep(0.2)
    with server.running():
        thread.join(60)
        policy.close()
    assert (failed, len(server.calls)) == ([], 3)


def test_a_server_that_was_restarted_is_connected_again_at_the_next_reset() -> None:
    server = PolicyServer()
    with server.running():
        policy = client(server, attempts=100)
        rollout(policy, 2, [2], [16])
        policy.observe(*section(0, 4))
    with pytest.raises(PolicyServerError, match="closed the connection"):
        policy.act(observation(3), "pick")  # never in the middle of a rollout
    with server.running():
        rollout(policy, 2, [2], [])
        policy.close()
    assert server.connections == 2


def test_a_connection_that_broke_between_rollouts_costs_none(server: PolicyServer) -> None:
    policy = client(server)
    rollout(policy, 0, [], [])
    closed: list[int] = []

    def close_once(message: dict[str, Any]) -> Any:
        if not closed:
            closed.append(1)
            return PolicyServer.CLOSE
        return None

    server.before = close_once
    rollout(policy, 4, [4], [])
    policy.close()
    assert server.memory.count == 5


@pytest.mark.parametrize("call", ["infer", "reset"])
def test_a_server_that_hangs_is_given_up(server: PolicyServer, call: str) -> None:
    go_on = threading.Event()

    def hang(message: dict[str, Any]) -> None:
        if call in message or (call == "infer" and "prompt" in message):
            go_on.wait(30)

    server.before = hang
    policy = client(server, response_s=0.3)
    try:
        with pytest.raises(PolicyServerError, match=r"did not answer within 0\.3 s"):
            rollout(policy, 0, [], [])
    finally:
        go_on.set()
    policy.close()


def test_a_server_that_does_not_even_read_is_given_up() -> None:
    """A message larger than the socket's buffers: it is the sending that hangs."""
    gone = threading.Event()

    def handle(connection: Any) -> None:
        connection.send(msgpack.packb({}))
        connection.recv()
        connection.send(msgpack.packb({"reset_finished": True}))
        gone.wait(30)

    options: dict[str, Any] = {"max_queue": 1, "max_size": None}
    with serve(handle, "127.0.0.1", 0, process_request=healthy, **options) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        port = other.socket.getsockname()[1]
        policy = WebsocketPolicy("127.0.0.1", port, response_s=0.5, chunk_frames=4000)
        policy.reset(info(2000))
        frames = {"front": np.zeros((2000, 64, 64, 3), np.uint8)}
        policy.add_history(frames, np.zeros((2000, 8), np.float32), 2000)
        with pytest.raises(PolicyServerError, match=r"did not answer within 0\.5 s"):
            policy.observe({"front": frames["front"][:1]}, np.zeros((1, 8), np.float32))
        gone.set()
        policy.close()
        other.shutdown()


def test_a_server_that_computes_for_long_is_not_dropped(
    server: PolicyServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    # It answers no pings meanwhile: with keepalive's defaults, 20 s made shorter, it were lost.
    def impatient(*arguments: Any, **options: Any) -> Any:
        return connect(*arguments, **{"ping_interval": 0.05, "ping_timeout": 0.1, **options})

    monkeypatch.setattr(connection, "connect", impatient)
    server.before = lambda message: time.sleep(0.5) if "prompt" in message else None
    policy = client(server)
    rollout(policy, 0, [], [16])
    policy.close()
    assert server.connections == 1


def test_pings_of_the_server_are_answered_while_the_simulator_runs() -> None:
    server = PolicyServer()
    server.options |= {"ping_interval": 0.05, "ping_timeout": 0.4}
    with server.running():
        policy = client(server)
        rollout(policy, 0, [], [])
        time.sleep(1)
        policy.observe(*section(1, 2))
        policy.close()
    assert server.connections == 1


def test_an_interrupt_leaves_no_answer_behind(server: PolicyServer) -> None:
    policy = client(server)
    rollout(policy, 0, [], [])
    opened: Any = policy._server._connection
    received = opened.recv

    def interrupted() -> Any:
        received()
        raise KeyboardInterrupt

    opened.recv = interrupted
    with pytest.raises(KeyboardInterrupt):
        policy.act(observation(0), "pick")
    rollout(policy, 1, [1], [])  # a fresh connection, or the order would be wrong
    policy.close()
    assert server.connections == 2


def test_a_time_limit_over_the_whole_answer_is_cancelled(server: PolicyServer) -> None:
    policy = client(server, response_s=0.5)
    rollout(policy, 0, [], [])
    time.sleep(0.8)  # no timer of an answered message closes the connection later
    rollout(policy, 0, [], [])
    policy.close()
    assert server.connections == 1


# --- what listens is no policy server ----------------------------------------------------------


def test_the_key_is_sent(server: PolicyServer, monkeypatch: pytest.MonkeyPatch) -> None:
    server.api_key = "abc"
    monkeypatch.delenv(API_KEY_VARIABLE, raising=False)
    policy = client(server)
    with pytest.raises(PolicyServerError, match="refuses with 401: it asks for another key") as e:
        policy.reset(info(0))
    assert API_KEY_VARIABLE in (e.value.hint or "")
    monkeypatch.setenv(API_KEY_VARIABLE, "abc")
    rollout(policy, 0, [], [])
    policy.close()


def test_something_else_listens(server: PolicyServer) -> None:
    server.health = HTTPStatus.NOT_FOUND
    policy = client(server)
    with pytest.raises(PolicyServerError, match="is no policy server: it answers 404"):
        policy.reset(info(0))
    assert server.connections == 0


def test_a_server_that_is_not_ready_is_asked_again(server: PolicyServer) -> None:
    server.health = HTTPStatus.SERVICE_UNAVAILABLE
    policy = client(server, attempts=2)
    with pytest.raises(PolicyServerError, match=r"GET /healthz answers 503 \(attempts: 2\)"):
        policy.reset(info(0))
    server.health = HTTPStatus.OK
    rollout(policy, 0, [], [])
    policy.close()


# --- calls out of order ------------------------------------------------------------------------


def test_history_must_be_as_announced(server: PolicyServer) -> None:
    policy = client(server)
    policy.reset(info(4))
    with pytest.raises(PolicyError, match="history of 5 frames after 4 were announced"):
        policy.add_history(*section(0, 5), 5)
    policy.add_history(*section(0, 3), 4)
    with pytest.raises(PolicyError, match="3 history frames came; 4 were announced"):
        policy.observe(*section(3, 4))
    policy.add_history(*section(3, 4), 4)
    policy.observe(*section(4, 5))
    with pytest.raises(PolicyError, match="history of 4 frames after a live observation"):
        policy.add_history(*section(0, 4), 4)
    policy.close()


def test_frames_and_states_must_fit(server: PolicyServer) -> None:
    policy = client(server)
    policy.reset(info(0))
    frames, states = section(0, 2)
    for given_frames, given_states, text in [
        ({"wrist": frames["wrist"]}, states, "camera 'front' are missing; given: wrist"),
        ({"front": frames["front"].astype(float)}, states, "float64 frames"),
        ({"front": frames["front"][0]}, states, r"frames of shape \(8, 8, 3\)"),
        (frames, states[:1], r"states of shape \(1, 8\)"),
        (frames, states[:, :7], r"states of shape \(2, 7\)"),
        ({"front": frames["front"][:0]}, states[:0], "T at least 1"),
    ]:
        with pytest.raises(PolicyError, match=text):
            policy.observe(given_frames, given_states)
    policy.close()


@pytest.mark.parametrize(
    "options", [{"chunk_frames": 0}, {"attempts": 0}, {"response_s": 0}, {"connect_s": -1}]
)
def test_bad_options(options: dict[str, Any]) -> None:
    with pytest.raises(InvalidOptionError, match="expected positive numbers"):
        WebsocketPolicy("127.0.0.1", 1, **options)


# --- the server of these tests -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("calls", "text"),
    [
        (["add 1 0"], "reset first"),
        (["reset", "infer"], "history feats is empty, add buffer first"),
        (["reset", "add 3 2", "add 1 3"], "another length of the history"),
        (["reset", "add 1 0", "add 1 3"], "history after other frames"),
        (["reset", "add 2 1", "infer", "add 1 1"], "history after the first answer"),
        (["reset", "add 2 2", "infer"], "0 live frames before the first answer"),
        (["reset", "add 1 0", "infer", "infer"], "0 frames since the last answer"),
        (["reset", "add 1 0", "infer", "add 17 0", "infer"], "17 frames since the last answer"),
        (["reset", "add 4097 0"], "index 4096 is out of bounds"),
    ],
)
def test_the_servers_account_refuses_a_wrong_order(calls: list[str], text: str) -> None:
    memory = Memory(keep=False)
    seen = observation(0)
    message = {
        "observation/image": seen.images["front"],
        "observation/wrist_image": seen.images["wrist"],
        "observation/state": seen.state,
        "prompt": "pick",
    }

    def play(call: str) -> None:
        name, *numbers = call.split()
        if name == "reset":
            memory.reset()
        elif name == "infer":
            memory.infer(message)
        else:
            frames, start = map(int, numbers)
            images = np.zeros((frames, 1, 2, 2, 3), np.uint8)
            states = np.zeros((frames, 8), np.float32)
            memory.add_buffer({"images": images, "state": states, "exec_start_idx": start})

    for call in calls[:-1]:
        play(call)
    with pytest.raises(AssertionError, match=text):
        play(calls[-1])


def test_the_server_in_a_process_of_its_own(tmp_path: Path) -> None:
    log = tmp_path / "calls.jsonl"
    command = [sys.executable, policy_server.__file__, "--log", str(log)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            policy = WebsocketPolicy("127.0.0.1", int(address.rsplit(":", 1)[1]))
            rollout(policy, 20, [20], [16])
            policy.close()
        finally:
            process.kill()
    lines = [line for line in log.read_text(encoding="utf-8").splitlines() if line]
    assert [line.split('"')[3] for line in lines] == [
        "reset",
        "add_buffer",
        "add_buffer",
        "infer",
        "add_buffer",
        "infer",
    ]
