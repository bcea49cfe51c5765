"""The embedded suite as a simulator: nine families in one environment, an episode at a time."""

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.errors import SimulatorCrashError, UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.records import Status
from robomme_interference_data.simulators.base import (
    CAMERAS,
    Demonstration,
    EpisodeInfo,
    Observation,
    action_array,
    camera_names,
)
from robomme_interference_data.simulators.tabletop.env import TabletopEnv
from robomme_interference_data.simulators.tabletop.episodes import seed_of

__all__ = ["TabletopSimulator"]

POLICIES = ("oracle", "guess")


class TabletopSimulator:
    """See `Simulator`. Keep to one in a process: an executor's workers are for more.

    Args:
        render: Whether to draw. Without, observations hold no images, and episodes run several
            times as fast: for policies that do not look.
        cameras: Names of the cameras to draw; fewer are faster.

    Raises:
        UnknownNameError: There is no such camera.
        NoRendererError: No Vulkan device of this machine can render.
    """

    name = "tabletop"

    def __init__(self, render: bool = True, cameras: Sequence[str] = CAMERAS):
        self._cameras = camera_names(self.name, cameras)
        # Pictures come straight from the cameras, so ManiSkill need not make observations too.
        self._env = TabletopEnv(render=render, obs_mode="none")
        self._env.observe(self._cameras)  # the first picture is slow: shaders are compiled
        self._steps: int | None = None
        self._closed = False

    def reset(
        self, episode_id: str, demonstration: bool = True
    ) -> tuple[Demonstration, Observation, EpisodeInfo]:
        """Start an episode; see `Simulator.reset`."""
        self._steps = None  # an episode that is refused, or breaks, leaves none to step
        if self._closed:
            raise SimulatorCrashError("the simulator is closed", "Make another one.")
        episode = EpisodeId.parse(str(episode_id))
        seed = seed_of(episode)
        self._env.family = episode.family
        self._env.demonstrated = self._cameras if demonstration else ()
        _, info = self._env.reset(seed=seed)
        self._steps = 0
        about = EpisodeInfo(info["goal"], info["goals"], info["difficulty"], seed, self.name)
        return info["demonstration"], self._env.observe(self._cameras), about

    def step(self, action: NDArray[np.float32], observe: bool = True) -> tuple[Observation, Status]:
        """Execute one action; see `Simulator.step`."""
        steps = self._running()
        self._env._step_action(action_array(action))
        self._steps = steps + 1
        status = self._env.status
        if status is Status.ONGOING and self._steps >= MAX_STEPS:
            status = self._env.status = Status.TIMEOUT
        return self._env.observe(self._cameras if observe else ()), status

    def act(self, policy: str) -> NDArray[np.float32]:
        """Return the next action of `oracle` or `guess`; see `Simulator.act`."""
        self._running()
        if policy not in POLICIES:
            raise UnknownNameError.among("built-in policy", policy, "tabletop", POLICIES)
        return self._env.act(policy)

    def close(self) -> None:
        """Release the scene; further calls but `close` are errors."""
        self._steps, self._closed = None, True
        self._env.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _running(self) -> int:
        if self._closed:
            raise SimulatorCrashError("the simulator is closed", "Make another one.")
        if self._steps is None:
            raise SimulatorCrashError(
                "the simulator runs no episode", "Call reset('<Family>/<split>/<index>') first."
            )
        return self._steps
