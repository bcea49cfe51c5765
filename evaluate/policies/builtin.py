"""The built-in policies that ask the simulator, or do nothing: the benchmark's ends."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION_CHUNK
from robomme_interference_data.errors import PolicyError
from robomme_interference_data.evaluate.policies.base import Policy, RolloutInfo
from robomme_interference_data.simulators.base import Observation, Simulator

__all__ = ["Hold", "Privileged"]


class Privileged(Policy):
    """`oracle` or `guess`: the simulator's own scripts, with the hidden answer or a drawn one."""

    privileged = True

    def __init__(self, name: str):
        self.name = name
        self._simulator: Simulator | None = None

    def reset(self, info: RolloutInfo) -> None:
        """Keep the simulator."""
        self._simulator = info.simulator

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the script's next action, `(1, 8) float32`: a script is asked step by step.

        Raises:
            PolicyError: It was given no simulator.
        """
        if self._simulator is None:
            raise PolicyError(f"the policy {self.name} needs the simulator itself")
        return self._simulator.act(self.name)[None]

    def metadata(self) -> dict[str, Any]:
        """Return its name."""
        return {"policy": self.name}


class Hold(Policy):
    """Holds the pose that the arm has, so that nothing happens."""

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the present joint positions as targets, gripper open, `(16, 8) float32`."""
        action = np.append(observation.state[:7], np.float32(1.0))
        return np.tile(action, (ACTION_CHUNK, 1))

    def metadata(self) -> dict[str, Any]:
        """Return its name."""
        return {"policy": "hold"}
