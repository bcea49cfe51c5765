"""A policy server that a worker starts beside itself, and ends with itself."""

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from typing import Any

from robomme_interference_data.constants import ACTION_CHUNK
from robomme_interference_data.errors import InvalidOptionError, ServerDiedError, printed_last

from . import server_guard
from .policy import RolloutInfo
from .servers import hold_port
from .websocket import WebsocketPolicy

_DEATH_S = 0.5
"""Seconds after which a server that closed its connection is taken to be alive."""

_LOG_BYTES = 1 << 20
"""How much of what a server printed is kept: its end."""


class ServedPolicy(WebsocketPolicy):
    """A policy server by the command that starts it, which is run when it is first needed.

    The command is run without a shell, in this process's folder and environment, and listens at a
    port that no other worker's server has on this machine. It ends, with all that it has started,
    with `close`, or with this process, however that ends. A call that finds it ended raises
    `ServerDiedError`, with what it printed last.

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
            assert self._process.stdin is not None
            self._process.stdin.close()  # the guard ends it
            self._process.wait()
        self._stack.close()

    def _start(self) -> None:
        if self._process is not None:
            return
        words = [word.replace("{port}", str(self._port)) for word in shlex.split(self._command)]
        if shutil.which(words[0]) is None:
            raise InvalidOptionError(
                f"--serve {self._command!r} cannot be run: there is no program {words[0]}",
                "Give a program and its arguments: there is no shell.",
            )
        self.started = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
        self._process = subprocess.Popen(
            [sys.executable, server_guard.__file__, *words],
            process_group=0,
            stdin=subprocess.PIPE,
            stdout=self._log,
            stderr=subprocess.STDOUT,
        )

    def _check(self) -> str | None:
        if self._process is None:
            return None
        with suppress(subprocess.TimeoutExpired):
            code = self._process.wait(_DEATH_S)
            raise ServerDiedError(
                f"the policy server that a worker had started ended, exit code {code}",
                printed_last(self.log().splitlines()),
            )
        told = (
            "--serve started it, and it runs: it has to listen at {port}; if it needs longer, give "
            "--policy-option connect_s=SECONDS"
        )
        return "\n".join(filter(None, (told, printed_last(self.log().splitlines()))))
