"""Policy servers that send what costs much memory or time: an error row, soon and in little memory.

The server runs in this process, the run in a child whose memory is measured.
"""

import json
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
from support.policy_calls import client, info, rollout
from support.policy_server import PolicyServer
from support.worlds import BUFFER_SET
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Response
from websockets.sync.server import serve

from robomme_interference_data.errors import FormatError, PolicyError, PolicyServerError
from robomme_interference_data.evaluate.policies import wire
from robomme_interference_data.evaluate.policies.identity import MOST_METADATA, policy_metadata
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.policies.websocket import WebsocketPolicy

LIMIT_S = 4.0
"""Time limit of an answer."""

MOST_S = 40.0
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
    assert seconds < MOST_S and peak < MEGABYTES


def test_reading_counts_into_the_time_limit(
    server: PolicyServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    unpack = msgpack.unpackb

    def slowly(data: bytes, **options: Any) -> Any:
        time.sleep(0.3 if b"actions" in data else 0)
        return unpack(data, **options)

    monkeypatch.setattr(wire.msgpack, "unpackb", slowly)
    with (
        client(server, response_s=0.2) as policy,
        pytest.raises(PolicyServerError, match=r"did not answer within 0\.2 s"),
    ):
        rollout(policy, 0, [], [])


@pytest.mark.parametrize("items", [wire.MOST_ITEMS, wire.MOST_ITEMS + 1])
def test_the_items_of_a_message_are_bounded(items: int) -> None:
    maps = msgpack.packb([[{}] * (items - 3 - 1000), [{}] * 1000])
    flat = msgpack.packb([0] * items)
    for data in (maps, flat):
        if items <= wire.MOST_ITEMS:
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
        ({"checkpoint": "a", "config": "x" * MOST_METADATA}, PolicyError),
    ],
)
def test_long_metadata_is_an_error(server: PolicyServer, metadata: Any, error: Any) -> None:
    server.metadata = metadata
    began = time.monotonic()
    with client(server, connect_s=2.0) as policy, pytest.raises(error):
        policy_metadata("websocket:it", policy)
    assert time.monotonic() - began < MOST_S


def test_metadata_that_just_fits(server: PolicyServer) -> None:
    server.metadata = {"checkpoint": "a", "config": "x" * (MOST_METADATA - 1000)}
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
    assert time.monotonic() - began < MOST_S
