"""One connection to a policy server: connects with retries, and limits the time of each answer."""

import http.client
import logging
import os
import socket
import ssl
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from typing import Any

from websockets.exceptions import (
    ConnectionClosed,
    InvalidHandshake,
    InvalidMessage,
    InvalidStatus,
    InvalidURI,
)
from websockets.sync.client import ClientConnection, connect

from robomme_interference_data.errors import (
    FormatError,
    InvalidOptionError,
    PolicyServerError,
    ServerKeepaliveError,
)
from robomme_interference_data.evaluate.deadline import shutdown_after
from robomme_interference_data.retry import growing, retry

from .wire import pack, unpack

logger = logging.getLogger(__name__)

API_KEY_VARIABLE = "ROBOMME_POLICY_API_KEY"
"""Environment variable with the API key of servers that require one."""

MAX_BYTES = 16 << 20
"""Maximum bytes of an answer; a usual one has a few thousand."""

_MAX_FRAGMENTS = 1 << 12
"""Maximum fragments of an answer: an empty one has no bytes to count, but takes memory."""

_QUIET_S = 2.0
"""Seconds of waiting before a log message; also the time limit of the first attempt."""

_ATTEMPT_S = 10.0
"""Maximum seconds of a further attempt to connect."""

_PAUSES_S = (0.2, 5.0)
"""The first pause between two attempts, which doubles, and the longest."""


class _NoAnswerError(Exception):
    """A server that does not answer yet; the message is the reason."""


def _is_keepalive(error: Exception) -> bool:
    """Whether a server closed because its ping had no answer: it reads none while it computes."""
    closing = error.rcvd if isinstance(error, ConnectionClosed) else None
    return closing is not None and "keepalive" in closing.reason


def check_server_options(checkpoint: str | None, **positive: float) -> None:
    """Check options of a policy that is a server: a checkpoint has a name, numbers are above 0."""
    if checkpoint is not None and not checkpoint.strip():
        raise InvalidOptionError.expected("checkpoint", checkpoint, "its name")
    if not min(positive.values()) > 0:
        shown = ", ".join(f"{name} {value}" for name, value in positive.items())
        raise InvalidOptionError(f"{shown}; expected positive numbers")


