"""Hold a folder, so that two processes cannot write into it at the same time."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from robomme_interference_data.errors import InterferenceError

__all__ = ["hold"]


@contextmanager
def hold(lock: Path, busy: InterferenceError) -> Iterator[None]:
    """Hold a lock file until the block ends; the lock goes with the process, however it ends.

    Args:
        lock: The file, made if need be and left behind. Not the folder itself: network file
            systems lock only what is open for writing.
        busy: Raised if another process holds it.
    """
    with lock.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise busy from None
        yield
