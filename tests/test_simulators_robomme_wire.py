"""The messages between RoboMME's interpreter and this package."""

import socket
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from robomme_interference_data.simulators import robomme_worker


def exchange(
    head: dict[str, object], arrays: dict[str, object]
) -> tuple[dict[str, object], dict[str, np.ndarray]]:
    ours, theirs = socket.socketpair()
    theirs.settimeout(60)
    with ours, theirs:
        # In a thread: what a socket holds without a reader is little.
        sender = threading.Thread(target=robomme_worker.send, args=(ours, head, arrays))
        sender.start()
        received = robomme_worker.receive(theirs)
        sender.join()
    return received


ARRAYS = npst.arrays(
    st.sampled_from([np.uint8, np.float32, np.float64, np.int64, np.bool_]),
    npst.array_shapes(max_dims=4, max_side=5),
)


@given(st.dictionaries(st.text(max_size=5), ARRAYS, max_size=3), st.text())
def test_messages_arrive_as_they_were_sent(arrays: dict[str, np.ndarray], text: str) -> None:
    head, found = exchange({"text": text}, dict(arrays))
    assert head == {"text": text}
    assert list(found) == list(arrays)
    for name, array in arrays.items():
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
        assert found[name].tobytes() == array.tobytes()


def test_lists_arrive_as_one_array() -> None:
    _, found = exchange({}, {"a": [np.full((2, 3), 1, np.uint8), np.full((2, 3), 2, np.uint8)]})
    assert found["a"].tolist() == [[[1] * 3] * 2, [[2] * 3] * 2]


def test_the_bytes_of_a_message() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        robomme_worker.send(ours, {"n": 1}, {"a": np.array([[1, 258]], "<u2")})
        head = b'{"n": 1, "arrays": [["a", "<u2", [1, 2]]]}'
        assert theirs.recv(1000) == b"\0\0\0" + bytes([len(head)]) + head + b"\1\0\2\1"


def test_lists_of_unlike_arrays_are_refused() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs, pytest.raises(ValueError, match="arrays of one shape and type"):
        robomme_worker.send(ours, {}, {"a": [np.zeros(2), np.zeros(3)]})


@pytest.mark.parametrize(
    ("sent", "error"),
    [(b"", EOFError), (b"\0\0\0\5{", EOFError), (b"\xff\0\0\0{}", ValueError)],
)
def test_what_is_no_message(sent: bytes, error: type[Exception]) -> None:
    ours, theirs = socket.socketpair()
    with theirs:
        with ours:
            ours.sendall(sent)
        with pytest.raises(error):
            robomme_worker.receive(theirs)
