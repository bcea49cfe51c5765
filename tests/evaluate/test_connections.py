"""Connections to policy servers: calls of a rollout; servers that are absent, slow or broken."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.messages import raises
from support.policy_calls import INFER, RESET, added, client, info, observation, rollout, section
from support.policy_server import PolicyServer
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Response
from websockets.sync.client import ClientConnection, connect
from websockets.sync.server import serve

from robomme_interference_data.errors import PolicyServerError
from robomme_interference_data.evaluate.policies import connection
from robomme_interference_data.evaluate.policies.connection import API_KEY_VARIABLE
from robomme_interference_data.evaluate.policies.websocket import WebsocketPolicy
from robomme_interference_data.evaluate.run.identity import plain


@contextmanager
def listening(backlog: int = 1) -> Iterator[int]:
    """A port that accepts connections and never answers; with a backlog of -1 it is closed."""
    with socket.socket() as mute:
        mute.bind(("127.0.0.1", 0))
        if backlog >= 0:
            mute.listen(backlog)
        yield mute.getsockname()[1]


@contextmanager
def handling(handle: Callable[[Any], Any], **options: Any) -> Iterator[int]:
    """A websocket server that is no policy server."""
    with serve(handle, "127.0.0.1", 0, **options) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        yield other.socket.getsockname()[1]
        other.shutdown()


# --- calls -------------------------------------------------------------------------------------


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
        # After a full last chunk, the live frame is sent alone, with the total.
        (32, [10, 22], [], [added(16, 32), added(16, 32), added(1, 32)]),
    ],
)
def test_the_calls_of_a_rollout(
    server: PolicyServer, history: int, chunks: list[int], live: list[int], calls: list[Any]
) -> None:
    with client(server) as policy:
        rollout(policy, history, chunks, live)
    assert server.calls == [RESET, *calls, INFER]
    assert server.connections == 1


@settings(max_examples=25)
@given(
    chunks=st.lists(st.integers(1, 40), max_size=5),
    live=st.lists(st.integers(1, 16), max_size=3),
    most=st.integers(1, 20),
)
def test_the_memory_does_not_depend_on_how_the_history_is_chunked(
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


def test_waiting_frames_are_copies_of_the_callers_arrays(server: PolicyServer) -> None:
    with client(server) as policy:
        policy.reset(info(3))
        frames, states = section(0, 3)
        policy.add_history(frames, states, 3)
        frames["front"][:] = 255
        states[:] = 9
        policy.observe(*section(3, 4))
    assert np.array_equal(np.stack(server.memory.states), section(0, 4)[1])
    assert np.array_equal(np.stack(server.memory.frames), section(0, 4)[0]["front"])


def test_metadata_and_actions_of_the_server(server: PolicyServer) -> None:
    server.metadata = {"model": "none", "seed": np.int64(7), "mean": np.zeros(2), "b": b"\x00"}
    with client(server) as policy:
        assert server.connections == 0  # it connects at the first call
        assert plain(policy.metadata()) == {
            "policy": "websocket",
            "server": f"127.0.0.1:{server.port}",
            "server_metadata": {"model": "none", "seed": 7, "mean": [0.0, 0.0], "b": r"b'\x00'"},
        }
        policy.reset(info(5))
        policy.add_history(*section(0, 5), 5)  # left waiting: the next rollout drops them
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
        with raises(PolicyServerError):
            policy.act(observation(0), "pick")  # without a frame in the memory
        # The memory is lost with the connection: this rollout ends.
        with raises(PolicyServerError):
            policy.observe(*section(0, 1))
        assert policy.metadata()["server_metadata"] == {}
        assert server.connections == 1
        rollout(policy, 3, [3], [])  # the next one connects again
    assert server.connections == 2


@pytest.mark.parametrize("call", ["reset", "add_buffer", "prompt"])
@pytest.mark.parametrize(
    "answer",
    [
        PolicyServer.CLOSE,
        "",
        b"\xc1",
        msgpack.packb([1]),
        msgpack.packb({"a": 1, "b": 2}),
        msgpack.packb({"reset_finished": False}),
    ],
)
def test_every_answer_is_checked(server: PolicyServer, call: str, answer: Any) -> None:
    server.before = lambda message: answer if call in message else None
    with client(server) as policy, raises(PolicyServerError):
        rollout(policy, 2, [2], [])


# --- connecting --------------------------------------------------------------------------------


def test_no_server_listens() -> None:
    with listening(-1) as port:
        policy = WebsocketPolicy("127.0.0.1", port, connect_s=0.5)
        with pytest.raises(PolicyServerError) as raised:
            policy.reset(info(0))
    assert f"policy server 127.0.0.1:{port} cannot be reached: " in raised.value.message
    assert raised.value.message.endswith("refused (for 0.5 s)")


def test_a_silent_port_is_reported_soon_and_times_out(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "_QUIET_S", 0.2)
    with listening() as port:
        policy = WebsocketPolicy("127.0.0.1", port, connect_s=0.6)
        began = time.monotonic()
        with raises(PolicyServerError):
            policy.metadata()
        assert 0.5 < time.monotonic() - began < 60
    assert len(caplog.messages) == 1
    assert f"127.0.0.1:{port}" in caplog.text and "0.6 s at most" in caplog.text


@pytest.mark.parametrize(
    "status",
    [
        HTTPStatus.SERVICE_UNAVAILABLE,  # after retries
        HTTPStatus.NOT_FOUND,
    ],
)
def test_a_server_that_is_not_ready_or_no_policy_server(
    server: PolicyServer, status: HTTPStatus
) -> None:
    server.status = status
    with client(server, connect_s=0.5) as policy:
        with raises(PolicyServerError):
            policy.reset(info(0))
        server.status = None
        rollout(policy, 0, [], [])


def test_the_key_is_sent(server: PolicyServer, monkeypatch: pytest.MonkeyPatch) -> None:
    server.api_key = "abc"
    monkeypatch.delenv(API_KEY_VARIABLE, raising=False)
    with client(server) as policy:
        with raises(PolicyServerError) as raised:
            policy.reset(info(0))
        assert API_KEY_VARIABLE in (raised.value.hint or "")
        monkeypatch.setenv(API_KEY_VARIABLE, "abc")
        rollout(policy, 0, [], [])


def test_a_server_that_sends_no_metadata() -> None:
    with handling(lambda opened: opened.recv()) as port:
        policy = WebsocketPolicy("127.0.0.1", port, connect_s=0.5)
        with raises(PolicyServerError):
            policy.reset(info(0))


# --- connections that break --------------------------------------------------------------------


def test_the_next_reset_connects_to_a_restarted_server() -> None:
    server = PolicyServer()
    with server.running():
        policy = WebsocketPolicy("127.0.0.1", server.port)
        rollout(policy, 2, [2], [16])
        policy.observe(*section(0, 4))
    with raises(PolicyServerError):
        policy.act(observation(3), "pick")  # never in the middle of a rollout
    with server.running():
        rollout(policy, 2, [2], [])
        policy.close()
    assert server.connections == 2


def test_a_restarted_server_must_report_the_same() -> None:
    server = PolicyServer()
    server.metadata = {"checkpoint": "mine/1", "mean": np.zeros(2)}
    with server.running():
        policy = WebsocketPolicy("127.0.0.1", server.port)
        rollout(policy, 2, [2], [16])
    with server.running():
        rollout(policy, 2, [2], [])
    server.metadata = {"checkpoint": "mine/2", "mean": np.zeros(2)}
    with server.running():
        for _ in range(2):  # it stays an error
            with raises(PolicyServerError):
                policy.reset(info(0))


def test_a_connection_that_is_closed_in_good_order_ends_the_rollout(server: PolicyServer) -> None:
    """As a server does that restarts: its memory is lost, and nothing goes on without it."""
    with client(server) as policy:
        rollout(policy, 3, [3], [])
        server.close_connections()
        with raises(PolicyServerError):
            policy.observe(*section(4, 5))
        with raises(PolicyServerError):
            policy.act(observation(4), "pick")
        assert server.connections == 1
        rollout(policy, 3, [3], [])
    assert server.connections == 2


def test_a_server_that_hangs_times_out(server: PolicyServer) -> None:
    resume = threading.Event()
    server.before = lambda message: resume.wait(30) and None if "prompt" in message else None
    with client(server, response_s=0.3) as policy:
        with raises(PolicyServerError):
            rollout(policy, 0, [], [])
        resume.set()


def test_a_server_that_does_not_read_times_out() -> None:
    """A message larger than the socket's buffers: the send hangs."""
    stop = threading.Event()

    def handle(opened: Any) -> None:
        opened.send(msgpack.packb({}))
        opened.recv()
        opened.send(msgpack.packb({"reset_finished": True}))
        stop.wait(30)

    with handling(handle, max_queue=1, max_size=None) as port:
        policy = WebsocketPolicy("127.0.0.1", port, response_s=0.5, chunk_frames=4000)
        policy.reset(info(2000))
        frames = {"front": np.zeros((2000, 64, 64, 3), np.uint8)}
        policy.add_history(frames, np.zeros((2000, 8), np.float32), 2000)
        with raises(PolicyServerError):
            policy.observe({"front": frames["front"][:1]}, np.zeros((1, 8), np.float32))
        stop.set()
        policy.close()


