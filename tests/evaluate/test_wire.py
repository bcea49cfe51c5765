"""Messages of policy servers as bytes, and answers that cost much memory or time.

Those are error rows, soon and in little memory: there the server runs in this process, the run in a
child whose memory is measured.
"""

import json
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import repeat
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from support.lazy import lazy
from support.messages import raises
from support.policy_calls import client, rollout
from support.policy_server import PolicyServer
from support.worlds import BUFFER_SET
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve

from robomme_interference_data.errors import FormatError, PolicyError, PolicyServerError
from robomme_interference_data.evaluate.policies import wire
from robomme_interference_data.evaluate.policies.identity import MAX_METADATA, policy_metadata
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.policies.wire import pack, unpack

# --- messages ----------------------------------------------------------------------------------

GOLDEN = Path(__file__).parent.parent / "golden" / "wire_messages.txt"
MESSAGES: dict[str, Any] = {
    "reset": {"reset": True},
    "add_buffer": {
        "add_buffer": True,
        "images": np.array([[[[[0, 1, 2], [253, 254, 255]]]]], np.uint8),
        "state": np.array([[0, 1, -2, 0.5, 3, 4, -0.125, -1]], np.float32),
        "exec_start_idx": 300,
    },
    "reset_finished": {"reset_finished": True, "reset_time_ms": 1.5, "step": np.int32(-1)},
    "no frames": np.zeros((0, 8)),
}


def golden() -> dict[str, bytes]:
    messages: dict[str, str] = {}
    name = ""
    for line in GOLDEN.read_text(encoding="utf-8").splitlines():
        text = line.partition("#")[0].strip()
        if header := re.fullmatch(r"\[(.+)\]", text):
            name = header[1]
        elif text:
            messages[name] = messages.get(name, "") + text
    return {name: bytes.fromhex(text) for name, text in messages.items()}


@pytest.mark.parametrize("name", MESSAGES)
def test_golden_bytes(name: str) -> None:
    assert golden().keys() == MESSAGES.keys()
    assert pack(MESSAGES[name]) == golden()[name]
    assert pack(unpack(golden()[name])) == golden()[name]


def test_arrays_travel_in_c_order_and_are_read_as_views() -> None:
    images = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    for array in (np.asfortranarray(images), images[::-1], images.transpose(2, 0, 1)):
        read = unpack(pack(array))
        np.testing.assert_array_equal(read, array)
        assert not read.flags.writeable and not read.flags.owndata


ARRAYS = hnp.arrays(
    hnp.boolean_dtypes()
    | hnp.integer_dtypes()
    | hnp.floating_dtypes()
    | hnp.unicode_string_dtypes(min_len=1),
    hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4),
)
NUMBERS = st.integers(-128, 127).map(np.int8) | st.floats(width=32).map(np.float32)
PLAIN = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=8)
)
ANYTHING = st.recursive(
    st.one_of(PLAIN, ARRAYS, NUMBERS),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(ANYTHING)
def test_round_trip(message: Any) -> None:
    read = unpack(pack(message))
    assert pack(read) == pack(message)
    assert isinstance(read, tuple | list) or type(read) is type(message)


ACTIONS = np.arange(16, dtype="<f4").reshape(2, 8)
OF_OTHER_LIBRARIES = {
    # openpi's map with keys of text
    "text": {"__ndarray__": True, "data": ACTIONS.tobytes(), "dtype": "<f4", "shape": [2, 8]},
    # The package msgpack-numpy.
    "msgpack-numpy": {
        b"nd": True,
        b"type": "<f4",
        b"kind": b"",
        b"shape": [2, 8],
        b"data": ACTIONS.tobytes(),
    },
}


@pytest.mark.parametrize("name", OF_OTHER_LIBRARIES)
def test_arrays_of_other_libraries_are_read(name: str) -> None:
    read = unpack(msgpack.packb({"actions": OF_OTHER_LIBRARIES[name]}))["actions"]
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, ACTIONS)


