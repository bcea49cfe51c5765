"""Policies behind a server of vla-eval: one observation, one answer."""

from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import PolicyServerError
from robomme_interference_data.evaluate.policies.connection import check_server_options
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.schema.other_states import check_rule
from robomme_interference_data.simulators.episode import Observation

from .checks import WRISTS, check_hello
from .connection import VlaEvalConnection
from .observations import HISTORIES, ObservingPolicy

_ONE_CLIENT = ("MmeVlaModelServer",)
"""Servers that keep one history for all connections."""


class VlaEvalPolicy(ObservingPolicy):
    """A server of vla-eval, by host and port.

    Its hello decides what it gets: the front camera, and if it asks for them, the wrist camera,
    states, and the history. The history goes with the first observation, as vla-eval sends it.
    Every call raises `PolicyServerError` if the server cannot be reached, reports an error, closes
    the connection or is too slow.

    Args:
        host: Name or address of the server.
        port: Its port.
        tls: Whether to connect with TLS, which verifies the server's certificate.
        checkpoint: Which checkpoint it serves, for the record: its hello names none.
        connect_s: Maximum seconds to wait until the server accepts connections: loading a model
            takes minutes.
        response_s: Maximum seconds from a message to the end of its answer.
        other_states: What the server gets of the states of units of another robot, see
            `Policy.other_states`.
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        tls: bool = False,
        checkpoint: str,
        connect_s: float = 600.0,
        response_s: float = 600.0,
        other_states: str = "refuse",
    ):
        check_server_options(checkpoint, connect_s=connect_s, response_s=response_s)
        self._server = VlaEvalConnection(
            host, port, tls=tls, connect_s=connect_s, response_s=response_s
        )
        self._server.open()
        self._server.close()  # the first rollout may be minutes away
        hello = self._hello = self._server.metadata or {}
        check_hello(self._server.name, hello)
        asked, declared = hello.get("observation_params", {}), hello.get("observation_spec", {})
        wrist = asked.get("send_wrist_image", any(name in declared for name in WRISTS))
        history = asked.get("send_video_history", HISTORIES["front"] in declared)
        self.sends_state = bool(asked.get("send_state", "state" in declared))
        rule = check_rule(other_states)
        self.other_states = rule if self.sends_state else "omit"
        self.cameras = ("front", "wrist") if wrist else ("front",)
        self.history_cameras = self.cameras if history else ()
        self.wants_history = bool(history)
        self._one_client = self.wants_history and hello["model_server"] in _ONE_CLIENT

    def reset(self, info: RolloutInfo) -> None:
        """Start an episode, connecting first, or again if the connection was lost."""
        # The connection may have broken since the last rollout; no memory is lost at a reset.
        with suppress(PolicyServerError):
            if self._server.is_open:
                self._server.end_episode()
                self._server.hello()
        if not self._server.is_open:
            self._server.open()
        self._server.start_episode({"name": info.goal, "seed": info.seed})
        super().reset(info)

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the server's action, or its chunk, as `(n, 8)`; the rollout checks them."""
        return np.atleast_2d(self._server.act(self.message(observation, goal)))

    def metadata(self) -> dict[str, Any]:
        """Return the server's address, its hello, and if it is known to have one memory only."""
        return {
            "policy": "vla-eval",
            "server": self._server.name,
            "one_client": self._one_client,
            "server_metadata": self._hello,
        }

    def close(self) -> None:
        """Close the connection, which ends the episode."""
        self._server.close()