def test_a_server_that_computes_for_long_is_not_dropped(
    server: PolicyServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    # It answers no pings meanwhile: keepalive's defaults (20 s, shortened here) would drop it.
    def impatient(*arguments: Any, **options: Any) -> Any:
        return connect(*arguments, **{"ping_interval": 0.05, "ping_timeout": 0.1, **options})

    monkeypatch.setattr(connection, "connect", impatient)
    server.before = lambda message: time.sleep(0.5) if "prompt" in message else None
    with client(server) as policy:
        rollout(policy, 0, [], [16])
    assert server.connections == 1


def test_an_interrupt_leaves_no_answer_behind(
    server: PolicyServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    receive = ClientConnection.recv_streaming

    def interrupted(opened: ClientConnection) -> Any:
        list(receive(opened))
        raise KeyboardInterrupt

    with client(server) as policy:
        rollout(policy, 0, [], [])
        with monkeypatch.context() as patch:
            patch.setattr(ClientConnection, "recv_streaming", interrupted)
            with pytest.raises(KeyboardInterrupt):
                policy.act(observation(0), "pick")
        rollout(policy, 1, [1], [])  # a fresh connection, or the order would be wrong
    assert server.connections == 2


def test_an_answer_that_is_slow_or_endless_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """The limits cover a whole answer, which may come in fragments."""
    stop = threading.Event()

    def handle(opened: Any) -> None:
        opened.send(msgpack.packb({}))
        opened.recv()

        def fragments() -> Iterator[bytes]:
            while not stop.wait(0.05):
                yield b"\x00" * 1000

        with suppress(ConnectionClosed):
            opened.send(fragments())

    with handling(handle) as port:
        policy = WebsocketPolicy("127.0.0.1", port, response_s=0.4)
        with raises(PolicyServerError):
            policy.reset(info(0))
        monkeypatch.setattr(connection, "MAX_BYTES", 5000)
        policy = WebsocketPolicy("127.0.0.1", port, response_s=20)
        with raises(PolicyServerError):
            policy.reset(info(0))
        stop.set()


# --- redirects ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "address",
    ["file:///etc/passwd", "http://127.0.0.1:1/", "ws://127.0.0.1:99999/", "ws://[/", "/"],
)
def test_a_redirect_that_leads_to_no_server(address: str) -> None:
    def redirect(opened: Any, request: Any) -> Response:
        response = opened.respond(HTTPStatus.FOUND, "elsewhere\n")
        response.headers["Location"] = address
        return response  # type: ignore[no-any-return]

    with (
        handling(lambda opened: None, process_request=redirect) as port,
        pytest.raises(PolicyServerError) as raised,
    ):
        WebsocketPolicy("127.0.0.1", port, connect_s=1.0).reset(info(0))
    assert f"127.0.0.1:{port} is no policy server" in raised.value.message
