"""Connections to policy servers that are absent, slow, restarted, or no policy servers."""

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
from support.policy_calls import client, info, observation, rollout, section
from support.policy_server import PolicyServer
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.sync.server import serve

from robomme_interference_data.errors import PolicyServerError
from robomme_interference_data.evaluate.policies import connection
from robomme_interference_data.evaluate.policies.connection import API_KEY_VARIABLE
from robomme_interference_data.evaluate.policies.websocket import WebsocketPolicy


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
        with pytest.raises(PolicyServerError, match="it does not answer"):
            policy.metadata()
        assert 0.5 < time.monotonic() - began < 60
    assert len(caplog.messages) == 1
    assert f"127.0.0.1:{port}" in caplog.text and "0.6 s at most" in caplog.text


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (HTTPStatus.SERVICE_UNAVAILABLE, r"it answers 503 \(for 0\.5 s\)"),  # after retries
        (HTTPStatus.NOT_FOUND, r"is no policy server.* websocket.* 404"),
    ],
)
def test_a_server_that_is_not_ready_or_no_policy_server(
    server: PolicyServer, status: HTTPStatus, words: str
) -> None:
    server.status = status
    with client(server, connect_s=0.5) as policy:
        with pytest.raises(PolicyServerError, match=words):
            policy.reset(info(0))
        server.status = None
        rollout(policy, 0, [], [])


def test_the_key_is_sent(server: PolicyServer, monkeypatch: pytest.MonkeyPatch) -> None:
    server.api_key = "abc"
    monkeypatch.delenv(API_KEY_VARIABLE, raising=False)
    with client(server) as policy:
        with pytest.raises(PolicyServerError, match="answers 401") as raised:
            policy.reset(info(0))
        assert API_KEY_VARIABLE in (raised.value.hint or "")
        monkeypatch.setenv(API_KEY_VARIABLE, "abc")
        rollout(policy, 0, [], [])


def test_a_server_that_sends_no_metadata() -> None:
    with handling(lambda opened: opened.recv()) as port:
        policy = WebsocketPolicy("127.0.0.1", port, connect_s=0.5)
        with pytest.raises(PolicyServerError, match="did not answer within"):
            policy.reset(info(0))


# --- connections that break --------------------------------------------------------------------


def test_the_next_reset_connects_to_a_restarted_server() -> None:
    server = PolicyServer()
    with server.running():
        policy = WebsocketPolicy("127.0.0.1", server.port)
        rollout(policy, 2, [2], [16])
        policy.observe(*section(0, 4))
    with pytest.raises(PolicyServerError, match="closed the connection"):
        policy.act(observation(3), "pick")  # never in the middle of a rollout
    with server.running():
        rollout(policy, 2, [2], [])
        policy.close()
    assert server.connections == 2


def test_a_server_that_hangs_times_out(server: PolicyServer) -> None:
    resume = threading.Event()
    server.before = lambda message: resume.wait(30) and None if "prompt" in message else None
    with client(server, response_s=0.3) as policy:
        with pytest.raises(PolicyServerError, match=r"did not answer within 0\.3 s"):
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
        with pytest.raises(PolicyServerError, match=r"did not answer within 0\.5 s"):
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
        with pytest.raises(PolicyServerError, match=r"did not answer within 0\.4 s"):
            policy.reset(info(0))
        monkeypatch.setattr(connection, "MAX_BYTES", 5000)
        policy = WebsocketPolicy("127.0.0.1", port, response_s=20)
        with pytest.raises(PolicyServerError, match="1009"):
            policy.reset(info(0))
        stop.set()
