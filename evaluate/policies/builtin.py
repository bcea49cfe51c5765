"""The built-in policies, without learned weights: the benchmark's controls."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION_CHUNK
from robomme_interference_data.errors import PolicyError
from robomme_interference_data.schema.evidence import known_parts
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import Observation

from .policy import Frames, Policy, RolloutInfo

THUMBNAIL = 16
"""Side of the thumbnail with which frames are compared, px."""

MAX_MOVE = 0.08
"""Maximum change of a joint target from one step to the next, rad."""

GRIP_CHANGE = 5e-4
"""Minimum motion of a finger between two kept frames that counts as closing or opening, m."""

GRIP_STEPS = 5
"""Steps to wait for the gripper where frames between two kept frames are missing."""


class ReplayPolicy(Policy):
    """`replay`: a memory.

    It keeps history frames by its memory rule, finds the kept frame that looks most like the first
    live observation, and follows the states after it; at the last state it stops. It knows nothing
    about sessions, families or answers, so its success shows only whether the right frames are
    still in memory.

    Args:
        memory: A rule, such as `full`, `framesamp:32` or `window:60@2`; see `Memory`.
        extrapolate: Continue the last motion for as many steps as history frames follow the last
            kept one. Such rows are those of another system.
    """

    cameras = ("front",)
    history_cameras = ("front",)

    def __init__(self, memory: str = "full", *, extrapolate: bool = False):
        self._memory, self._extrapolate = Memory.parse(memory), extrapolate
        self.memory = str(self._memory)

    def reset(self, info: RolloutInfo) -> None:
        """Clear the memory."""
        self._views: list[NDArray[np.float32]] = []
        self._states: list[NDArray[np.float32]] = []
        self._plan: NDArray[np.float32] | None = None
        self._done = 0

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        """Store frames; the memory rule selects from them at the first action."""
        self._views.append(thumbnails(frames["front"]))
        self._states.append(np.array(states, np.float32))

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the next 16 targets of the trajectory, `(16, 8) float32`."""
        if self._plan is None:
            self._plan = self._start_plan(observation)
        steps = np.arange(self._done, self._done + ACTION_CHUNK)
        self._done += ACTION_CHUNK
        return self._plan[np.minimum(steps, len(self._plan) - 1)]

    def metadata(self) -> dict[str, Any]:
        """Return name and memory rule."""
        return {"policy": "replay", "memory": self.memory}

    def _start_plan(self, observation: Observation) -> NDArray[np.float32]:
        live = sum(len(states) for states in self._states)
        kept = np.array(self._memory.earlier(live), np.int64)
        if not len(kept):
            return follow(observation.state, kept, observation.state[None][:0])
        views = np.concatenate(self._views)[kept]
        view = thumbnails(observation.images["front"][None])
        # The first of equals, because most of a trajectory follows it.
        nearest_view = int(np.argmin(((views - view) ** 2).mean(axis=(1, 2, 3))))
        kept = kept[nearest_view:]
        states = np.concatenate(self._states)[kept]
        if self._extrapolate:
            kept, states = extrapolate(kept, states, live - 1)
        return follow(observation.state, kept, states)


