"""One connection to a policy server: connecting with patience, and questions with a time limit."""

import http.client
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidMessage, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from robomme_interference_data.errors import PolicyServerError
from robomme_interference_data.evaluate.policies.wire import pack, unpack

__all__ = ["API_KEY_VARIABLE", "ServerConnection"]

API_KEY_VARIABLE = "ROBOMME_POLICY_API_KEY"
"""Environment variable with the key that servers behind a gate ask for."""

_LONGEST_WAIT_S = 30.0
_CLOSE_S = 2.0
_GUIDE = "docs/systems.md says how to start one."


class ServerConnection:
    """A connection that is opened, used, and, after any error, gone.

    Args:
        host: Name or address of the server.
        port: Its port.
        connect_s: Most seconds that one attempt to connect may take.
        response_s: Most seconds from a message to its answer.
        attempts: How often a connection is tried.
        backoff_s: Seconds between the first two attempts; they double up to 30.

    Attributes:
        name: `host:port`.
        metadata: What the server said of itself when it was last connected; None before.
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        connect_s: float,
        response_s: float,
        attempts: int,
        backoff_s: float,
    ):
        self.name = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        self.metadata: dict[str, Any] | None = None
        self._host, self._port = host, port
        self._connect_s, self._response_s = connect_s, response_s
        self._attempts, self._backoff_s = attempts, backoff_s
        self._connection: ClientConnection | None = None
        self._stack = ExitStack()
        self._sent = b""

    @property
    def is_open(self) -> bool:
        """Whether there is a connection that did not break so far."""
        return self._connection is not None

    def open(self) -> None:
        """Connect anew, trying several times while nobody listens.

        Raises:
            PolicyServerError: The server cannot be reached, refuses, or is no policy server.
        """
        self.close()
        for attempt in range(self._attempts):
            try:
                self._check_health()
                self._connection = self._handshake()
                break
            except PolicyServerError:
                raise
            except (OSError, EOFError, InvalidMessage, http.client.HTTPException) as error:
                reason = str(error) or type(error).__name__
                # A name that nobody knows stays unknown.
                if attempt + 1 == self._attempts or isinstance(error, socket.gaierror):
                    raise PolicyServerError(
                        f"policy server {self.name} cannot be reached: {reason} "
                        f"(attempts: {attempt + 1})",
                        f"Start it, or check host and port; {_GUIDE}",
                    ) from error
                time.sleep(min(self._backoff_s * 2**attempt, _LONGEST_WAIT_S))
            except InvalidStatus as error:
                raise self._refusal(error.response.status_code) from error
            except InvalidHandshake as error:
                raise PolicyServerError(
                    f"what listens at {self.name} does not speak websocket: {error}", _GUIDE
                ) from error
        # The server speaks first.
        self.metadata = self._read(self._exchange(None, self._connect_s))

    def request(self, message: dict[str, Any], expected: str) -> dict[str, Any]:
        """Send a message and return its answer, a map with `expected` in it, and that not false.

        After an error the connection is gone: what the server still remembers is not known.

        Raises:
            WireError: The message cannot be sent.
            PolicyServerError: The server reports an error, is gone, is too slow, or gives another
                answer.
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

    def _check_health(self) -> None:
        """Ask `GET /healthz`, which tells a wrong port from a server that is still loading."""
        client = http.client.HTTPConnection(self._host, self._port, timeout=self._connect_s)
        try:
            client.request("GET", "/healthz", headers=_headers())
            status = client.getresponse().status
        finally:
            client.close()
        if status >= http.HTTPStatus.INTERNAL_SERVER_ERROR:
            raise http.client.HTTPException(f"GET /healthz answers {status}")
        if status != http.HTTPStatus.OK:
            raise self._refusal(status)

    def _handshake(self) -> ClientConnection:
        connecting = connect(
            f"ws://{self.name}",
            additional_headers=_headers(),
            open_timeout=self._connect_s,
            close_timeout=_CLOSE_S,
            compression=None,
            max_size=None,
            proxy=None,
            # A server that computes does not answer pings; `response_s` finds the dead ones.
            ping_interval=None,
        )
        return self._stack.enter_context(connecting)

    def _refusal(self, status: int) -> PolicyServerError:
        if status in (http.HTTPStatus.UNAUTHORIZED, http.HTTPStatus.FORBIDDEN):
            return PolicyServerError(
                f"policy server {self.name} refuses with {status}: it asks for another key",
                f"Set {API_KEY_VARIABLE} to its API key.",
            )
        return PolicyServerError(
            f"what listens at {self.name} is no policy server: it answers {status}",
            f"Check host and port; {_GUIDE}",
        )

    def _exchange(self, data: bytes | None, seconds: float) -> str | bytes:
        """Send, unless there is nothing to send, and receive."""
        with self._within(seconds) as connection:
            if data is not None:
                connection.send(data)
            return connection.recv()

    def _read(self, data: str | bytes) -> dict[str, Any]:
        if isinstance(data, str):
            # A traceback, sent as text; the server closes with 1011 after it.
            self.close()
            lines = [line for line in data.splitlines() if line.strip()] or ["an empty text"]
            raise PolicyServerError(
                f"policy server {self.name} reports: {lines[-1].strip()}",
                "The whole traceback is in the server's log.",
            )
        try:
            answer = unpack(data)
        except ValueError as error:
            self.close()
            raise PolicyServerError(f"policy server {self.name}: {error}") from error
        if not isinstance(answer, dict):
            self.close()
            raise PolicyServerError(
                f"policy server {self.name} answers with a {type(answer).__name__}, not a map"
            )
        return answer

    @contextmanager
    def _within(self, seconds: float) -> Iterator[ClientConnection]:
        """Lend the connection for a time. If anything breaks meanwhile, it is gone."""
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

        timer = threading.Timer(seconds, expire)
        timer.daemon = True
        timer.start()
        try:
            yield connection
        except (ConnectionClosed, OSError) as error:
            self.close()
            late = f"did not answer within {seconds:g} s"
            raise PolicyServerError(
                f"policy server {self.name} "
                + (late if expired.is_set() else f"closed the connection: {error}"),
                "Its log may say why.",
            ) from error
        except BaseException:
            # An answer that nobody read would be taken for that of the next message.
            self.close()
            raise
        finally:
            timer.cancel()


def _headers() -> dict[str, str]:
    key = os.environ.get(API_KEY_VARIABLE)
    return {"Authorization": f"Api-Key {key}"} if key else {}
