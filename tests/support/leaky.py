"""Policies and a simulator that keep what a reset should clear; and noisy ones."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from support.worlds import World

from robomme_interference_data.evaluate import BatchPolicy, Observation
from robomme_interference_data.evaluate.policies.policy import Policy


class Retrace(BatchPolicy):
    """The example of the documentation: visits the poses of the history in their order."""

    history_cameras = ("front",)
    other_states = "pad"

    def __init__(self) -> None:
        self.path: list[Any] = []

    def reset(self, info: Any) -> None:
        self.path.clear()

    def add_history(self, frames: Any, states: Any, exec_start_idx: int) -> None:
        self.path.extend(states)

    def act(self, observation: Observation, goal: str) -> Any:
        chunk, self.path[:16] = self.path[:16], []
        actions = np.stack(chunk or [observation.state])
        actions[:, 7] = np.where(actions[:, 7] > 0.02, 1, -1)
        return actions

    def metadata(self) -> dict[str, Any]:
        return {"policy": "retrace"}

    def session(self) -> Policy:
        return type(self)()

    def act_batch(self, sessions: Sequence[Any], observations: Any, goals: Any) -> Any:
        calls = zip(sessions, observations, goals, strict=True)
        return [session.act(*given) for session, *given in calls]


class Leaky(Retrace):
    """Does not clear its path."""

    def reset(self, info: Any) -> None: ...


class OneMemory(Retrace):
    """All sessions have one path, which a reset clears: only two clients at once disturb it."""

    common: ClassVar[list[Any]] = []

    def __init__(self) -> None:
        self.path = self.common


class Noisy(Retrace):
    """Draws from a generator that nobody seeds, in every other call."""

    def act(self, observation: Observation, goal: str) -> Any:
        noise = np.random.default_rng().normal(0, 0.05, 8) * (
            np.random.default_rng().random() < 0.5
        )
        return (super().act(observation, goal) + noise.astype(np.float32)).astype(np.float32)


class NoisyLeaky(Leaky):
    """Keeps its path, and shakes a little."""

    def act(self, observation: Observation, goal: str) -> Any:
        noise = np.random.default_rng().normal(0, 1e-4, 8)
        return (super().act(observation, goal) + noise).astype(np.float32)


class LeakyWorld(World):
    """Shows where the arm was at the end of the episode before."""

    left = np.float32(0.0)

    def reset(self, episode_id: str, demonstration: bool = True) -> Any:
        lesson, first, info = super().reset(episode_id, demonstration)
        state = first.state.copy()
        state[0] += self.left
        self.left = np.float32(self.answer[0] / 1000)
        return lesson, Observation(first.images, state), info


class BrokenWorld(World):
    """Begins where the arm was at the end of the episode before, too far off for a rollout."""

    began = False

    def reset(self, episode_id: str, demonstration: bool = True) -> Any:
        lesson, first, info = super().reset(episode_id, demonstration)
        began, self.began = self.began, True
        return lesson, Observation(first.images, first.state + np.float32(began)), info
