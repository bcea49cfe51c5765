"""A time limit for an exchange over sockets: the limit covers the whole answer."""

import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress


@contextmanager
def shutdown_after(
    seconds: float, sockets: Callable[[], Iterable[socket.socket]]
) -> Iterator[threading.Event]:
    """Shut sockets down if the block takes longer; yield an event that is set in that case.

    Time limits of sockets start anew with each byte, so a server that sends a byte now and then
    would never exceed them. A shutdown ends a pending send as well as a pending receive.
    """
    expired = threading.Event()

    def expire() -> None:
        expired.set()
        for open_socket in sockets():
            with suppress(OSError):  # already closed
                # Not the method of a TLS socket, which another thread may not call.
                socket.socket.shutdown(open_socket, socket.SHUT_RDWR)

    timer = threading.Timer(seconds, expire)
    timer.daemon = True
    timer.start()
    try:
        yield expired
    finally:
        timer.cancel()
