"""Locks on policy servers: one holds one memory, so two runs that drive it spoil each other."""

import logging
import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

from robomme_interference_data.errors import PolicyServerError
from robomme_interference_data.storage.cache import default_cache_folder
from robomme_interference_data.storage.staging import file_lock

logger = logging.getLogger(__name__)

_THIS_MACHINE = ("localhost", "127.0.0.1", "::1", "0.0.0.0")

_PORTS = range(18000, 19000)
"""Where servers listen that workers start."""


@contextmanager
def lock_server(host: str, port: int, holder: str) -> Iterator[None]:
    """Keep other runs from a policy server until the block ends.

    The lock is a file in this user's cache, and goes with the process, however it ends. Where it
    cannot be written, a warning says so, and the run goes on without.
    """
    machine = socket.gethostname() if host in _THIS_MACHINE else host
    folder = default_cache_folder().parent / "servers"
    lock = folder / f"{machine.replace(':', '_')}_{port}.lock"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.touch()
        other = lock.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        logger.warning(
            "Nothing keeps other runs from the policy server %s:%s: %s", host, port, error
        )
        yield
        return
    busy = PolicyServerError(
        f"the policy server {host}:{port} is driven by {other or 'another run'}; two runs "
        "spoil each other, as a server holds one memory",
        "Wait for that run to end, or start another server, on another port.",
    )
    with file_lock(lock, busy):
        with suppress(OSError):  # such as a full disk: the lock holds all the same
            lock.write_text(f"{holder} (process {os.getpid()})", "utf-8")
        yield


@contextmanager
def reserve_port() -> Iterator[int]:
    """Choose a free port for a server on this machine, and keep it until the block ends.

    A server listens only when its model is loaded. Were the port just free until then, two that
    load at once might get the same, and one of them both rollouts. So its number is also the name
    of an abstract socket (Linux), which every user and container that could listen there sees, and
    which goes with the process.
    """
    with ExitStack() as stack:
        for port in _PORTS:
            name = stack.enter_context(socket.socket(socket.AF_UNIX))
            with suppress(OSError), socket.socket() as free:
                free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do
                free.bind(("", port))
                name.bind(f"\0robomme-interference-{port}")
                break
        else:
            raise PolicyServerError(f"no port from {_PORTS[0]} to {_PORTS[-1]} is free here")
        yield port
