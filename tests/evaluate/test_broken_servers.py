"""Connections to policy servers that are absent, slow or restarted, or whose answers cost too much.

What costs much memory or time is an error row, soon and in little memory: there the server runs in
this process, the run in a child whose memory is measured."""

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from itertools import repeat
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from support.lazy import lazy
from support.messages import raises
from support.policy_calls import client, info, observation, rollout, section
from support.policy_server import PolicyServer
from support.worlds import BUFFER_SET
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Response
from websockets.sync.client import ClientConnection, connect
from websockets.sync.server import serve

from robomme_interference_data.errors import FormatError, PolicyError, PolicyServerError
from robomme_interference_data.evaluate.policies import connection, wire
from robomme_interference_data.evaluate.policies.connection import API_KEY_VARIABLE
from robomme_interference_data.evaluate.policies.identity import MAX_METADATA, policy_metadata
from robomme_interference_data.evaluate.policies.registry import make_policy
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


LIMIT_S = 4.0
"""Time limit of an answer."""

MAX_S = 40.0
"""A row that takes longer was parsed on and on; idle, the slowest takes 3 s."""

MEGABYTES = 1500
"""Most memory of the process of a run."""

codec = lazy("vla_eval.protocol.image_codec")
messages = lazy("vla_eval.protocol.messages")

_CHILD = """
import json, sys, time
from pathlib import Path
from support.runs import run_one

def peak_mb():
    # Not ru_maxrss: a child starts with the peak of the process that forked it.
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) >> 10

for name in sys.argv[3:]:
    began = time.monotonic()
    options = (f"response_s={sys.argv[2]}", "connect_s=2", "checkpoint=a")
    done = run_one(Path(name), policy=sys.argv[1], policy_options=options)
    [row] = done.rows
    took = time.monotonic() - began
    print(json.dumps([name, row.status, row.error, took, peak_mb()]), flush=True)
"""


def listed(items: int, item: bytes) -> bytes:
    """A list of equal items."""
    return b"\xdd" + items.to_bytes(4) + item * items


def text(count: int) -> Iterator[bytes]:
    return (b"\xa5%05d" % number for number in range(count))


def array(**fields: Any) -> bytes:
    """An answer whose actions are such an array."""
    valid = {"__ndarray__": True, "data": b"", "dtype": "<f4", "shape": (0, 8)}
    fields = {key.encode(): value for key, value in (valid | fields).items()}
    return msgpack.packb({"actions": fields})


ANSWER = b"\x81\xa7actions"
"""The beginning of an answer: the rest are its actions."""

HOSTILE: dict[str, Callable[[], Any]] = {
    "60 MB of empty maps": lambda: ANSWER + listed(60_000_000, b"\x80"),
    "empty maps": lambda: ANSWER + listed(250, listed(60_000, b"\x80")),
    "empty lists": lambda: ANSWER + listed(250, listed(60_000, b"\x90")),
    "maps of texts": lambda: b"".join(
        b"\xdf\x00\x01\x00\x00" + b"".join(key + b"\xc0" for key in text(65_535)) + b"\xa1x"
        for _ in range(35)
    ),
    "lists of texts": lambda: b"".join(
        b"\xdd\x00\x01\x00\x00" + b"".join(text(65_535)) for _ in range(40)
    ),
    "lists that claim more": lambda: ANSWER + b"\xdd\x00\x01\x00\x00" * 3_000_000,
    "a deep list": lambda: ANSWER + b"\x91" * 15_000_000,
    "a long dtype": lambda: array(dtype="i4," * 5_000_000),
    "a dtype of many fields": lambda: array(dtype=[["a", "i4"]] * 60_000),
    "a shape of many sides": lambda: array(shape=[1] * 60_000),
    "a huge shape": lambda: array(shape=[0, 2**62, 2**62]),
    "an array of huge texts": lambda: array(dtype="<U500000000", shape=[0]),
    "a long traceback": lambda: "line\n" * 3_000_000,
    "fragments of a byte": lambda: repeat(b"\x80", 15_000_000),
    "endless empty fragments": lambda: repeat(b""),
}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory, tiny_buffers: Path) -> dict[str, Any]:
    """Status, error, seconds and peak memory of a row for each hostile answer."""
    made = iter(HOSTILE.values())
    server = PolicyServer()
    server.before = lambda message: next(made)() if "prompt" in message else None
    with server.running():
        done = subprocess.run(
            [sys.executable, "-c", _CHILD, server.url, str(LIMIT_S), *HOSTILE],
            env={
                "PYTHONPATH": str(Path(__file__).parents[1]),
                "OMP_NUM_THREADS": "1",
                BUFFER_SET: str(tiny_buffers),
            },
            cwd=tmp_path_factory.mktemp("runs"),
            capture_output=True,
            text=True,
            timeout=180,
            check=False,
        )
    assert done.returncode == 0, done.stdout + done.stderr
    return {name: rest for name, *rest in map(json.loads, done.stdout.splitlines())}


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_answer_is_an_error_row(outcomes: dict[str, Any], name: str) -> None:
    status, error, seconds, peak = outcomes[name]
    assert status == "error" and error.startswith("Policy"), error
    assert seconds < MAX_S and peak < MEGABYTES


