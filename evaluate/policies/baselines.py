"""Baselines for recordings of any robot: they repeat recorded actions and see nothing."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION_CHUNK
from robomme_interference_data.errors import InvalidOptionError, PolicyError, named
from robomme_interference_data.simulators.episode import Observation
from robomme_interference_data.simulators.recordings import Recordings

from .policy import Policy, RolloutInfo


class Mean(Policy):
    """`mean`: always the mean recorded action of other episodes, see `Recordings.mean_action`."""

    wants_history = False
    privileged = True  # recorded actions are not part of an observation

    def __init__(self) -> None:
        self._recordings: Recordings | None = None

    def reset(self, info: RolloutInfo) -> None:
        """Keep the recordings."""
        if not isinstance(info.simulator, Recordings):
            raise PolicyError("baselines need recordings", f"Set {named('offline')}.")
        self._recordings = info.simulator

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the mean action 16 times, `(16, A) float32`."""
        return np.tile(self._running().mean_action(), (ACTION_CHUNK, 1))

    def metadata(self) -> dict[str, Any]:
        """Return its name."""
        return {"policy": "mean"}

    def _running(self) -> Recordings:
        if self._recordings is None:
            raise PolicyError("the policy acts before its reset")
        return self._recordings


class Hold(Mean):
    """`hold`: the last recorded action, repeated for a whole chunk.

    Before the first step there is none: that step is the mean action.

    Args:
        chunk: Steps for which an action is repeated. To compare with a policy fairly, set it to the
            number of actions that the policy returns at once: whoever acts more often knows more.
    """

    def __init__(self, *, chunk: int = ACTION_CHUNK):
        super().__init__()
        if not 1 <= chunk <= ACTION_CHUNK:
            raise InvalidOptionError.expected("chunk", chunk, f"1 to {ACTION_CHUNK}")
        self._chunk = chunk

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the last recorded action for each step of a chunk, `(chunk, A) float32`."""
        last = self._running().last_action()
        if last is None:
            return self._running().mean_action()[None]
        return np.tile(last, (self._chunk, 1))

    def metadata(self) -> dict[str, Any]:
        """Return name and chunk."""
        return {"policy": "hold", "chunk": self._chunk}
