"""How workers find the policies that they share, on this machine or on a cluster.

The driver has a `Directory`. A policy's process listens on a port of its own and reports it there;
workers ask there. Both sides of every connection prove that they know the run's secret key.
"""

import logging
import os
import secrets
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client, Connection, answer_challenge, deliver_challenge
from threading import Thread

logger = logging.getLogger(__name__)

Place = tuple[str, int]
"""Host and port."""

_KEY_BYTES = 32
_PAUSE_S = 0.1
"""Seconds between questions for a process that does not listen yet."""

_PROOF_S = 10
"""Seconds in which the other side of a connection must prove that it knows the key."""


@dataclass(frozen=True)
class Address:
    """The address of a policy's process, which stays the same when it is started again."""

    directory: Place
    key: bytes = field(repr=False)
    number: int

    def connect(self) -> Connection:
        """Connect to the process; wait until it listens.

        Raises:
            OSError: The run is over, or the process's machine cannot be reached.
        """
        while True:
            with closing(_connect(self.directory, self.key)) as asked:
                asked.send((self.number, None))
                place: Place | None = asked.recv()
            if place is not None:
                # Refused or closed: it died, and the directory will know the next one's place.
                with suppress(ConnectionError, EOFError, AuthenticationError):
                    return _connect(place, self.key)
            time.sleep(_PAUSE_S)

    @contextmanager
    def listen(self) -> Iterator[tuple[socket.socket, Connection]]:
        """Listen in the block as the process itself; yield the listener, and the end of the run.

        The end is a connection from which something can be read, its end, when the run is over.
        """
        with closing(_connect(self.directory, self.key)) as end:
            with _socket_of(end) as same:
                host = same.getsockname()[0]  # the side that others can reach
            with socket.create_server((host, 0)) as listener:
                end.send((self.number, listener.getsockname()))
                yield listener, end


class Directory(Thread):
    """Knows where the policies' processes listen, until `close`.

    Args:
        host: An address of this machine that all others can reach.
    """

    def __init__(self, host: str):
        super().__init__(daemon=True)
        self._listener = socket.create_server((host, 0))
        self._key = secrets.token_bytes(_KEY_BYTES)
        self.start()

    def address(self, number: int) -> Address:
        """Return the address of the process with a number."""
        return Address(self._listener.getsockname(), self._key, number)

    def run(self) -> None:
        """Answer questions."""
        places: dict[int, Place] = {}
        with ExitStack() as processes:
            while True:
                try:
                    connection = accept(self._listener, self._key)
                except OSError:
                    return  # closed
                if connection is None:
                    continue
                with suppress(EOFError, OSError):
                    number, place = connection.recv()
                    if place is None:
                        connection.send(places.get(number))
                    else:
                        if number in places:
                            logger.warning("The policy's process %d was started again", number)
                        places[number] = place
                        processes.enter_context(connection)
                        continue
                connection.close()

    def close(self) -> None:
        """End all processes that listen; whoever waits for one gets an error."""
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # wakes the thread
        self.join()
        self._listener.close()


def accept(listener: socket.socket, key: bytes) -> Connection | None:
    """Accept a connection; None if its other side does not know the key.

    Raises:
        OSError: The listener is closed.
    """
    accepted = listener.accept()[0]
    _tune(accepted, _PROOF_S)
    connection = Connection(accepted.detach())
    try:
        deliver_challenge(connection, key)
        answer_challenge(connection, key)
    except (AuthenticationError, EOFError, OSError):
        connection.close()
        return None
    with _socket_of(connection) as same:
        _tune(same, 0)
    return connection


def _connect(place: Place, key: bytes) -> Connection:
    """Connect to a listener.

    Raises:
        AuthenticationError: It does not know the key.
        EOFError: It closed the connection.
        OSError: It cannot be reached.
    """
    connection = Client(place, authkey=key)
    with _socket_of(connection) as same:
        _tune(same, 0)
    return connection


def _socket_of(connection: Connection) -> socket.socket:
    return socket.socket(fileno=os.dup(connection.fileno()))


def _tune(one: socket.socket, seconds: int) -> None:
    """Send short messages at once, and limit the seconds to wait for one (0: no limit)."""
    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", seconds, 0))
