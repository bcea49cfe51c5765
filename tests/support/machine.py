"""A machine that is not as it should be: its disk is full."""

import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def full_disk(left: int = 0) -> Iterator[None]:
    """Let the system refuse to make any file longer than so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # Bytecode that is cut short would break every later import of its module.
    writes_bytecode, sys.dont_write_bytecode = not sys.dont_write_bytecode, True
    resource.setrlimit(resource.RLIMIT_FSIZE, (left, hard))
    try:
        yield
    finally:
        sys.dont_write_bytecode = not writes_bytecode
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
