"""One connection to a policy server: connecting with patience, and questions with a time limit."""

import http.client
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidMessage, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from robomme_interference_data.errors import PolicyServerError, ServerKeepaliveError, WireError

from .wire import pack, unpack

logger = logging.getLogger(__name__)

API_KEY_VARIABLE = "ROBOMME_POLICY_API_KEY"
"""Environment variable with the key that servers behind a gate ask for."""

_QUIET_S = 2.0
"""Seconds of waiting after which it is told."""

_PAUSES_S = (0.2, 5.0)
"""The first pause between two attempts, which doubles, and the longest."""

_HEALTH_S = 5.0
"""Most seconds for the answer whether a server can be used: one that computes gives none."""

_CLOSE_S = 2.0
_GUIDE = "docs/systems.md says how to start one."


@contextmanager
def _after(seconds: float, call: Callable[[], object]) -> Iterator[None]:
    """Call something if what is inside takes longer."""
    timer = threading.Timer(seconds, call)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _headers() -> dict[str, str]:
    key = os.environ.get(API_KEY_VARIABLE)
    return {"Authorization": f"Api-Key {key}"} if key else {}


def _is_keepalive(error: Exception) -> bool:
    """Whether a server closed as it saw no answer to its ping: it reads none while it computes."""
    closing = error.rcvd if isinstance(error, ConnectionClosed) else None
    return closing is not None and "keepalive" in closing.reason


