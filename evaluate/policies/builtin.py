"""The built-in policies that ask the simulator, or do nothing: the benchmark's ends."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import PolicyError, UnknownNameError, nearest
from robomme_interference_data.evaluate.policies.base import Frames, Policy, RolloutInfo
from robomme_interference_data.simulators.base import Observation, Simulator

__all__ = ["BUILTIN", "Hold", "Privileged", "make_builtin"]

BUILTIN = ("oracle", "guess", "hold")

CHUNK = 16
"""Actions that are executed before the policy is asked again (paper)."""


class _Blind:
    """Takes whatever it is given and keeps nothing of it."""

    cameras: tuple[str, ...] = ()
    history_cameras: tuple[str, ...] = ()
    wants_history = True
    every_frame = False
    privileged = False

    def __init__(self, name: str):
        self.name = name

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        """Forget it."""

    def observe(self, frames: Frames, states: NDArray[np.float32]) -> None:
        """Forget it."""

    def metadata(self) -> dict[str, Any]:
        """Return its name."""
        return {"policy": self.name}

    def close(self) -> None:
        """There is nothing to release."""


class Privileged(_Blind):
    """`oracle` or `guess`: the simulator's own scripts, with the hidden answer or a drawn one.

    Args:
        name: `oracle` or `guess`.
    """

    privileged = True

    def __init__(self, name: str):
        super().__init__(name)
        self._simulator: Simulator | None = None

    def reset(self, info: RolloutInfo) -> None:
        """Keep the simulator.

        Raises:
            PolicyError: There is none.
        """
        if info.simulator is None:
            raise PolicyError(f"the policy {self.name} needs the simulator itself")
        self._simulator = info.simulator

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the script's next action, `(1, 8) float32`: a script is asked step by step."""
        if self._simulator is None:
            raise PolicyError(f"the policy {self.name} was not reset")
        return self._simulator.act(self.name)[None]


class Hold(_Blind):
    """Holds the pose that the arm has, so that nothing happens."""

    def __init__(self) -> None:
        super().__init__("hold")

    def reset(self, info: RolloutInfo) -> None:
        """There is nothing to prepare."""

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the present joint positions as targets, gripper open, `(16, 8) float32`."""
        action = np.append(observation.state[:7], np.float32(1.0))
        return np.tile(action, (CHUNK, 1))


def make_builtin(name: str) -> Policy:
    """Make `oracle`, `guess` or `hold`.

    Raises:
        UnknownNameError: There is no such policy.
    """
    if name == "hold":
        return Hold()
    if name in BUILTIN:
        return Privileged(name)
    raise UnknownNameError(f"there is no built-in policy {name!r}", nearest(name, BUILTIN))
