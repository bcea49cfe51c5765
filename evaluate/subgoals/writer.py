"""What writes subgoals for a policy, before each chunk of its actions."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import FPS
from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.evaluate.models.model import Video
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.base import Observation, Simulator

CAMERA = "front"

ORACLE = "oracle"
"""The writer that is no model."""


class History:
    """The history that a policy is given, in the front camera's images; decoded when asked for."""

    def __init__(self, buffer: Buffer, given: Sequence[int]):
        self._buffer, self._given = buffer, given

    def __len__(self) -> int:
        return len(self._given)

    def frames(self, places: Sequence[int]) -> NDArray[np.uint8]:
        """Decode some of the frames, `(n, H, W, 3) uint8` RGB, by their places, ascending."""
        indices = [self._given[place] for place in places]
        [chunk] = self._buffer.stream(len(indices), (CAMERA,), indices)
        return chunk.frames[CAMERA]

    def video(self, places: Sequence[int]) -> Video:
        """Decode frames as a video that takes as long as they did."""
        seconds = (places[-1] - places[0]) / FPS
        return Video(self.frames(places), (len(places) - 1) / seconds if seconds else FPS)


@dataclass(frozen=True)
class Turn:
    """One subgoal, for the record: a line in the run's folder.

    Attributes:
        step: Actions that were executed before it.
        subgoal: What the policy was told, with places as `<y, x>`.
        prompt: What the model was asked; images are written `[image]` and `[video of n frames]`.
        answer: What it answered.
        fault: Why the answer could not be used; None if it could.
        keyframes: Live frames that are kept, by the number of actions before them.
        tokens: Tokens of question and answer; None if the model does not say.
        calls: How often the model was asked.
        seconds: Until the answer was there.
    """

    step: int
    subgoal: str
    prompt: str | None = None
    answer: str | None = None
    fault: str | None = None
    keyframes: tuple[int, ...] = ()
    tokens: int | None = None
    calls: int = 0
    seconds: float = 0.0


class SubgoalWriter(ABC):
    """Writes subgoals, one rollout at a time.

    The calls come in this order: `start`; `watch` with the first live observation; `next`; up to
    16 actions are executed; `watch` with what was seen after them; `next`; and so on.

    Attributes:
        every_frame: Whether `watch` is to get what is seen after each action; if not, only what
            the policy acts on next.
        turns: What it has written in this rollout.
    """

    every_frame: bool = False

    def __init__(self) -> None:
        self.turns: list[Turn] = []

    def start(self, history: History, info: RolloutInfo, simulator: Simulator) -> None:
        """Forget everything and prepare for a rollout; only `oracle` may use the simulator."""
        self.turns = []

    def watch(self, observations: Sequence[Observation]) -> None:
        """Take what was seen since the last call; the last one is of now."""

    @abstractmethod
    def next(self, observation: Observation, step: int) -> Subgoal:
        """Return what is to be done next.

        Args:
            observation: What is seen now; `watch` has had it.
            step: Actions that were executed.
        """

    @abstractmethod
    def metadata(self) -> dict[str, Any]:
        """Return plain values that say which writer this is, for the record of the run."""

    def close(self) -> None:
        """Release everything."""


class OracleWriter(SubgoalWriter):
    """`oracle`: the simulator's own current subgoal, which knows the hidden answer."""

    def start(self, history: History, info: RolloutInfo, simulator: Simulator) -> None:
        """Keep the simulator."""
        super().start(history, info, simulator)
        self._simulator = simulator

    def next(self, observation: Observation, step: int) -> Subgoal:
        """Return the simulator's subgoal; see `Simulator.subgoal` for its errors."""
        subgoal = self._simulator.subgoal()
        self.turns.append(Turn(step, subgoal.grounded))
        return subgoal

    def metadata(self) -> dict[str, Any]:
        """Return its name."""
        return {"subgoals": "oracle", "privileged": True}
