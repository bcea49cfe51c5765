"""Keep the current folder off the import path of child processes.

The current folder may be a downloaded buffer set, in which anybody can have placed a
`multiprocessing.py`. Python puts that folder first on the import path of `python -c`, by which
`multiprocessing` starts its children, and of `python -m`, unless `PYTHONSAFEPATH` is set:
https://docs.python.org/3/using/cmdline.html#envvar-PYTHONSAFEPATH
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

SAFE_PATH = "PYTHONSAFEPATH"

_OURS = "robomme-interference"
"""Any value turns it on; this one tells our setting from that of a user."""


def set_safe_path() -> None:
    """Set it for all child processes of this process, unless the user has set it already."""
    os.environ.setdefault(SAFE_PATH, _OURS)


@contextmanager
def safe_path() -> Iterator[None]:
    """Set it for the processes that start in the block, unless it is set already."""
    before = os.environ.get(SAFE_PATH)
    set_safe_path()
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE_PATH]


def user_environment() -> dict[str, str]:
    """Return the environment for a program of the user, without our setting.

    A script needs the folder in which it lies on its import path.
    """
    environment = dict(os.environ)
    if environment.get(SAFE_PATH) == _OURS:
        del environment[SAFE_PATH]
    return environment
