"""The official simulator: RoboMME, in an interpreter of its own."""

import os
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.errors import (
    InvalidOptionError,
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
    action_array,
    camera_names,
)
from robomme_interference_data.simulators.robomme_process import RoboMMEProcess, find_python

__all__ = ["RoboMMESimulator"]

FRAME_SHAPE = (256, 256, 3)

EPISODES = 5
"""Episodes that a worker process plays before another takes its place.

Its memory grows as it plays, to 2.6 GB with a demonstration of 1077 frames, and shrinks little
afterwards. A new one starts with 1.5 GB, in the tenth part of the time of an episode or less.
"""


class RoboMMESimulator:
    """See `Simulator`. RoboMME runs in a worker process, which is started at once.

    Each episode gets a fresh environment, and RoboMME plays its demonstration at every reset:
    5 to 125 s on two cores. RoboMME returns no actions of its demonstrations, so
    `Demonstration.actions` is empty, `(0, 8)`. In the families with a stick (`PatternLock`,
    `RouteStick`) the gripper's opening is 0 throughout, and its action is without effect. RoboMME
    would let an episode go on after 1300 steps; here its status is then `timeout`.

    RoboMME keeps memory of the episodes that it has played, so every few of them get a new worker;
    what they return does not depend on it. When a worker dies, or takes too long, it is ended and
    the call raises `SimulatorCrashError`; the next reset starts another one.

    Args:
        python: RoboMME's interpreter; by default what `ROBOMME_PYTHON` says.
        cameras: Names of the cameras whose images are wanted: `front`, `wrist`.
        start_s: Seconds that the worker may take to start and import RoboMME.
        reset_s: Seconds that a reset may take.
        step_s: Seconds that a step may take. It takes a fraction of one, but on a machine with
            too much to do it was once over 120.

    Raises:
        InvalidOptionError: No interpreter is given, or there is none at that path.
        UnknownNameError: There is no such camera.
        MissingExtraError: That interpreter has no RoboMME, cannot import it, or has numpy 2.
        SimulatorCrashError: It died, or took too long to start.
    """

    name = "robomme"
    remote = True

    def __init__(
        self,
        python: str | os.PathLike[str] | None = None,
        cameras: Sequence[str] = CAMERAS,
        start_s: float = 300.0,
        reset_s: float = 900.0,
        step_s: float = 600.0,
    ):
        self._cameras = camera_names(self.name, cameras)
        self._python = find_python(python)
        self._limits = {"start": start_s, "reset": reset_s, "step": step_s}
        self._episode: EpisodeId | None = None
        self._steps = self._played = 0
        self._closed = False
        self._worker = RoboMMEProcess(self._python, self._limits)

    @property
    def families(self) -> tuple[str, ...]:
        """RoboMME's task families."""
        return self._worker.families

    @property
    def versions(self) -> dict[str, str]:
        """Versions in its interpreter: `robomme_python`, `robomme_numpy`, `robomme` if known."""
        return self._worker.versions

    def reset(
        self, episode_id: str, demonstration: bool = True
    ) -> tuple[Demonstration, Observation, EpisodeInfo]:
        """Start an episode; see `Simulator.reset`.

        Raises:
            InvalidOptionError: RoboMME draws images of another size than 256×256.
        """
        self._episode = None  # an episode that is refused, or breaks, leaves none to step
        if self._closed:
            raise SimulatorCrashError("the simulator is closed", "Make another one.")
        episode = EpisodeId.parse(str(episode_id))
        if episode.family not in self.families:
            raise UnknownNameError(
                f"robomme has no family {episode.family!r}", nearest(episode.family, self.families)
            )
        if self._worker.pid is None or self._played >= EPISODES:
            self._worker.end()
            self._worker = RoboMMEProcess(self._python, self._limits)
            self._played = 0
        self._played += 1
        about, arrays = self._worker.call(
            "reset",
            family=episode.family,
            split=episode.split,
            index=episode.index,
            max_steps=MAX_STEPS,
            cameras=self._cameras,
            demonstration=demonstration,
        )
        states, first = arrays["states"], self._observation(arrays)
        lesson = Demonstration(
            {camera: arrays[camera][:-1] for camera in self._cameras} if demonstration else {},
            states[:-1],
            np.empty((0, 8), np.float32),
        )
        self._episode, self._steps = episode, 0
        goals = tuple(about["goals"])
        return (
            lesson,
            first,
            EpisodeInfo(goals[0], goals, about["difficulty"], about["seed"], self.name),
        )

    def step(self, action: NDArray[np.float32], observe: bool = True) -> tuple[Observation, Status]:
        """Execute one action; see `Simulator.step`.

        Raises:
            SimulatorCrashError: Also where RoboMME's own status is `error`, with its message.
        """
        if self._episode is None:
            raise SimulatorCrashError(
                "the simulator runs no episode", "Call reset('<Family>/<split>/<index>') first."
            )
        action = action_array(action)
        running, self._episode = self._episode, None  # an episode that breaks is over
        where = str(running)
        answer, arrays = self._worker.call(
            "step", {"action": action[None]}, where=where, observe=observe
        )
        if answer["status"] == Status.ERROR:
            raise self._worker.error(
                f"reports an error at step {self._steps + 1}: {answer['message']}", where
            )
        self._steps += 1
        status = Status(answer["status"])
        if status is Status.ONGOING and self._steps >= MAX_STEPS:
            status = Status.TIMEOUT
        if status is Status.ONGOING:
            self._episode = running
        return self._observation(arrays, observe), status

    def act(self, policy: str) -> NDArray[np.float32]:
        """Refuse: RoboMME has no built-in policy.

        Raises:
            UnknownNameError: Always.
        """
        raise UnknownNameError(
            f"the robomme simulator has no built-in policy {policy!r}",
            "oracle and guess play on the embedded suite only: --simulator tabletop.",
        )

    @property
    def pid(self) -> int | None:
        """The worker's process id, or None if there is none."""
        return self._worker.pid

    def close(self) -> None:
        """End the worker."""
        self._closed = True
        self._episode = None
        self._worker.end()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _observation(self, arrays: dict[str, NDArray[Any]], observe: bool = True) -> Observation:
        """Return the last frames and state as an observation of its own memory."""
        cameras = self._cameras if observe else ()
        for camera in cameras:
            if arrays[camera].shape[1:] != FRAME_SHAPE or arrays[camera].dtype != np.uint8:
                raise InvalidOptionError(
                    f"RoboMME's {camera} camera in {self._python} gives "
                    f"{arrays[camera].shape[1:]} {arrays[camera].dtype}; expected {FRAME_SHAPE} "
                    "uint8",
                    "Install the ManiSkill that RoboMME's pyproject.toml names, not the one on "
                    "the package index.",
                )
        return Observation(
            {camera: arrays[camera][-1].copy() for camera in cameras}, arrays["states"][-1].copy()
        )
