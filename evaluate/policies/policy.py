"""The interface of policies: implement `Policy` to evaluate a policy of your own."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.schema.evidence import Evidence
from robomme_interference_data.schema.other_states import OtherStates
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import Observation

Frames = Mapping[str, NDArray[np.uint8]]
"""Camera name (`front`, `wrist`) to `(T, H, W, 3) uint8` RGB; both simulators draw 256 × 256."""


@dataclass(frozen=True)
class RolloutInfo:
    """What a policy knows when a rollout begins.

    Attributes:
        goal: The goal in words.
        history_frames: Number of history frames that `add_history` will bring in all; 0 under
            `no-history`.
        seed: Seed for everything that the policy draws at random.
        simulator: The running simulator, for privileged policies (`oracle`, `guess`, `recall`);
            None for all others.
        evidence: Which history frames show a part of the hidden answer, for privileged policies;
            None where that is unknown, and for all others.
        first_counts: Whether the goal asks for the first of several lessons; otherwise the last
            one counts.
        answer: For the policy `answers`: the number of the answer to carry out, in `Scene.answers`;
            None without a choice, and for all other policies.
    """

    goal: str
    history_frames: int
    seed: int
    simulator: Simulator | None = None
    evidence: tuple[Evidence, ...] | None = None
    first_counts: bool = False
    answer: int | None = None


class Policy(ABC):
    """A policy together with its memory, one rollout at a time.

    The calls come in this order:

    `reset`; `add_history` for each chunk of the history, in order; `observe` with the first live
    observation; `act`; up to 16 of its actions are executed; `observe` with the observations after
    each of them; `act`; and so on, for at most 1300 actions.

    A policy need not be a subclass: it needs the same attributes and methods. A subclass must
    define `act` and `metadata` only. Frames come at 10 Hz: an action controls the robot for 0.1 s.
    A state is `(8,) float32`: 7 joint positions in rad, then the gripper's opening in m, the way of
    one finger, from 0 (closed) to 0.04 (open).

    Attributes:
        cameras: Cameras whose live frames it reads, such as `("front", "wrist")`: no others are
            drawn. Default: none.
        history_cameras: Cameras whose history it reads: no others are decoded. Default: none.
        wants_history: Whether it uses history; if not, it runs under `no-history` only.
        privileged: Whether it gets `RolloutInfo.simulator` and `RolloutInfo.evidence`.
        every_frame: Whether `observe` gets the observations after every action; if not, only the
            one on which it acts next, and simulators need not draw the others.
        other_states: What it gets of the states of units of another robot, which have another
            number of values than the query's: `pad`, zeros after fewer values; `omit`, zeros in
            place of all values; or `refuse`, no run with such units. A policy that reads no history
            states declares `omit`.
        memory: Rule by which it keeps frames, `full`, `framesamp:N`, `window:N` or
            `window:SECONDS@FPS` (see `Memory`), from which rows get `evidence_kept`, the share of
            the evidence that it still has. None if it keeps none, or by another rule.
    """

    cameras: tuple[str, ...] = ()
    history_cameras: tuple[str, ...] = ()
    wants_history: bool = True
    privileged: bool = False
    every_frame: bool = False
    other_states: OtherStates = "refuse"
    memory: str | None = None

    def reset(self, info: RolloutInfo) -> None:
        """Clear the memory and prepare for a rollout."""

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        """Add the next chunk of the history to the memory.

        Args:
            frames: `(T, H, W, 3) uint8` RGB of each of `history_cameras`, T at least 1.
            states: `(T, 8) float32`, one for each frame: rad and m, see `Policy`; of units of
                another robot what `other_states` declares.
            exec_start_idx: Number of history frames in all, the same with every chunk.
        """

    def observe(self, frames: Frames, states: NDArray[np.float32]) -> None:
        """Add the live observations since the last call to the memory, oldest first.

        Args:
            frames: `(T, H, W, 3) uint8` RGB of each of `cameras`, T from 1 to 16.
            states: `(T, 8) float32`, one for each frame: rad and m, see `Policy`.
        """

    @abstractmethod
    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the next actions.

        Args:
            observation: The current observation, the last one that `observe` got: its `images` are
                `(H, W, 3) uint8` RGB of each of `cameras`, its `state` is `(8,) float32`, and its
                `subgoal` is what to do next, if something writes subgoals.
            goal: The goal in words.

        Returns:
            `(n, 8) float32`, n at least 1; at most the first 16 are executed, one each 0.1 s. An
            action is 7 absolute joint targets in rad, then the gripper, −1 (close) to 1 (open).
        """

    @abstractmethod
    def metadata(self) -> dict[str, Any]:
        """Return plain values that identify the policy, such as its checkpoint, for `run.json`."""

    def close(self) -> None:
        """Release all resources."""


BATCH_METHODS = ("session", "act_batch")
"""What `BatchPolicy` adds to `Policy`."""


class BatchPolicy(Policy):
    """A policy that several rollouts can share (`policies`): one copy of its weights for all.

    Without `policies` it acts as any other policy. A policy need not be a subclass: it needs these
    two methods.
    """

    @abstractmethod
    def session(self) -> Policy:
        """Return a policy with a memory of its own, and the weights of this one.

        A session runs one rollout after the other. With `policies`, only sessions are reset and
        act; each is closed before this policy.
        """

    @abstractmethod
    def act_batch(
        self, sessions: Sequence[Policy], observations: Sequence[Observation], goals: Sequence[str]
    ) -> Sequence[NDArray[np.float32]]:
        """Return the next actions of several sessions, what the `act` of each would return.

        If it raises, each session's `act` is called instead, so that only the rollout at fault
        fails: change no memory before the last statement that can raise.

        Args:
            sessions: Different sessions of this policy, at least 2.
            observations: The current observation of each.
            goals: The goal of each.

        Returns:
            `(n, 8) float32` for each session, see `Policy.act`.
        """
