"""Hold an output folder while it is made, so that two builds of it cannot disturb each other."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from robomme_interference_data.errors import BuildError
from robomme_interference_data.locks import hold

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
    busy = BuildError(f"another build of {out} is running", "Wait for it to end, or stop it.")
    with hold(work / "lock", busy):
        yield work
