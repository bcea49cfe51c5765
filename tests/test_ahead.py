"""Making the next items of a stream in another thread."""

import threading
import time
from collections.abc import Generator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.evaluate.ahead import read_ahead

BOUND_S = 20.0


class Stream:
    """Counts to a number, and notes how far it came, where, and that it was closed."""

    def __init__(self, stop: int, breaks_at: int | None = None):
        self.made: list[int] = []
        self.threads: set[int] = set()
        self.closed = False
        self._stop, self._breaks_at = stop, breaks_at

    def items(self) -> Generator[int]:
        try:
            for number in range(self._stop):
                if number == self._breaks_at:
                    raise OSError("the disk is gone")
                self.made.append(number)
                self.threads.add(threading.get_ident())
                yield number
        finally:
            self.closed = True


def wait_for(stream: Stream, count: int) -> None:
    until = time.monotonic() + BOUND_S
    while len(stream.made) < count and time.monotonic() < until:
        time.sleep(0.001)


@given(stop=st.integers(0, 12), depth=st.integers(1, 5))
def test_all_items_in_order(stop: int, depth: int) -> None:
    stream = Stream(stop)
    with read_ahead(stream.items(), depth) as items:
        assert list(items) == list(range(stop))
    assert stream.closed


def test_first_items_are_made_before_they_are_asked_for_and_no_more() -> None:
    stream = Stream(10)
    with read_ahead(stream.items(), 3) as items:
        wait_for(stream, 3)
        time.sleep(0.05)  # a fourth one would be made by now
        assert stream.made == [0, 1, 2]
        assert next(items) == 0
        wait_for(stream, 4)
        time.sleep(0.05)
        assert stream.made == [0, 1, 2, 3]
    assert len(stream.threads) == 1 and threading.get_ident() not in stream.threads


@pytest.mark.parametrize("taken", [0, 2])
def test_a_stream_that_is_left_is_closed(taken: int) -> None:
    stream = Stream(100)
    with pytest.raises(KeyboardInterrupt), read_ahead(stream.items(), 2) as items:
        for _ in range(taken):
            next(items)
        raise KeyboardInterrupt
    assert stream.closed and len(stream.made) <= taken + 2
    assert not [one for one in threading.enumerate() if one.name.startswith("read-ahead")]


def test_an_error_comes_where_its_item_would_have_come() -> None:
    stream = Stream(5, breaks_at=2)
    with read_ahead(stream.items(), 4) as items:
        assert [next(items), next(items)] == [0, 1]
        with pytest.raises(OSError, match="the disk is gone"):
            next(items)
    assert stream.closed
