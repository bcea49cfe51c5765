"""A policy server that a worker starts beside itself, and ends with itself."""

import os
import shlex
import subprocess
import tempfile
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from typing import Any

from robomme_interference_data.constants import ACTION_CHUNK
from robomme_interference_data.errors import InvalidOptionError, ServerDiedError, printed_last
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.evaluate.policies.servers import hold_port
from robomme_interference_data.evaluate.policies.websocket import WebsocketPolicy

_END_S = 5.0
"""Seconds that a server has to end when it is asked to."""

_DEATH_S = 0.5
"""Seconds after which a server that closed its connection is taken to be alive."""

_LOG_BYTES = 1 << 20
"""How much of what a server printed is kept: its end."""


class ServedPolicy(WebsocketPolicy):
    """A policy server by the command that starts it, which is run when it is first needed.

    The command is run without a shell, in this process's folder and environment, and listens at a
    port that no other server of this package has here. It ends with `close`, and with the worker
    process. A call that finds it ended raises `ServerDiedError`, with what it printed last.

    Args:
        command: The command, with `{port}` in it.
        checkpoint, chunk_frames, connect_s, response_s: See `WebsocketPolicy`.

    Attributes:
        started: When, UTC, `20260131T120000.000000Z`.

    Raises:
        PolicyServerError: No port is free.
    """

    def __init__(
        self,
        command: str,
        *,
        checkpoint: str | None = None,
        chunk_frames: int = ACTION_CHUNK,
        connect_s: float = 600.0,
        response_s: float = 600.0,
    ):
        self._command, self.started = command, ""
        self._process: subprocess.Popen[bytes] | None = None
        self._stack = ExitStack()
        self._port = self._stack.enter_context(hold_port())
        self._log = self._stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
        super().__init__(
            "127.0.0.1",
            self._port,
            checkpoint=checkpoint,
            chunk_frames=chunk_frames,
            connect_s=connect_s,
            response_s=response_s,
        )

    def reset(self, info: RolloutInfo) -> None:
        """Empty the server's memory, starting it first if it was not."""
        self._start()
        super().reset(info)

    def metadata(self) -> dict[str, Any]:
        """Return the command, and what the server said of itself, starting it if it was not."""
        self._start()
        return super().metadata() | {"server": self._command}

    def log(self) -> bytes:
        """Return what the server has printed, at most its last MiB."""
        size = os.fstat(self._log.fileno()).st_size
        # Not `read`: that would move the place at which the server writes.
        return os.pread(self._log.fileno(), _LOG_BYTES, max(0, size - _LOG_BYTES))

    def close(self) -> None:
        """Close the connection, and end the server."""
        super().close()
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._stack.close()

    def _start(self) -> None:
        if self._process is not None:
            return
        self.started = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
        words = [word.replace("{port}", str(self._port)) for word in shlex.split(self._command)]
        try:
            # In the group of the worker process, and so ended with it however that ends.
            self._process = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=self._log, stderr=subprocess.STDOUT
            )
        except OSError as error:
            raise InvalidOptionError(
                f"--serve {self._command!r} cannot be run: {error}",
                "Give a program and its arguments: there is no shell.",
            ) from error

    def _check(self) -> None:
        if self._process is None:
            return
        with suppress(subprocess.TimeoutExpired):
            code = self._process.wait(_DEATH_S)
            raise ServerDiedError(
                f"the policy server that a worker had started ended, exit code {code}",
                printed_last(self.log().splitlines()),
            )
