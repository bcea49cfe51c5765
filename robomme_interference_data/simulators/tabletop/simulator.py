"""The embedded suite as a simulator: nine families in one environment, an episode at a time."""

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.errors import (
    InvalidOptionError,
    NoRendererError,
    SimulatorCrashError,
    UnknownNameError,
    nearest,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.base import (
    CAMERAS,
    Demonstration,
    EpisodeInfo,
    Observation,
    Status,
)
from robomme_interference_data.simulators.tabletop.env import TabletopEnv
from robomme_interference_data.simulators.tabletop.episodes import seed_of

__all__ = ["TabletopSimulator"]

POLICIES = ("oracle", "guess")


class TabletopSimulator:
    """See `Simulator`. Keep to one in a process: `worker.RemoteSimulator` is for more.

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
        for camera in cameras:
            if camera not in CAMERAS:
                raise UnknownNameError(
                    f"the tabletop simulator has no camera {camera!r}", nearest(camera, CAMERAS)
                )
        self._cameras = tuple(name for name in CAMERAS if name in cameras)
        _find_renderer()  # sapien wants one even where nothing is drawn
        # Pictures come straight from the cameras, so ManiSkill need not make observations too.
        self._env = TabletopEnv(render=render, obs_mode="none")
        self._env.observe(self._cameras)  # the first picture is slow: shaders are compiled
        self._steps: int | None = None

    def reset(
        self, episode_id: str, demonstration: bool = True
    ) -> tuple[Demonstration, Observation, EpisodeInfo]:
        """Start an episode; see `Simulator.reset`."""
        episode = EpisodeId.parse(str(episode_id))
        seed = seed_of(episode)
        self._steps = None
        self._env.family = episode.family
        self._env.demonstrated = self._cameras if demonstration else ()
        _, info = self._env.reset(seed=seed)
        self._steps = 0
        about = EpisodeInfo(info["goal"], info["goals"], info["difficulty"], seed, self.name)
        return info["demonstration"], self._env.observe(self._cameras), about

    def step(self, action: NDArray[np.float32], observe: bool = True) -> tuple[Observation, Status]:
        """Execute one action; see `Simulator.step`."""
        steps = self._running()
        action = np.asarray(action, dtype=np.float32)
        if action.shape != (8,) or not np.isfinite(action).all():
            raise InvalidOptionError(
                f"an action is 8 finite numbers, not {action.shape} {action.tolist()}",
                "Expected 7 absolute joint targets in rad, then the gripper, −1 closed to 1 open.",
            )
        self._env._step_action(action)
        self._steps = steps + 1
        status = self._env.status
        if status is Status.ONGOING and self._steps >= MAX_STEPS:
            status = self._env.status = Status.TIMEOUT
        return self._env.observe(self._cameras if observe else ()), status

    def act(self, policy: str) -> NDArray[np.float32]:
        """Return the next action of `oracle` or `guess`; see `Simulator.act`."""
        self._running()
        if policy not in POLICIES:
            raise UnknownNameError(f"no built-in policy {policy!r}", nearest(policy, POLICIES))
        return self._env.act(policy)

    @property
    def chance(self) -> float:
        """Probability that a guess at the hidden answer of the present episode is right."""
        self._running()
        return self._env.chance

    def close(self) -> None:
        """Release the scene."""
        self._steps = None
        self._env.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _running(self) -> int:
        if self._steps is None:
            raise SimulatorCrashError(
                "the simulator runs no episode", "Call reset('<Family>/<split>/<index>') first."
            )
        return self._steps


def _find_renderer() -> None:
    import sapien

    try:
        sapien.render.RenderSystem(sapien.Device("cpu"))
    except RuntimeError as error:
        raise NoRendererError(
            f"no Vulkan device on this machine can render: {error}",
            "Install a software driver: sudo make vulkan. Without the repository: libvulkan1 and "
            "mesa-vulkan-drivers 24.3 or newer (Debian 12 has it in bookworm-backports).",
        ) from error
