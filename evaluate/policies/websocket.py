"""Policies behind a websocket: openpi's server protocol, as MME-VLA extends it.

The server holds the memory of one rollout, so a lost connection ends the rollout; the next rollout
connects again. `wire.py` defines the bytes of the messages.
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
from robomme_interference_data.runtime.safe_path import user_environment
from robomme_interference_data.schema.other_states import check_rule
from robomme_interference_data.simulators.episode import ACTION_SIZE, Observation

from .connection import OpenpiConnection, check_server_options
from .policy import Frames, Policy, RolloutInfo
from .server_lock import reserve_port

_NO_FRAMES = "history feats is empty"
"""In the error of a server that keeps frames when it must act before it has any."""

_DEATH_S = 0.5
"""Seconds to wait for the end of a server that closed its connection."""

_LOG_BYTES = 1 << 20
"""Bytes of a server's output that are kept, from its end."""


class WebsocketPolicy(Policy):
    """A policy server, by host and port.

    A server ignores the seed of a rollout: it has its own, to which it returns at every reset. A
    server without memory ignores the frames that it gets. Every call raises `PolicyServerError` if
    the server cannot be reached, reports an error, closes the connection or is too slow.

    Args:
        host: Name or address of the server.
        port: Its port.
        tls: Whether to connect with TLS, which verifies the server's certificate.
        checkpoint: Which checkpoint it serves, for the record; required if the server does not
            report it.
        chunk_frames: Maximum frames in a message. The default is the length of live messages: a
            server that compiles for each length (JAX) then compiles no others for the history.
        connect_s: Maximum seconds to wait until the server accepts connections: loading a model
            takes minutes.
        response_s: Maximum seconds from a message to the end of its answer. First answers take
            long, because servers compile then.
        other_states: What the server gets of the states of units of another robot, see
            `Policy.other_states`.
    """

    cameras = ("front", "wrist")
    history_cameras = ("front",)
    every_frame = True

    def __init__(
        self,
        host: str,
        port: int,
        *,
        tls: bool = False,
        checkpoint: str | None = None,
        chunk_frames: int = ACTION_CHUNK,
        connect_s: float = 600.0,
        response_s: float = 600.0,
        other_states: str = "refuse",
    ):
        check_server_options(
            checkpoint, chunk_frames=chunk_frames, connect_s=connect_s, response_s=response_s
        )
        self.other_states = check_rule(other_states)
        self._chunk = chunk_frames
        self._server = OpenpiConnection(
            host, port, tls=tls, connect_s=connect_s, response_s=response_s, check=self._check
        )
        self._history = 0  # history frames in this rollout
        self._live = False  # whether a live observation was sent
        self._held: tuple[NDArray[np.uint8], NDArray[np.float32]] | None = None

    def _check(self) -> str | None:
        """Raise if it is known why the server does not answer; else return a hint, or None."""
        return None

    def reset(self, info: RolloutInfo) -> None:
        """Empty the server's memory, connecting first, or again if the connection was lost."""
        self._history, self._live, self._held = info.history_frames, False, None
        # The connection may have broken since the last rollout; no memory is lost at a reset.
        with suppress(PolicyServerError):
            if self._server.is_open:
                self._server.request({"reset": True}, "reset_finished")
                return
        self._server.open()
        self._server.request({"reset": True}, "reset_finished")

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        """Send history in whole chunks; the rest waits for the first live observation."""
        images, states = self._with_held(frames["front"], states)
        whole = len(images) // self._chunk * self._chunk
        self._send(images[:whole], states[:whole])
        # A copy, because the caller may reuse its arrays.
        self._held = images[whole:].copy(), states[whole:].copy()

    def observe(self, frames: Frames, states: NDArray[np.float32]) -> None:
        """Send live observations; the first one completes the last chunk of the history."""
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
        """Add frames to the server's memory."""
        for start in range(0, len(images), self._chunk):
            part = slice(start, start + self._chunk)
            message = {
                "add_buffer": True,
                "images": images[part, None],  # one view: the front camera
                "state": np.asarray(states[part], np.float32),
                # A number above 0 sets the length of the history, with any chunk.
                "exec_start_idx": 0 if self._live else self._history,
            }
            self._server.request(message, "add_buffer_finished")

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the server's actions, `(n, 8)`; the rollout checks them."""
        message = self.message(observation, goal)
        actions: NDArray[np.float32] = self._server.request(message, "actions")["actions"]
        return actions

    def message(self, observation: Observation, goal: str) -> dict[str, Any]:
        """Return the message that requests actions; a subclass may add to it.

        It has a subgoal in both forms, with points and without: a server reads the form it needs.
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
        """Reset the server, and return whether it keeps frames: then it refuses to act without."""
        try:
            try:
                self._act_at_once()
            except ServerKeepaliveError:  # it compiled; the second call is fast
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
        """Return the server's address and its metadata, connecting if necessary."""
        if self._server.metadata is None:
            self._server.open()
        metadata = self._server.metadata
        return {"policy": "websocket", "server": self._server.name, "server_metadata": metadata}

    def close(self) -> None:
        """Close the connection."""
        self._server.close()


class ServedPolicy(WebsocketPolicy):
    """A policy server that this process starts on first use, by a command with `{port}` in it.

    The command runs without a shell, in this process's folder and environment, with a port that no
    other worker's server has on this machine. It ends, with all processes that it started, at
    `close`, or when this process ends for any reason. A call after its end raises
    `ServerDiedError` with its last output.

    Args:
        command: The command.
        checkpoint, chunk_frames, connect_s, response_s, other_states: See `WebsocketPolicy`.

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
        other_states: str = "refuse",
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
            other_states=other_states,
        )

    def reset(self, info: RolloutInfo) -> None:
        """Empty the server's memory, starting the server first if necessary."""
        self._start()
        super().reset(info)

    def metadata(self) -> dict[str, Any]:
        """Return the command and the server's metadata, starting the server if necessary."""
        self._start()
        return super().metadata() | {"server": self._command}

    def log(self) -> bytes:
        """Return the server's output, at most its last MiB."""
        size = os.fstat(self._log.fileno()).st_size
        # Not `read`: it would move the position at which the server writes.
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
                f"the command {self._command!r} cannot be run: no program {words[0]} exists",
                "Give a program and its arguments; they run without a shell.",
            )
        self.started = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
        self._process = subprocess.Popen(
            [sys.executable, "-I", guard.__file__, *words],
            env=user_environment(),
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
                f"the policy server that a worker started ended, exit code {code}",
                printed_last(self.log().splitlines()),
            )
        hint = (
            "A worker started it, and it still runs. It must listen at {port}; if it needs more "
            "time, set the policy's option connect_s=SECONDS."
        )
        return "\n".join(filter(None, (hint, printed_last(self.log().splitlines()))))