def test_scalars_of_other_libraries_are_read() -> None:
    text = {"__npgeneric__": True, "data": 2.5, "dtype": "<f4"}
    package = {b"nd": False, b"type": "<f8", b"data": np.float64(2.5).tobytes()}
    for sent, kind in ((text, np.float32), (package, np.float64)):
        read = unpack(msgpack.packb(sent))
        assert (read, type(read)) == (2.5, kind)
    plain = {"nd": 3, "type": "a map of its own"}
    assert unpack(msgpack.packb(plain | {"type": "short"})) == plain | {"type": "short"}


@pytest.mark.parametrize(
    "change",
    [
        {b"kind": b"O"},  # a pickled object
        {b"kind": b"V", b"type": [["a", "<f4"]]},
        {b"type": "O"},
        {b"type": "<f4,<f4,<f4,<f4,<f4,<f4"},
        {b"shape": [3, 8]},
    ],
)
def test_arrays_of_msgpack_numpy_that_are_not_read(change: dict[bytes, Any]) -> None:
    with raises(FormatError):
        unpack(msgpack.packb(OF_OTHER_LIBRARIES["msgpack-numpy"] | change))


CLAIMED = st.builds(
    lambda kind, fields: msgpack.packb({kind: True, **fields}),
    st.sampled_from([b"__ndarray__", b"__npgeneric__", "__ndarray__", b"nd"]),
    st.dictionaries(
        st.sampled_from([b"data", b"dtype", b"shape", b"type", "data", "dtype", "shape"]),
        PLAIN | st.just("<f4"),
    ),
)


@given(st.binary(max_size=60) | CLAIMED)
def test_any_bytes_are_a_message_or_a_clear_error(data: bytes) -> None:
    with suppress(FormatError):
        unpack(data)


@given(ANYTHING.map(pack), st.data())
def test_a_message_that_is_cut_or_has_a_tail_is_an_error(data: bytes, draw: st.DataObject) -> None:
    cut = draw.draw(st.integers(0, len(data) - 1))
    for changed in (data[:cut], data + b"\x00"):
        with pytest.raises(FormatError, match="are not a message"):
            unpack(changed)


@pytest.mark.parametrize(
    "value",
    [
        *(np.array([object()]), np.zeros(1, "c8"), np.complex64(1), np.zeros(1, "V3")),
        *(np.zeros(1, "i4,f4"), np.zeros(1, "M8[s]"), {1, 2}, object(), 2**64, "\ud800"),
    ],
)
def test_unsupported_values_are_not_sent(value: Any) -> None:
    with raises(FormatError):
        pack({"a": [value]})


def claimed(kind: str, **fields: Any) -> bytes:
    entries = {"data": b"\x00" * 4, "dtype": "<f4", "shape": [1], **fields}
    return msgpack.packb({kind.encode(): True} | {k.encode(): v for k, v in entries.items()})


@pytest.mark.parametrize(
    "data",
    [
        claimed("__ndarray__", dtype="|O"),
        claimed("__ndarray__", dtype="float99"),
        claimed("__ndarray__", dtype="2<f4"),
        claimed("__ndarray__", data="0000"),
        claimed("__ndarray__", data=b"\x00" * 5),
        claimed("__npgeneric__", data=2**40, dtype="<i4"),
        msgpack.packb({"a": msgpack.ExtType(5, b"")}),
    ],
)
def test_invalid_messages_are_not_read(data: bytes) -> None:
    with raises(FormatError):
        unpack(data)


# --- answers that cost too much -----------------------------------------------------------------

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


@contextmanager
def handling(handle: Callable[[Any], Any], **options: Any) -> Iterator[int]:
    """A websocket server that is no policy server."""
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
    with handling(handle) as port, pytest.raises(PolicyServerError):
        make_policy(f"vla-eval:ws://127.0.0.1:{port}", ("checkpoint=a", "connect_s=2"))
    assert time.monotonic() - began < MAX_S
