"""The interface of subgoal writers, which run before each chunk of a policy's actions."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import Observation

from .images import HistoryFrames


@dataclass(frozen=True)
class Turn:
    """One subgoal: a line of a transcript in the run's folder.

    Attributes:
        step: Number of actions before it.
        subgoal: The subgoal, with points as `<y, x>`.
        prompt: The prompt of the model, with `[image]` and `[video of n frames]`.
        answer: The answer of the model.
        fault: Why the answer is invalid; None if it is valid.
        keyframes: The selected key frames, by the number of actions before them.
        tokens: Tokens of prompt and answer; None if not reported.
        calls: Number of calls of the model.
        seconds: Time until the answer.
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
    16 actions are executed; `watch` with the observations after them; `next`; and so on.

    Attributes:
        every_frame: Whether `watch` gets the observations after every action; if not, only the one
            on which the policy acts next.
        turns: The subgoals of this rollout.
    """

    every_frame: bool = False

    def __init__(self) -> None:
        self.turns: list[Turn] = []

    def start(self, history: HistoryFrames, info: RolloutInfo, simulator: Simulator) -> None:
        """Clear the state and prepare for a rollout; only `oracle` may use the simulator."""
        self.turns = []

    def watch(self, observations: Sequence[Observation]) -> None:
        """Receive the observations since the last call, the current one last."""

    @abstractmethod
    def next(self, observation: Observation, step: int) -> Subgoal:
        """Return the next subgoal.

        Args:
            observation: The current observation, the last one of `watch`.
            step: Number of actions so far.
        """

    @abstractmethod
    def metadata(self) -> dict[str, Any]:
        """Return plain values that identify the writer, for `run.json`."""

    def close(self) -> None:
        """Release all resources."""


class OracleWriter(SubgoalWriter):
    """`oracle`: the simulator's own current subgoal, which knows the hidden answer."""

    def start(self, history: HistoryFrames, info: RolloutInfo, simulator: Simulator) -> None:
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
