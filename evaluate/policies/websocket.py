"""Policies behind a websocket: openpi's server protocol, as MME-VLA extends it.

The server holds the memory of one rollout, so a lost connection loses the rollout; only when a
rollout begins is a server connected again. `wire.py` has the bytes of the messages.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import InvalidOptionError, PolicyError, PolicyServerError
from robomme_interference_data.evaluate.policies.base import Frames, RolloutInfo
from robomme_interference_data.evaluate.policies.checks import check_actions, check_frames, plain
from robomme_interference_data.evaluate.policies.connection import ServerConnection
from robomme_interference_data.simulators.base import Observation

__all__ = ["WebsocketPolicy"]


class WebsocketPolicy:
    """A policy server, by host and port.

    The seed of a rollout means nothing to a server: it was started with a seed of its own, to
    which it returns at every reset. A server without a memory ignores the frames that it is sent.

    Args:
        host: Name or address of the server.
        port: Its port.
        chunk_frames: Most frames in a message. 16 is what a live message carries too: a server
            that compiles for each length (JAX) then compiles no further ones for the history.
        connect_s: Most seconds that one attempt to connect may take.
        response_s: Most seconds from a message to its answer. The first of a kind takes long, as
            servers compile then.
        attempts: How often a connection is tried before it counts as refused.
        backoff_s: Seconds between the first two attempts; they double up to 30.
    """

    cameras = ("front", "wrist")
    history_cameras = ("front",)
    wants_history = True
    privileged = False
    every_frame = True

    def __init__(
        self,
        host: str,
        port: int,
        *,
        chunk_frames: int = 16,
        connect_s: float = 10.0,
        response_s: float = 600.0,
        attempts: int = 6,
        backoff_s: float = 1.0,
    ):
        if chunk_frames < 1 or attempts < 1 or min(connect_s, response_s) <= 0 or backoff_s < 0:
            raise InvalidOptionError(
                f"chunk_frames {chunk_frames}, attempts {attempts}, connect_s {connect_s}, "
                f"response_s {response_s}, backoff_s {backoff_s}: expected positive numbers"
            )
        self._chunk = chunk_frames
        self._server = ServerConnection(
            host,
            port,
            connect_s=connect_s,
            response_s=response_s,
            attempts=attempts,
            backoff_s=backoff_s,
        )
        self._history = 0  # frames that were announced
        self._given = 0  # of them, frames that came
        self._live = False  # whether the first live observation came
        self._held: tuple[NDArray[np.uint8], NDArray[np.float32]] | None = None

    def reset(self, info: RolloutInfo) -> None:
        """Empty the server's memory, connecting first, or again if the connection was lost.

        Raises:
            PolicyServerError: The server cannot be reached, or reports an error.
        """
        self._history, self._given, self._live, self._held = info.history_frames, 0, False, None
        if self._server.is_open:
            try:
                self._server.request({"reset": True}, "reset_finished")
                return
            except PolicyServerError:
                pass  # it broke since the last rollout; there is no memory yet that it could lose
        self._server.open()
        self._server.request({"reset": True}, "reset_finished")

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        """Send history in whole chunks; what is left waits for the first live observation.

        Raises:
            PolicyError: Frames and states do not fit, or another length was announced.
            PolicyServerError: The server reports an error, or is gone.
        """
        images = check_frames(frames, states, "front")
        if self._live or exec_start_idx != self._history:
            raise PolicyError(
                f"history of {exec_start_idx} frames after "
                + ("a live observation" if self._live else f"{self._history} were announced"),
                "The order of calls is in evaluate/policies/base.py.",
            )
        self._given += len(images)
        images, states = self._with_held(images, states)
        whole = len(images) // self._chunk * self._chunk
        self._send(images[:whole], states[:whole])
        if whole < len(images):
            # A copy, for the caller may use its arrays again.
            self._held = (images[whole:].copy(), states[whole:].copy())

    def observe(self, frames: Frames, states: NDArray[np.float32]) -> None:
        """Send live observations; the first of them ends the last chunk of the history.

        Raises:
            PolicyError: Frames and states do not fit, or history is missing.
            PolicyServerError: The server reports an error, or is gone.
        """
        images = check_frames(frames, states, "front")
        if self._live:
            self._send(images, states)
            return
        if self._given != self._history:
            raise PolicyError(
                f"{self._given} history frames came; {self._history} were announced",
                "The order of calls is in evaluate/policies/base.py.",
            )
        self._send(*self._with_held(images, states))
        self._live = True

    def _with_held(
        self, images: NDArray[np.uint8], states: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        if self._held is not None:
            first_images, first_states = self._held
            self._held = None
            images = np.concatenate([first_images, images])
            states = np.concatenate([first_states, states])
        return images, states

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
        """Ask the server for actions.

        Returns:
            `(n, 8) float32`, as many as the server gives.

        Raises:
            PolicyServerError: The server reports an error, is gone, or gives no such actions.
        """
        message = {
            "observation/image": observation.images["front"],
            "observation/wrist_image": observation.images["wrist"],
            "observation/state": np.asarray(observation.state, np.float32),
            "prompt": goal,
        }
        answer = self._server.request(message, "actions")
        try:
            return check_actions(answer["actions"])
        except PolicyError as error:
            raise PolicyServerError(
                f"policy server {self._server.name}: {error.message}"
            ) from error

    def metadata(self) -> dict[str, Any]:
        """Return the server's address and what it said of itself, connecting if it never was asked.

        Raises:
            PolicyServerError: The server cannot be reached.
        """
        if self._server.metadata is None:
            self._server.open()
        said = plain(self._server.metadata)
        return {"policy": "websocket", "server": self._server.name, "server_metadata": said}

    def close(self) -> None:
        """Close the connection."""
        self._server.close()
