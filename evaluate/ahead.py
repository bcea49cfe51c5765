"""Make what an iterator yields ahead of its reader, in a thread."""

import threading
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from queue import SimpleQueue

__all__ = ["ahead"]


@contextmanager
def ahead[Item](items: Generator[Item], most: int) -> Iterator[Iterator[Item]]:
    """Start to make items at once, and hold at most `most` that were not taken yet.

    Leaving the block ends the thread and closes `items`, whether all of them were taken or not.

    Args:
        items: What makes them.
        most: Items that may wait, 1 or more.

    Yields:
        The same items in the same order; an error of `items` comes where it occurred.
    """
    ready: SimpleQueue[Item | _Over] = SimpleQueue()
    room = threading.Semaphore(most)
    left = threading.Event()

    def make() -> None:
        error: BaseException | None = None
        try:
            room.acquire()
            for item in items:
                ready.put(item)
                room.acquire()
                if left.is_set():
                    break
        except BaseException as raised:
            error = raised
        finally:
            items.close()
            ready.put(_Over(error))

    def take() -> Iterator[Item]:
        while not isinstance(item := ready.get(), _Over):
            room.release()
            yield item
        if item.error is not None:
            raise item.error

    thread = threading.Thread(target=make, name="ahead", daemon=True)
    thread.start()
    try:
        yield take()
    finally:
        left.set()
        room.release()
        thread.join()


class _Over:
    """What comes after the last item."""

    def __init__(self, error: BaseException | None):
        self.error = error
