"""Create a folder atomically, by one process at a time."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from robomme_interference_data.errors import BusyError, InterferenceError

from .files import with_filename

_BEFORE = "before"
"""Name of the replaced folder in a staging folder."""


@contextmanager
def file_lock(lock: Path, busy: InterferenceError) -> Iterator[None]:
    """Hold a lock file until the block or the process ends; raise `busy` if another one holds it.

    The file remains. A folder cannot be locked: network file systems lock only files that are open
    for writing.
    """
    try:
        held = FileLock(lock, timeout=0).acquire()
    except (FileNotFoundError, Timeout):  # its owner ends, and removes the folder
        raise busy from None
    with held:
        yield


def staging_path(out: Path) -> Path:
    """Return the hidden folder next to `out` in which `out` is built."""
    return out.parent / f".{out.name}.building"


@contextmanager
def staging_dir(out: Path) -> Iterator[Path]:
    """Create and lock the staging folder of `out`; `replace_folder` moves the result to `out`.

    If the block succeeds, the staging folder is removed; if it fails, it stays for the next
    attempt, unless nothing in it is finished.
    """
    work = staging_path(out)
    work.mkdir(parents=True, exist_ok=True)
    busy = BusyError(f"another process is building {out}", "Wait for it to end, or stop it.")
    with file_lock(work / "lock", busy):
        before, finished = work / _BEFORE, False
        if before.exists() and not out.exists():  # killed during `replace_folder`
            before.rename(out)
        shutil.rmtree(before, ignore_errors=True)
        try:
            with with_filename(work):
                yield work
            finished = True
        finally:
            # Hidden files are half-written, and of no use to the next attempt.
            if finished or not any(work.glob("*/[!.]*")):
                shutil.rmtree(work, ignore_errors=True)


def replace_folder(made: Path, out: Path) -> None:
    """Move a folder from the staging folder of `out` to `out`, which it replaces.

    If the process is killed in between, the next `staging_dir` restores the old folder.
    """
    before = staging_path(out) / _BEFORE
    if out.exists():
        out.rename(before)
    made.rename(out)
    shutil.rmtree(before, ignore_errors=True)


def copy_folder(source: Path, out: Path) -> None:
    """Copy a folder whose files are never written in place: as hard links, on the same disk."""

    def copy(path: str, to: str) -> None:
        try:
            # Of a link, as in the Hub's cache, the file: its target may be relative.
            os.link(os.path.realpath(path), to)
        except OSError:  # another disk, or one without hard links
            shutil.copyfile(path, to)

    with staging_dir(out) as work:
        made = work / "made"
        shutil.rmtree(made, ignore_errors=True)
        shutil.copytree(source, made, copy_function=copy)
        replace_folder(made, out)
