"""A machine that is not as it should be: its disk is full, its clock is wrong."""

import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from support.hub_server import HubServer

DAY = 86400.0
WRONG = {"ahead": (DAY, 0.0), "behind": (-DAY, 0.0), "its": (0.0, DAY), "its too": (DAY, -DAY)}
"""Seconds by which this machine's clock is ahead, and the Hub's."""


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


def set_clocks(hub: HubServer, monkeypatch: pytest.MonkeyPatch, own: float, its: float) -> None:
    """Let the clocks of this machine and of the Hub be so many seconds ahead."""
    right = time.time
    monkeypatch.setattr(time, "time", lambda: right() + own)
    hub.clock = its - own  # it runs on this machine