def thumbnails(frames: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the mean colors of 16 × 16 tiles, `(T, 16, 16, 3) float32`."""
    count, height, width, _ = frames.shape
    tall, wide = height // THUMBNAIL, width // THUMBNAIL
    cropped = frames[:, : tall * THUMBNAIL, : wide * THUMBNAIL]
    tiles = cropped.reshape(count, THUMBNAIL, tall, THUMBNAIL, wide, 3)
    return tiles.mean(axis=(2, 4), dtype=np.float32)


def extrapolate(
    kept: NDArray[np.int64], states: NDArray[np.float32], last: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Append a last frame, index `last`, with the joints that a constant speed would give."""
    if len(kept) < 2 or kept[-1] >= last:
        return kept, states
    speed = (states[-1] - states[-2]) / np.float32(kept[-1] - kept[-2])
    end = states[-1] + speed * np.float32(last - kept[-1])
    end[7] = states[-1][7]  # the gripper does not move
    return np.append(kept, last), np.vstack([states, end])


def follow(
    now: NDArray[np.float32], kept: NDArray[np.int64], states: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return joint targets through states, `(n, 8)`, at their recorded pace: `(m, 8)`, m ≥ 1.

    Between two kept frames the targets are interpolated, one step for each missing frame, and more
    where a joint would move over 0.08 rad in a step. The gripper closes when its opening shrinks,
    opens when it grows, and else keeps its command.
    """
    grip = 1.0 if now[7] > 0.02 else -1.0  # half of a finger's way from closed to open
    targets = [np.append(now[:7], np.float32(grip))]
    at, index = now, None
    for state, seen in zip(states, kept.tolist(), strict=True):
        frames = 1 if index is None else seen - index
        change = 0.0 if index is None else float(state[7] - at[7])
        next_grip = grip if abs(change) <= GRIP_CHANGE else (-1.0 if change < 0 else 1.0)
        whole = frames == 1  # no frame is missing: the gripper moves at this frame
        if whole:
            grip = next_grip
        steps = max(frames, int(np.ceil(np.abs(state[:7] - at[:7]).max() / MAX_MOVE)))
        for step in range(1, steps + 1):
            joints = at[:7] + (state[:7] - at[:7]) * (step / steps)
            targets.append(np.append(joints, grip))
        if not whole and next_grip != grip:
            grip = next_grip
            targets += [np.append(state[:7], grip) for _ in range(GRIP_STEPS)]
        at, index = state, seen
    # The first target is the current pose, for a memory that keeps no frame.
    return np.array(targets[1:] or targets, np.float32)


class Privileged(Policy):
    """`oracle` or `guess`: the simulator's own scripts, with the hidden answer or a random one."""

    privileged = True
    other_states = "omit"  # it reads no history

    def __init__(self, name: str):
        self.name = name
        self._simulator: Simulator | None = None

    def reset(self, info: RolloutInfo) -> None:
        """Keep the simulator."""
        self._simulator = info.simulator

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the script's next action, `(1, 8) float32`."""
        return self._running().act(self.name)[None]

    def metadata(self) -> dict[str, Any]:
        """Return its name."""
        return {"policy": self.name}

    def _running(self) -> Simulator:
        if self._simulator is None:
            raise PolicyError(f"the policy {self.name} needs the simulator, and got None")
        return self._simulator


class FollowSubgoals(Privileged):
    """`follow-subgoals`: the simulator's script that carries out subgoals.

    It matches their words and points with what the scene allows, and does not know the answer.
    Without subgoals it acts like `guess`.

    Args:
        points: Whether it sees the points of subgoals; if not, only their words.
    """

    def __init__(self, *, points: bool = True) -> None:
        super().__init__("follow-subgoals")
        self._points = points
        self._followed: Subgoal | None = None

    def reset(self, info: RolloutInfo) -> None:
        """Keep the simulator, and forget the last subgoal."""
        super().reset(info)
        self._followed = None

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the script's next action, `(1, 8) float32`; see `Privileged.act`."""
        # A subgoal stays the same object until one is written, perhaps with the same words.
        new = observation.subgoal if observation.subgoal is not self._followed else None
        self._followed = observation.subgoal
        if new is not None and not self._points:
            new = Subgoal(new.simple)
        return self._running().follow_subgoal(new)[None]


class Recall(Privileged):
    """`recall`: the ideal observer, which uses marked evidence only, with some memory rule.

    It knows the parts of the hidden answer of whose evidence its memory keeps a frame; of two
    lessons that show the same part, the newer one counts, unless the goal says otherwise. It draws
    one of the answers that agree from the episode's seed, and the simulator's script carries it
    out. It reads no images.

    Args:
        memory: A rule, such as `full`, `framesamp:32` or `window:60@2`; see `Memory`.
    """

    def __init__(self, memory: str = "full"):
        super().__init__("recall")
        self._memory = Memory.parse(memory)
        self.memory = str(self._memory)

    def reset(self, info: RolloutInfo) -> None:
        """Determine which parts of the answer the memory keeps."""
        super().reset(info)
        if info.evidence is None:
            raise PolicyError(
                "recall needs to know which frames show the answer, which is unknown here",
                "Build the buffer set from a source with evidence: see docs/reference/sources.md.",
            )
        kept = self._memory.earlier(info.history_frames)
        self._known = known_parts(info.evidence, kept, first_counts=info.first_counts)

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the script's next action, `(1, 8) float32`; see `Privileged.act`."""
        return self._running().act(self.name, self._known)[None]

    def metadata(self) -> dict[str, Any]:
        """Return name and memory rule."""
        return {"policy": self.name, "memory": self.memory}


class Noop(Policy):
    """`noop`: holds the current pose."""

    other_states = "omit"  # it reads no history

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the current joint positions as targets, gripper open, `(16, 8) float32`."""
        action = np.append(observation.state[:7], np.float32(1.0))
        return np.tile(action, (ACTION_CHUNK, 1))

    def metadata(self) -> dict[str, Any]:
        """Return its name."""
        return {"policy": "noop"}
