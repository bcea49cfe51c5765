"""Make a folder whole or not at all: beside its place, by one process at a time."""

import fcntl
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from robomme_interference_data.errors import BuildError, InterferenceError

from .files import with_filename

_BEFORE = "before"
"""Name in a staging folder of what is being replaced."""


@contextmanager
def file_lock(lock: Path, busy: InterferenceError) -> Iterator[None]:
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


def staging_path(out: Path) -> Path:
    """Return the hidden folder beside `out` in which `out` is made."""
    return out.parent / f".{out.name}.building"


@contextmanager
def staging_dir(out: Path) -> Iterator[Path]:
    """Make and lock the folder in which `out` is made, for one process at a time.

    What is made there becomes `out` by `replace_folder`. If the block succeeds, the staging folder
    is removed; if it fails, it stays for the next attempt, unless nothing in it is finished.
    """
    work = staging_path(out)
    work.mkdir(parents=True, exist_ok=True)
    busy = BuildError(f"another process makes {out}", "Wait for it to end, or stop it.")
    with file_lock(work / "lock", busy):
        before, finished = work / _BEFORE, False
        if before.exists() and not out.exists():  # killed while it was replaced
            before.rename(out)
        shutil.rmtree(before, ignore_errors=True)
        try:
            with with_filename(work):
                yield work
            finished = True
        finally:
            if finished or not any(work.glob("*/[!.]*")):
                shutil.rmtree(work, ignore_errors=True)


def replace_folder(made: Path, out: Path) -> None:
    """Let a folder in the staging folder of `out` become `out`, instead of what is there.

    If the process is killed in between, the next `staging_dir` puts the old folder back.
    """
    before = staging_path(out) / _BEFORE
    if out.exists():
        out.rename(before)
    made.rename(out)
    shutil.rmtree(before, ignore_errors=True)
