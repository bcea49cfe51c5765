"""Hold an output folder while it is made, so that two builds of it cannot disturb each other."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from robomme_interference_data.errors import BuildError

__all__ = ["locked", "work_folder"]


def work_folder(out: Path) -> Path:
    """Return the hidden folder beside `out` in which `out` is made."""
    return out.parent / f".{out.name}.building"


@contextmanager
def locked(out: Path) -> Iterator[Path]:
    """Make the work folder of `out` and hold it; the lock goes with the process.

    Yields:
        The work folder.

    Raises:
        BuildError: Another build of `out` holds it.
    """
    work = work_folder(out)
    work.mkdir(parents=True, exist_ok=True)
    # A file, not the folder itself: network file systems lock only what is open for writing.
    with (work / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise BuildError(
                f"another build of {out} is running", "Wait for it to end, or stop it."
            ) from None
        yield work
