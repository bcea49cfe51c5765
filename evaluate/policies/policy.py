"""What every policy is to the harness, whatever is behind it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.schema.evidence import Evidence
from robomme_interference_data.simulators.base import Observation, Simulator

Frames = Mapping[str, NDArray[np.uint8]]
"""Camera name (`front`, `wrist`) to `(T, H, W, 3) uint8` RGB."""


@dataclass(frozen=True)
class RolloutInfo:
    """What a policy is told when a rollout begins.

    Attributes:
        goal: The goal in words.
        history_frames: Frames of history that will follow; 0 under `no-history`.
        seed: Seed for whatever the policy draws at random.
        simulator: The running simulator, for the built-in policies that may ask it for actions
            (`oracle`, `guess`, `recall`); None for every policy that is not privileged.
        evidence: Which frames of the history that will follow show a part of the hidden answer,
            for `recall`; None where that is unknown, and for every policy that is not privileged.
    """

    goal: str
    history_frames: int
    seed: int
    simulator: Simulator | None = None
    evidence: tuple[Evidence, ...] | None = None


class Policy(ABC):
    """A policy together with its memory, one rollout at a time.

    The calls come in this order:

    `reset`; `add_history` for each chunk of the history, in order; `observe` with the first live
    observation; `act`; up to 16 of its actions are executed; `observe` with what was seen after
    each of them; `act`; and so on.

    A policy of one's own need not be a subclass; one that is needs only `act` and `metadata`.

    Attributes:
        cameras: Cameras whose live frames it wants, such as `("front", "wrist")`: no others are
            drawn.
        history_cameras: Cameras whose history it wants: no others are decoded.
        wants_history: Whether history makes a difference to it; if not, it runs `no-history` only.
        privileged: Whether it gets `RolloutInfo.simulator` and `RolloutInfo.evidence`.
        every_frame: Whether it wants what is seen after each action; if not, `observe` gets only
            the observation on which it acts next, and simulators need not draw the others.
    """

    cameras: tuple[str, ...] = ()
    history_cameras: tuple[str, ...] = ()
    wants_history: bool = True
    privileged: bool = False
    every_frame: bool = False

    def reset(self, info: RolloutInfo) -> None:
        """Forget everything and prepare for a rollout."""

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        """Take the next chunk of the history.

        Args:
            frames: `(T, H, W, 3) uint8` of each of `history_cameras`.
            states: `(T, 8) float32`.
            exec_start_idx: Number of history frames in all, the same with every chunk.
        """

    def observe(self, frames: Frames, states: NDArray[np.float32]) -> None:
        """Take the live observations since the last call.

        Args:
            frames: `(T, H, W, 3) uint8` of each of `cameras`.
            states: `(T, 8) float32`.
        """

    @abstractmethod
    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the next actions, `(n, 8) float32`, n at least 1; 16 at most are executed.

        Args:
            observation: What is seen now; `observe` has had it.
            goal: The goal in words.
        """

    @abstractmethod
    def metadata(self) -> dict[str, Any]:
        """Return plain values that say which policy this is, for the record of the run."""

    def close(self) -> None:
        """Release everything."""
