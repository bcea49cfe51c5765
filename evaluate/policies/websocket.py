"""Policies behind a websocket: openpi's server protocol, as MME-VLA extends it.

The server holds the memory of one rollout, so a lost connection loses the rollout; only when a
rollout begins is a server connected again. `wire.py` has the bytes of the messages.
"""

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION_CHUNK
from robomme_interference_data.errors import (
    InvalidOptionError,
    PolicyServerError,
    ServerDiedError,
    ServerKeepaliveError,
    printed_last,
)
from robomme_interference_data.runtime import guard
from robomme_interference_data.simulators.base import ACTION_SIZE, Observation

from .connection import ServerConnection
from .policy import Frames, Policy, RolloutInfo
from .server_lock import reserve_port

_NO_FRAMES = "history feats is empty"
"""In the error of a server that keeps frames and is asked for actions before it has any."""

_DEATH_S = 0.5
"""Seconds after which a server that closed its connection is taken to be alive."""

_LOG_BYTES = 1 << 20
"""How much of what a server printed is kept: its end."""


class WebsocketPolicy(Policy):
    """A policy server, by host and port.

    The seed of a rollout means nothing to a server: it was started with a seed of its own, to
    which it returns at every reset. A server without a memory ignores the frames that it is sent.
    Every call raises `PolicyServerError` if the server cannot be reached, reports an error, is gone
    or too slow.

    Args:
        host: Name or address of the server.
        port: Its port.
        checkpoint: Which checkpoint it serves, for the record; needed where the server does not say
            so itself.
        chunk_frames: Most frames in a message. Its default is what a live message carries too: a
            server that compiles for each length (JAX) compiles no further ones for the history.
        connect_s: Most seconds to wait until the server can be used: loading takes minutes.
        response_s: Most seconds from a message to its answer. The first of a kind takes long, as
            servers compile then.
    """

    cameras = ("front", "wrist")
    history_cameras = ("front",)
    every_frame = True

    def __init__(
        self,
        host: str,
        port: int,
        *,
        checkpoint: str | None = None,
        chunk_frames: int = ACTION_CHUNK,
        connect_s: float = 600.0,
        response_s: float = 600.0,
    ):
        if checkpoint is not None and not checkpoint.strip():
            raise InvalidOptionError.expected("checkpoint", checkpoint, "its name")
        if chunk_frames < 1 or not min(connect_s, response_s) > 0:
            raise InvalidOptionError(
                f"chunk_frames {chunk_frames}, connect_s {connect_s}, response_s {response_s}; "
                "expected positive numbers"
            )
        self._chunk = chunk_frames
        self._server = ServerConnection(
            host, port, connect_s=connect_s, response_s=response_s, check=self._check
        )
        self._history = 0  # frames that were announced
        self._live = False  # whether the first live observation came
        self._held: tuple[NDArray[np.uint8], NDArray[np.float32]] | None = None

    def _check(self) -> str | None:
        """Raise if it is known that the server will not answer; return what to do, or None."""
        return None

    def reset(self, info: RolloutInfo) -> None:
        """Empty the server's memory, connecting first, or again if the connection was lost."""
        self._history, self._live, self._held = info.history_frames, False, None
        # It may have broken since the last rollout; there is no memory yet that it could lose.
        with suppress(PolicyServerError):
            if self._server.is_open:
                self._server.request({"reset": True}, "reset_finished")
                return
        self._server.open()
        self._server.request({"reset": True}, "reset_finished")

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        """Send history in whole chunks; what is left waits for the first live observation."""
        images, states = self._with_held(frames["front"], states)
        whole = len(images) // self._chunk * self._chunk
        self._send(images[:whole], states[:whole])
        # A copy, for the caller may use its arrays again.
        self._held = images[whole:].copy(), states[whole:].copy()

    def observe(self, frames: Frames, states: NDArray[np.float32]) -> None:
        """Send live observations; the first of them ends the last chunk of the history."""
        self._send(*self._with_held(frames["front"], states))
        self._live = True

    def _with_held(
        self, images: NDArray[np.uint8], states: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        held, self._held = self._held, None
        if held is None or not len(held[0]):
            return images, states
        return np.concatenate([held[0], images]), np.concatenate([held[1], states])

    def _send(self, images: NDArray[np.uint8], states: NDArray[np.float32]) -> None:
        """Add frames to the server's memory, which counts them on."""
        for start in range(0, len(images), self._chunk):
            part = slice(start, start + self._chunk)
            message = {
                "add_buffer": True,
                "images": images[part, None],  # one view: the front camera
                "state": np.asarray(states[part], np.float32),
                # Above 0 it sets the length of the history, whichever chunk brings it.
                "exec_start_idx": 0 if self._live else self._history,
            }
            self._server.request(message, "add_buffer_finished")

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the actions that the server gives, `(n, 8)`; they are checked where executed."""
        message = self.message(observation, goal)
        actions: NDArray[np.float32] = self._server.request(message, "actions")["actions"]
        return actions

    def message(self, observation: Observation, goal: str) -> dict[str, Any]:
        """Return what the server is asked for actions with; a subclass may send more.

        A subgoal goes both ways, with places and without: a server reads that of its kind.
        """
        message = {
            "observation/image": observation.images["front"],
            "observation/wrist_image": observation.images["wrist"],
            "observation/state": np.asarray(observation.state, np.float32),
            "prompt": goal,
        }
        if (subgoal := observation.subgoal) is not None:
            message["simple_subgoal"] = subgoal.simple
            message["grounded_subgoal"] = subgoal.grounded
        return message

    def keeps_frames(self) -> bool:
        """Return whether the server keeps frames: one that does refuses to act when it has none.

        It is reset, and lost to a rollout that runs.
        """
        try:
            try:
                self._act_at_once()
            except ServerKeepaliveError:  # it compiled for long; now it has
                self._act_at_once()
        except PolicyServerError as error:
            if _NO_FRAMES in error.message:
                return True
            raise
        return False

    def _act_at_once(self) -> None:
        view, state = np.zeros((256, 256, 3), np.uint8), np.zeros(ACTION_SIZE, np.float32)
        self.reset(RolloutInfo("nothing", history_frames=0, seed=0))
        self.act(Observation(dict.fromkeys(self.cameras, view), state), "nothing")

    def metadata(self) -> dict[str, Any]:
        """Return the server's address and what it said of itself, connecting if need be."""
        if self._server.metadata is None:
            self._server.open()
        said = self._server.metadata
        return {"policy": "websocket", "server": self._server.name, "server_metadata": said}

    def close(self) -> None:
        """Close the connection."""
        self._server.close()


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
        self._port = self._stack.enter_context(reserve_port())
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
                f"the command {self._command!r} cannot be run: there is no program {words[0]}",
                "Give a program and its arguments: there is no shell.",
            )
        self.started = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
        self._process = subprocess.Popen(
            [sys.executable, guard.__file__, *words],
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
        hint = (
            "A worker started it, and it runs: it has to listen at {port}; if it needs longer, "
            "give the policy's option connect_s=SECONDS"
        )
        return "\n".join(filter(None, (hint, printed_last(self.log().splitlines()))))
