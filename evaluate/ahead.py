"""Make the next items of a stream in another thread, while the simulator or the policy works."""

from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

__all__ = ["read_ahead"]


@contextmanager
def read_ahead[T](items: Generator[T], depth: int) -> Iterator[Iterator[T]]:
    """Make the first items of a stream at once, and the next ones while the others are used.

    Args:
        items: The stream; it is closed at the end, read to its end or not. No item is None.
        depth: Items that are made ahead at most, 1 or more: so many wait in memory.

    Returns:
        A context manager; what it gives yields the items in order. An error in making one is
        raised where that item would have come.
    """
    pool = ThreadPoolExecutor(1, "read-ahead")  # one thread: a stream is made in its order
    made = deque(pool.submit(next, items, None) for _ in range(depth))

    def given() -> Iterator[T]:
        while (item := made.popleft().result()) is not None:
            made.append(pool.submit(next, items, None))
            yield item

    try:
        yield given()
    finally:
        pool.shutdown(cancel_futures=True)
        items.close()