class ServerConnection:
    """A connection that is opened, used, and, after any error, gone."""

    def __init__(
        self,
        host: str,
        port: int,
        *,
        connect_s: float,
        response_s: float,
        check: Callable[[], str | None] = lambda: None,
    ):
        self.name = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        self._address = host, port
        self.metadata: dict[str, Any] | None = None
        self._connect_s, self._response_s, self._check = connect_s, response_s, check
        self._connection: ClientConnection | None = None
        self._stack = ExitStack()
        self._sent = b""

    @property
    def is_open(self) -> bool:
        """Whether there is a connection that did not break so far."""
        return self._connection is not None

    def open(self) -> None:
        """Connect anew, again and again while nobody answers."""
        self.close()
        message = (
            f"Waiting until policy server {self.name} answers (http://{self.name}/healthz), for "
            f"{self._connect_s:g} s at most …"
        )
        with _after(_QUIET_S, lambda: logger.warning(message)):
            self._connect()

    def _connect(self) -> None:
        until = time.monotonic() + self._connect_s
        pause, longest = _PAUSES_S
        while True:
            left = max(until - time.monotonic(), pause)
            try:
                self._check_health(min(left, _HEALTH_S))
                self._connection = self._handshake(left)
                break
            except InvalidStatus as error:
                status = error.response.status_code
                reason = f"it answers {status}"
                if status < http.HTTPStatus.INTERNAL_SERVER_ERROR:
                    raise self._refusal(status) from error
            except (OSError, EOFError, InvalidMessage, http.client.HTTPException) as error:
                reason = str(error) or type(error).__name__
                if isinstance(error, TimeoutError):
                    reason = "it does not answer"
                if isinstance(error, socket.gaierror):  # a name that nobody knows stays unknown
                    until = 0.0
            except InvalidHandshake as error:
                raise self._refusal(error) from error
            hint = self._check()
            if time.monotonic() + pause > until:
                raise PolicyServerError(
                    f"policy server {self.name} cannot be reached: {reason}"
                    + (f" (for {self._connect_s:g} s)" if until else ""),
                    hint or f"Start it, or check host and port; {_GUIDE}",
                )
            time.sleep(pause)
            pause = min(2 * pause, longest)
        # The server speaks first.
        self.metadata = self._read(self._exchange(None, max(until - time.monotonic(), pause)))

    def request(self, message: dict[str, Any], expected: str) -> dict[str, Any]:
        """Send a message and return its answer, a map with `expected` in it, and that not false.

        After an error the connection is gone: what the server still remembers is not known.
        """
        # Kept until the next one is packed: given back each time, the memory of messages of
        # megabytes goes back to the system, and getting it anew took as long as all the rest.
        self._sent = pack(message)
        answer = self._read(self._exchange(self._sent, self._response_s))
        found = answer.get(expected)
        if found is None or found is False:
            self.close()
            raise PolicyServerError(
                f"policy server {self.name} answers without {expected!r}: "
                f"{', '.join(map(str, answer)) or 'an empty map'}",
                "Is it an MME-VLA server? docs/systems.md has the order of calls.",
            )
        return answer

    def close(self) -> None:
        """Close the connection, if there is one."""
        self._connection = None
        self._stack.close()

    def _check_health(self, seconds: float) -> None:
        """Raise `OSError` while the server does not answer, or says that it is not ready.

        Any other answer will do, for a server need not know the path.
        """
        asking = http.client.HTTPConnection(*self._address, timeout=seconds)
        try:
            asking.request("GET", "/healthz", headers=_headers())
            status = asking.getresponse().status
        finally:
            asking.close()
        if status >= http.HTTPStatus.INTERNAL_SERVER_ERROR:
            raise OSError(f"it answers {status}")

    def _handshake(self, seconds: float) -> ClientConnection:
        connecting = connect(
            f"ws://{self.name}",
            additional_headers=_headers(),
            open_timeout=seconds,
            close_timeout=_CLOSE_S,
            compression=None,
            max_size=None,
            proxy=None,
            # A server that computes does not answer pings; `response_s` finds the dead ones.
            ping_interval=None,
        )
        return self._stack.enter_context(connecting)

    def _refusal(self, reason: object) -> PolicyServerError:
        if reason in (http.HTTPStatus.UNAUTHORIZED, http.HTTPStatus.FORBIDDEN):
            return PolicyServerError(
                f"policy server {self.name} refuses with {reason}: it asks for another key",
                f"Set {API_KEY_VARIABLE} to its API key.",
            )
        return PolicyServerError(
            f"what listens at {self.name} is no policy server, which speaks websocket: it answers "
            f"{reason}",
            f"Check host and port; {_GUIDE}",
        )

    def _exchange(self, data: bytes | None, seconds: float) -> str | bytes:
        """Send, unless there is nothing to send, and receive. If anything breaks, all is gone."""
        connection = self._connection
        if connection is None:
            raise PolicyServerError(
                f"the connection to policy server {self.name} was lost, and its memory with it",
                "The rollout cannot go on; the next one connects again.",
            )
        expired = threading.Event()

        def expire() -> None:
            expired.set()
            # Ends a send as well as a receive: websockets limits only the latter.
            with suppress(OSError):
                connection.socket.shutdown(socket.SHUT_RDWR)

        try:
            with _after(seconds, expire):
                if data is not None:
                    connection.send(data)
                return connection.recv()
        except (ConnectionClosed, OSError) as error:
            self.close()
            self._check()
            late = f"did not answer within {seconds:.3g} s"
            why = late if expired.is_set() else f"closed the connection: {error}"
            kind = ServerKeepaliveError if _is_keepalive(error) else PolicyServerError
            raise kind(f"policy server {self.name} {why}", "Its log may say why.") from error
        except BaseException:
            # An answer that nobody read would be taken for that of the next message.
            self.close()
            raise

    def _read(self, data: str | bytes) -> dict[str, Any]:
        if isinstance(data, str):
            # A traceback, sent as text; the server closes with 1011 after it.
            lines = [line for line in data.splitlines() if line.strip()] or ["an empty text"]
            what, hint = f" reports: {lines[-1].strip()}", "The traceback is in the server's log."
        else:
            try:
                answer = unpack(data)
                if isinstance(answer, dict):
                    return answer
                what, hint = f" answers with a {type(answer).__name__}, not a map", None
            except WireError as error:
                what, hint = f": {error.message}", None
        self.close()
        raise PolicyServerError(f"policy server {self.name}{what}", hint)
