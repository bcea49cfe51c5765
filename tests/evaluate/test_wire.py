"""The messages of the policy servers: golden bytes, round trips, and what is refused."""

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.policies.wire import pack, unpack

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
    found: dict[str, str] = {}
    name = ""
    for line in GOLDEN.read_text(encoding="utf-8").splitlines():
        text = line.partition("#")[0].strip()
        if header := re.fullmatch(r"\[(.+)\]", text):
            name = header[1]
        elif text:
            found[name] = found.get(name, "") + text
    return {name: bytes.fromhex(text) for name, text in found.items()}


@pytest.mark.parametrize("name", MESSAGES)
def test_golden_bytes(name: str) -> None:
    assert golden().keys() == MESSAGES.keys()
    assert pack(MESSAGES[name]) == golden()[name]
    assert pack(unpack(golden()[name])) == golden()[name]


def test_arrays_travel_in_c_order_and_are_read_as_views() -> None:
    images = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    for array in (images, np.asfortranarray(images), images[::-1], images.transpose(2, 0, 1)):
        read = unpack(pack(array))
        np.testing.assert_array_equal(read, array)
        assert not read.flags.writeable and not read.flags.owndata
    number = unpack(pack(np.float32(0.5)))
    assert (number, number.dtype) == (0.5, np.float32)


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
def test_a_cut_message_is_an_error(data: bytes, draw: st.DataObject) -> None:
    cut = draw.draw(st.integers(0, len(data) - 1))
    with pytest.raises(FormatError, match="are not a message"):
        unpack(data[:cut])
    with pytest.raises(FormatError, match="are not a message"):
        unpack(data + b"\x00")


@pytest.mark.parametrize(
    "value",
    [
        *(np.array([object()]), np.zeros(1, "c8"), np.complex64(1), np.zeros(1, "V3")),
        *(np.zeros(1, "i4,f4"), np.zeros(1, "M8[s]"), {1, 2}, object(), 2**64, "\ud800"),
    ],
)
def test_what_cannot_be_sent(value: Any) -> None:
    with pytest.raises(FormatError, match="cannot"):
        pack({"a": [value]})


def claimed(kind: str, **fields: Any) -> bytes:
    entries = {"data": b"\x00" * 4, "dtype": "<f4", "shape": [1], **fields}
    return msgpack.packb({kind.encode(): True} | {k.encode(): v for k, v in entries.items()})


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "0 bytes are not a message"),
        (b"Traceback", "9 bytes are not a message"),
        (claimed("__ndarray__", dtype="|O"), "dtype object"),
        (claimed("__ndarray__", dtype="float99"), "float99"),
        (claimed("__ndarray__", dtype="2<f4"), "cannot hold NumPy data"),
        (claimed("__ndarray__", data="0000"), "without bytes and shape"),
        (claimed("__ndarray__", data=b"\x00" * 5), "4 bytes with 5 bytes of data"),
        (claimed("__ndarray__", shape=[2]), "are not a message"),
        (claimed("__npgeneric__", data=2**40, dtype="<i4"), "are not a message"),
        (msgpack.packb({"a": msgpack.ExtType(5, b"")}), "extension type 5"),
    ],
)
def test_what_is_not_read(data: bytes, text: str) -> None:
    with pytest.raises(FormatError, match=text):
        unpack(data)