class ServerConnection(ABC):
    """A connection that is closed after any error, because the server's memory is then unknown.

    A subclass has the messages of one protocol.

    Args:
        host: Name or address of the server.
        port: Its port.
        tls: Whether to connect with TLS, as `wss://`; the certificate is verified.
        connect_s: Maximum seconds to wait until it accepts a connection.
        response_s: Maximum seconds from a message to the end of its answer.
        check: Called when no answer came: raises if the reason is known, else returns a hint or
            None.

    Attributes:
        name: `host:port`, or `wss://host:port`.
        metadata: What the server reported at the last connection; None before.
        guide: The page of the documentation about such servers.
    """

    guide: str

    def __init__(
        self,
        host: str,
        port: int,
        *,
        tls: bool = False,
        connect_s: float,
        response_s: float,
        check: Callable[[], str | None] = lambda: None,
    ):
        place = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        self.name = f"wss://{place}" if tls else place
        self._url = self.name if tls else f"ws://{place}"
        self.metadata: dict[str, Any] | None = None
        self._connect_s, self._response_s, self._check = connect_s, response_s, check
        self._connection: ClientConnection | None = None
        self._stack = ExitStack()

    @property
    def is_open(self) -> bool:
        """Whether a connection is open and did not break so far."""
        return self._connection is not None

    def open(self) -> None:
        """Connect anew; retry while the server does not answer, or answers 5xx.

        A server that was started again must report the same as before.
        """
        self.close()
        began, warned, hint, left = time.monotonic(), False, None, self._connect_s

        def handshake() -> ClientConnection:
            nonlocal left
            left = max(self._connect_s - (time.monotonic() - began), _PAUSES_S[0])
            return self._handshake(min(left, _ATTEMPT_S if warned else _QUIET_S))

        def may_answer(error: Exception) -> bool:
            nonlocal warned, hint
            if not isinstance(error, _NoAnswerError):
                return False
            hint = self._check()
            if time.monotonic() - began >= _QUIET_S and not warned:
                warned = True
                logger.warning(
                    "Waiting until policy server %s answers, for %g s at most: %s",
                    self.name,
                    self._connect_s,
                    error,
                )
            return True

        def pauses() -> Iterator[float]:
            for pause in growing(*_PAUSES_S):
                if time.monotonic() - began + pause > self._connect_s:
                    return
                yield pause

        try:
            self._connection = retry(handshake, may_answer, pauses())
        except _NoAnswerError as error:
            reason = f"{error} (for {self._connect_s:g} s)"
            raise self._unreachable(reason, hint) from error.__cause__
        reported = self._greet(left)
        if self.metadata is not None and pack(reported) != pack(self.metadata):
            self.close()
            raise PolicyServerError.changed(self.name, reported, self.metadata)
        self.metadata = reported

    @abstractmethod
    def _greet(self, seconds: float) -> dict[str, Any]:
        """Return what the server reports of itself on a new connection, within a time limit."""

    def close(self) -> None:
        """Close the connection, if one is open."""
        self._connection = None
        self._stack.close()

    def _handshake(self, seconds: float) -> ClientConnection:
        key = os.environ.get(API_KEY_VARIABLE)
        try:
            connection = connect(
                self._url,
                additional_headers={"Authorization": f"Api-Key {key}"} if key else {},
                open_timeout=seconds,
                close_timeout=2.0,
                compression=None,
                max_size=MAX_BYTES,
                proxy=None,
                # A server that computes does not answer pings; `response_s` finds the dead ones.
                ping_interval=None,
            )
            return self._stack.enter_context(connection)
        except InvalidStatus as error:
            status = error.response.status_code
            if status < http.HTTPStatus.INTERNAL_SERVER_ERROR:
                raise self._refusal(status) from error
            raise _NoAnswerError(f"it answers {status}") from error
        except ssl.SSLCertVerificationError as error:
            raise PolicyServerError(
                f"policy server {self.name} has a certificate that this machine does not trust: "
                f"{error.verify_message}",
                "Use the host name of its certificate. For a certificate of your own, set "
                "SSL_CERT_FILE to a PEM file with it, or with that of its issuer.",
            ) from error
        except (OSError, EOFError, InvalidMessage) as error:
            # A server that closes the connection may be starting; one that speaks no TLS is not.
            if isinstance(error, ssl.SSLError) and not isinstance(error, ssl.SSLEOFError):
                raise PolicyServerError(
                    f"policy server {self.name} does not speak TLS: {error.reason}",
                    "Check host and port; without TLS its address has no wss.",
                ) from error
            reason = str(error) or type(error).__name__
            if isinstance(error, socket.gaierror):  # an unknown host name stays unknown
                raise self._unreachable(reason) from error
            if isinstance(error, TimeoutError):
                reason = "it does not answer"
            raise _NoAnswerError(reason) from error
        except (InvalidHandshake, InvalidURI, ValueError) as error:
            # Of a redirect, its address may be none of a websocket, or none at all.
            raise self._refusal(error) from error

    def _unreachable(self, reason: str, hint: str | None = None) -> PolicyServerError:
        return PolicyServerError(
            f"policy server {self.name} cannot be reached: {reason}",
            hint or f"Start it, or check its address; {self.guide} describes how to start one.",
        )

    def _refusal(self, reason: object) -> PolicyServerError:
        if reason in (http.HTTPStatus.UNAUTHORIZED, http.HTTPStatus.FORBIDDEN):
            return PolicyServerError(
                f"policy server {self.name} answers {reason}: it requires another API key",
                f"Set {API_KEY_VARIABLE} to its API key.",
            )
        return PolicyServerError(
            f"{self.name} is no policy server: expected a websocket, but it answers {reason}",
            f"Check host and port; {self.guide} describes how to start one.",
        )

    def _failed(self, what: str, hint: str | None) -> PolicyServerError:
        """Close the connection; return the error of an answer that cannot be used."""
        self.close()
        return PolicyServerError(f"policy server {self.name} {what}", hint)

    def _exchange[Answer](
        self, messages: Iterable[bytes], seconds: float, read: Callable[[str | bytes], Answer]
    ) -> Answer:
        """Send messages, receive one and read it; close the connection if this fails.

        Reading counts into the time limit.
        """
        connection = self._connection
        if connection is None:
            raise PolicyServerError(
                f"the connection to policy server {self.name} was lost, and its memory with it",
                "This rollout ends; the next one connects again.",
            )
        try:
            with shutdown_after(seconds, lambda: [connection.socket]) as expired:
                for message in messages:
                    connection.send(message)
                answer = read(self._receive(connection))
            if expired.is_set():
                raise TimeoutError
            return answer
        except PolicyServerError:  # of an answer that came: the connection is closed
            raise
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

    def _receive(self, connection: ClientConnection) -> str | bytes:
        fragments: list[Any] = []
        for fragment in connection.recv_streaming():
            fragments.append(fragment)
            if len(fragments) > _MAX_FRAGMENTS:
                raise self._failed(f"sends a message of over {_MAX_FRAGMENTS:,} fragments", None)
        joined: str | bytes = type(fragments[0])().join(fragments)
        return joined


class OpenpiConnection(ServerConnection):
    """A connection to a server of openpi, as MME-VLA extends it: `wire.py` has its messages."""

    guide = "docs/how-to/connect-a-policy.md"
    _sent = b""

    def _greet(self, seconds: float) -> dict[str, Any]:
        return self._exchange([], seconds, self._read)  # the server speaks first

    def request(self, message: dict[str, Any], expected: str) -> dict[str, Any]:
        """Send a message; return its answer, a map with a value of `expected` that is not false."""
        # Kept until the next one is packed: freeing messages of megabytes each time returns their
        # memory to the system, and allocating it again took as long as everything else together.
        self._sent = pack(message)
        answer = self._exchange([self._sent], self._response_s, self._read)
        value = answer.get(expected)
        if value is None or value is False:
            raise self._failed(
                f"answers without {expected!r}: {', '.join(map(str, answer)) or 'an empty map'}",
                f"Is it an MME-VLA server? {self.guide} has the order of calls.",
            )
        return answer

    def _read(self, data: str | bytes) -> dict[str, Any]:
        if isinstance(data, str):
            # A traceback, sent as text; the server closes with 1011 after it.
            lines = [line for line in data.splitlines() if line.strip()] or ["an empty text"]
            hint = "See the server's log for the traceback."
            raise self._failed(f"reports: {lines[-1].strip()}", hint)
        try:
            answer = unpack(data)
        except FormatError as error:
            raise self._failed(f"sends no message: {error.message}", None) from error
        if not isinstance(answer, dict):
            raise self._failed(f"answers with a {type(answer).__name__}; expected a map", None)
        return answer
