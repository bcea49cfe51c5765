"""Locks on policy servers: a server holds one memory, so two runs would spoil each other."""

import logging
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

from robomme_interference_data.errors import PolicyServerError
from robomme_interference_data.storage.cache import cache_folder
from robomme_interference_data.storage.staging import file_lock

logger = logging.getLogger(__name__)

_THIS_MACHINE = ("localhost", "127.0.0.1", "::1", "0.0.0.0")

_PORTS = range(18000, 19000)
"""Ports of servers that workers start."""


@contextmanager
def lock_server(host: str, port: int, holder: str) -> Iterator[None]:
    """Keep other runs from a policy server in the block; `holder` is for their error message.

    The lock is a file in this user's cache that the kernel releases with the process. If it cannot
    be written, the run continues with a warning.
    """
    machine = socket.gethostname() if host in _THIS_MACHINE else host
    folder = cache_folder("servers")
    lock = folder / f"{machine.replace(':', '_')}_{port}.lock"
    about = lock.with_suffix(".holder")  # Windows lets nobody else read a locked file
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.touch()
        about.touch()
        other_run = about.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        logger.warning(
            "Nothing keeps other runs from the policy server %s:%s: %s", host, port, error
        )
        yield
        return
    busy = PolicyServerError(
        f"the policy server {host}:{port} is driven by {other_run or 'another run'}; two runs "
        "spoil each other, as a server holds one memory",
        "Wait for that run to end, or start another server, on another port.",
    )
    with file_lock(lock, busy):
        with suppress(OSError):  # such as a full disk: the lock holds all the same
            about.write_text(f"{holder} (process {os.getpid()})", "utf-8")
        yield


@contextmanager
def reserve_port() -> Iterator[int]:
    """Choose a free port on this machine, and keep other workers from it in the block.

    A server listens only after its model is loaded. Two servers that load at once could choose the
    same port, and one of them would get both rollouts. So the reservation is an abstract socket
    (Linux) with the port in its name, which all users and containers that share the port see.
    """
    if sys.platform != "linux":
        raise PolicyServerError(
            "workers start policy servers on Linux only",
            "Start the server yourself, and give its address: websocket://HOST:PORT",
        )
    with ExitStack() as stack:
        for port in _PORTS:
            name = stack.enter_context(socket.socket(socket.AF_UNIX))
            with suppress(OSError), socket.socket() as free:
                free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do
                free.bind(("", port))
                name.bind(f"\0robomme-interference-{port}")
                break
        else:
            raise PolicyServerError(
                f"all ports from {_PORTS[0]} to {_PORTS[-1]} are in use on this machine",
                "End other policy servers.",
            )
        yield port
