"""The websocket adapter: its messages as bytes, and the calls that a server receives."""

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from support.messages import raises
from support.policy_calls import INFER, RESET, added, client, info, observation, rollout, section
from support.policy_server import PolicyServer

from robomme_interference_data.errors import FormatError, PolicyServerError
from robomme_interference_data.evaluate.policies.wire import pack, unpack
from robomme_interference_data.evaluate.run.identity import plain

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


CLAIMED = st.builds(
    lambda kind, fields: msgpack.packb({kind: True, **fields}),
    st.sampled_from([b"__ndarray__", b"__npgeneric__"]),
    st.dictionaries(st.sampled_from([b"data", b"dtype", b"shape"]), PLAIN | st.just("<f4")),
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