def test_reading_counts_into_the_time_limit(
    server: PolicyServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    unpack = msgpack.unpackb

    def slowly(data: bytes, **options: Any) -> Any:
        time.sleep(0.3 if b"actions" in data else 0)
        return unpack(data, **options)

    monkeypatch.setattr(wire.msgpack, "unpackb", slowly)
    with client(server, response_s=0.2) as policy, raises(PolicyServerError):
        rollout(policy, 0, [], [])


@pytest.mark.parametrize("items", [wire.MAX_ITEMS, wire.MAX_ITEMS + 1])
def test_the_items_of_a_message_are_bounded(items: int) -> None:
    maps = msgpack.packb([[{}] * (items - 3 - 1000), [{}] * 1000])
    flat = msgpack.packb([0] * items)
    for data in (maps, flat):
        if items <= wire.MAX_ITEMS:
            assert wire.unpack(data)
        else:
            with pytest.raises(FormatError):
                wire.unpack(data)


# --- what servers report of themselves ---------------------------------------------------------


@pytest.mark.parametrize(
    ("metadata", "error"),
    [
        ({"checkpoint": "a", "config": "x" * 40_000_000}, PolicyServerError),
        ({"checkpoint": "a", "config": [[{}] * 60_000] * 200}, PolicyServerError),
        ({"checkpoint": "a", "config": "x" * 10_000_000}, PolicyError),
        ({"checkpoint": "a", "config": [*range(60_000)]}, PolicyError),
        ({"checkpoint": "a", "config": "x" * MAX_METADATA}, PolicyError),
    ],
)
def test_long_metadata_is_an_error(server: PolicyServer, metadata: Any, error: Any) -> None:
    server.metadata = metadata
    began = time.monotonic()
    with client(server, connect_s=2.0) as policy, pytest.raises(error):
        policy_metadata("websocket:it", policy)
    assert time.monotonic() - began < MAX_S


def test_metadata_that_just_fits(server: PolicyServer) -> None:
    server.metadata = {"checkpoint": "a", "config": "x" * (MAX_METADATA - 1000)}
    with client(server) as policy:
        assert policy_metadata("websocket:it", policy)["server_metadata"] == server.metadata


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
        serving(lambda opened: None, process_request=redirect) as port,
        pytest.raises(PolicyServerError) as raised,
    ):
        WebsocketPolicy("127.0.0.1", port, connect_s=1.0).reset(info(0))
    assert f"127.0.0.1:{port} is no policy server" in raised.value.message


@contextmanager
def serving(handle: Callable[[Any], Any], **options: Any) -> Iterator[int]:
    """A websocket server in a thread of this process."""
    with serve(handle, "127.0.0.1", 0, **options) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.socket.getsockname()[1]
        server.shutdown()


# --- vla-eval ----------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["images", "maps", "dtype"])
def test_a_hostile_answer_of_vla_eval(what: str) -> None:
    """Images of some kB that have 12 MB each once they are decoded; and so on."""
    picture = codec.encode_image(np.zeros((2000, 2000, 3), np.uint8), "png")
    payload = {
        "images": {"actions": [picture] * 1000},
        "maps": {"actions": [[{}] * 60_000] * 200},
        "dtype": {"actions": {"__ndarray__": True, "dtype": "i4," * 5_000_000}},
    }[what]

    def handle(opened: Any) -> None:
        hello = messages.unpack_message(opened.recv())
        answer = {"type": "hello", "seq": hello.seq, "timestamp": 0.0, "payload": payload}
        with suppress(ConnectionClosed):
            opened.send(msgpack.packb(answer))

    began = time.monotonic()
    with serving(handle) as port, pytest.raises(PolicyServerError):
        make_policy(f"vla-eval:ws://127.0.0.1:{port}", ("checkpoint=a", "connect_s=2"))
    assert time.monotonic() - began < MAX_S
