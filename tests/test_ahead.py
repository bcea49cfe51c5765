"""Items made ahead of their reader: the same items, no more than allowed, no thread left behind."""

import threading
import time
from collections.abc import Generator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robomme_interference_data.evaluate.ahead import ahead


class Source:
    """Counts what was made of it, and whether it was closed."""

    def __init__(self, count: int, fails: bool = False):
        self.count, self.fails = count, fails
        self.made = 0
        self.closed = False

    def items(self) -> Generator[int]:
        try:
            for number in range(self.count):
                self.made += 1
                yield number
            if self.fails:
                raise ValueError("the source broke")
        finally:
            self.closed = True


def threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "ahead"]


@given(count=st.integers(0, 20), most=st.integers(1, 5), taken=st.integers(0, 25))
@settings(deadline=None)
def test_the_same_items_in_order_and_no_more(count: int, most: int, taken: int) -> None:
    source = Source(count)
    with ahead(source.items(), most) as items:
        got = [item for item, _ in zip(items, range(taken), strict=False)]
        assert got == list(range(min(count, taken)))
    # `zip` takes one more than it gives, and one is being made for each that was taken.
    assert source.made <= min(count, taken + 1 + most)
    assert source.closed or not source.made
    assert not threads()


def test_items_are_made_before_they_are_asked_for() -> None:
    source = Source(10)
    with ahead(source.items(), 3) as items:
        limit = time.monotonic() + 20
        while source.made < 3 and time.monotonic() < limit:
            time.sleep(0.01)
        assert source.made == 3
        assert next(items) == 0
    assert source.made <= 4


def test_an_error_comes_after_the_items_before_it() -> None:
    source = Source(2, fails=True)
    with ahead(source.items(), 5) as items:
        assert (next(items), next(items)) == (0, 1)
        with pytest.raises(ValueError, match="the source broke"):
            next(items)
    assert source.closed
    assert not threads()


def test_an_error_of_the_reader_ends_the_thread() -> None:
    source = Source(10)
    with pytest.raises(KeyboardInterrupt), ahead(source.items(), 2) as items:
        next(items)
        raise KeyboardInterrupt
    assert source.closed
    assert not threads()
