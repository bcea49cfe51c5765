"""One connection to a policy server: connects with retries, and limits the time of each answer."""

import http.client
import logging
import os
import socket
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidMessage, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from robomme_interference_data.errors import FormatError, PolicyServerError, ServerKeepaliveError
from robomme_interference_data.evaluate.deadline import shutdown_after

from .wire import pack, unpack

logger = logging.getLogger(__name__)

API_KEY_VARIABLE = "ROBOMME_POLICY_API_KEY"
"""Environment variable with the API key of servers that require one."""

MAX_BYTES = 64 << 20
"""Maximum bytes of an answer; a usual one has a few thousand."""

_QUIET_S = 2.0
"""Seconds of waiting before a log message; also the time limit of the first attempt."""

_ATTEMPT_S = 10.0
"""Maximum seconds of a further attempt to connect."""

_PAUSES_S = (0.2, 5.0)
"""The first pause between two attempts, which doubles, and the longest."""

_GUIDE = "docs/how-to/policy-server.md describes how to start one."


def _is_keepalive(error: Exception) -> bool:
    """Whether a server closed because its ping had no answer: it reads none while it computes."""
    closing = error.rcvd if isinstance(error, ConnectionClosed) else None
    return closing is not None and "keepalive" in closing.reason


class ServerConnection:
    """A connection that is closed after any error, because the server's memory is then unknown.

    Args:
        host: Name or address of the server.
        port: Its port.
        connect_s: Maximum seconds to wait until it accepts a connection.
        response_s: Maximum seconds from a message to the end of its answer.
        check: Called when no answer came: raises if the reason is known, else returns a hint or
            None.

    Attributes:
        name: `host:port`.
        metadata: What the server reported at the last connection; None before.
    """

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
        self.metadata: dict[str, Any] | None = None
        self._connect_s, self._response_s, self._check = connect_s, response_s, check
        self._connection: ClientConnection | None = None
        self._stack = ExitStack()
        self._sent = b""

    @property
    def is_open(self) -> bool:
        """Whether a connection is open and did not break so far."""
        return self._connection is not None

    def open(self) -> None:
        """Connect anew; retry while the server does not answer, or answers 5xx."""
        self.close()
        began, warned = time.monotonic(), False
        pause, longest = _PAUSES_S
        while True:
            left = max(self._connect_s - (time.monotonic() - began), pause)
            try:
                self._connection = self._handshake(min(left, _ATTEMPT_S if warned else _QUIET_S))
                break
            except InvalidStatus as error:
                status = error.response.status_code
                reason = f"it answers {status}"
                if status < http.HTTPStatus.INTERNAL_SERVER_ERROR:
                    raise self._refusal(status) from error
            except (OSError, EOFError, InvalidMessage) as error:
                reason = str(error) or type(error).__name__
                if isinstance(error, TimeoutError):
                    reason = "it does not answer"
                if isinstance(error, socket.gaierror):  # an unknown host name stays unknown
                    raise self._unreachable(reason) from error
            except InvalidHandshake as error:
                raise self._refusal(error) from error
            hint = self._check()
            waited = time.monotonic() - began
            if waited + pause > self._connect_s:
                raise self._unreachable(f"{reason} (for {self._connect_s:g} s)", hint)
            if waited >= _QUIET_S and not warned:
                warned = True
                logger.warning(
                    "Waiting until policy server %s answers, for %g s at most: %s",
                    *(self.name, self._connect_s, reason),
                )
            time.sleep(pause)
            pause = min(2 * pause, longest)
        # The server speaks first.
        self.metadata = self._read(self._exchange(None, left))

    def request(self, message: dict[str, Any], expected: str) -> dict[str, Any]:
        """Send a message; return its answer, a map with a value of `expected` that is not false."""
        # Kept until the next one is packed: freeing messages of megabytes each time returns their
        # memory to the system, and allocating it again took as long as everything else together.
        self._sent = pack(message)
        answer = self._read(self._exchange(self._sent, self._response_s))
        value = answer.get(expected)
        if value is None or value is False:
            self.close()
            raise PolicyServerError(
                f"policy server {self.name} answers without {expected!r}: "
                f"{', '.join(map(str, answer)) or 'an empty map'}",
                "Is it an MME-VLA server? docs/how-to/policy-server.md has the order of calls.",
            )
        return answer

    def close(self) -> None:
        """Close the connection, if one is open."""
        self._connection = None
        self._stack.close()

    def _handshake(self, seconds: float) -> ClientConnection:
        key = os.environ.get(API_KEY_VARIABLE)
        connecting = connect(
            f"ws://{self.name}",
            additional_headers={"Authorization": f"Api-Key {key}"} if key else {},
            open_timeout=seconds,
            close_timeout=2.0,
            compression=None,
            max_size=MAX_BYTES,
            proxy=None,
            # A server that computes does not answer pings; `response_s` finds the dead ones.
            ping_interval=None,
        )
        return self._stack.enter_context(connecting)

    def _unreachable(self, reason: str, hint: str | None = None) -> PolicyServerError:
        return PolicyServerError(
            f"policy server {self.name} cannot be reached: {reason}",
            hint or f"Start it, or check host and port; {_GUIDE}",
        )

    def _refusal(self, reason: object) -> PolicyServerError:
        if reason in (http.HTTPStatus.UNAUTHORIZED, http.HTTPStatus.FORBIDDEN):
            return PolicyServerError(
                f"policy server {self.name} answers {reason}: it requires another API key",
                f"Set {API_KEY_VARIABLE} to its API key.",
            )
        return PolicyServerError(
            f"{self.name} is no policy server: expected a websocket, but it answers {reason}",
            f"Check host and port; {_GUIDE}",
        )

    def _exchange(self, data: bytes | None, seconds: float) -> str | bytes:
        """Send data, if given, and receive one message; close the connection if this fails."""
        connection = self._connection
        if connection is None:
            raise PolicyServerError(
                f"the connection to policy server {self.name} was lost, and its memory with it",
                "This rollout ends; the next one connects again.",
            )
        try:
            with shutdown_after(seconds, lambda: [connection.socket]) as expired:
                if data is not None:
                    connection.send(data)
                return connection.recv()
        except (ConnectionClosed, OSError) as error:
            self.close()
            self._check()
            late = f"did not answer within {seconds:.3g} s"
            reason = late if expired.is_set() else f"closed the connection: {error}"
            kind = ServerKeepaliveError if _is_keepalive(error) else PolicyServerError
            raise kind(f"policy server {self.name} {reason}", "See the server's log.") from error
        except BaseException:
            # An unread answer would be taken for that of the next message.
            self.close()
            raise

    def _read(self, data: str | bytes) -> dict[str, Any]:
        if isinstance(data, str):
            # A traceback, sent as text; the server closes with 1011 after it.
            lines = [line for line in data.splitlines() if line.strip()] or ["an empty text"]
            what, hint = f" reports: {lines[-1].strip()}", "See the server's log for the traceback."
        else:
            try:
                answer = unpack(data)
                if isinstance(answer, dict):
                    return answer
                what, hint = f" answers with a {type(answer).__name__}; expected a map", None
            except FormatError as error:
                what, hint = f": {error.message}", None
        self.close()
        raise PolicyServerError(f"policy server {self.name}{what}", hint)
