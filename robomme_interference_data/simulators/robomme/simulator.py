"""The official simulator: RoboMME, in an interpreter of its own."""

import os
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.errors import (
    InvalidOptionError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.subgoal import Subgoal, read_grounded
from robomme_interference_data.simulators.base import (
    ACTION_SIZE,
    CAMERAS,
    Begun,
    Demonstration,
    EpisodeInfo,
    Observation,
    Simulator,
    choose_cameras,
)
from robomme_interference_data.simulators.tabletop.episodes import episode_ids

from .process import Arrays, Process, find_python, installed_versions

ARMS = ("VideoUnmask", "PatternLock")
"""A family of each arm: with a gripper, with a stick. Their demonstrations are the shortest."""

FRAME_SHAPE = (256, 256, 3)

EPISODES = 5
"""Episodes that a process of RoboMME's plays before another takes its place.

Its memory grows as it plays, to 2.6 GB with a demonstration of 1077 frames, and shrinks little
afterwards. A new one starts with 1.5 GB, in the tenth part of the time of an episode or less.
"""


class RoboMMESimulator(Simulator):
    """See `Simulator`. RoboMME runs in a process of its own, which is started at once.

    Each episode gets a fresh environment, and RoboMME plays its demonstration at every reset:
    5 to 125 s on two cores. RoboMME returns no actions of its demonstrations, so
    `Demonstration.actions` is empty, `(0, 8)`. In the families with a stick (`PatternLock`,
    `RouteStick`) the gripper's opening is 0 throughout, and its action is without effect. RoboMME
    would let an episode go on after 1300 steps; here its status is then `timeout`. An image of
    another size than 256×256 is an `InvalidOptionError` of `reset`.

    RoboMME keeps memory of the episodes that it has played, so every few of them get a new
    process; what they return does not depend on it. When it dies, or takes too long, it is ended
    and the call raises `SimulatorCrashError`; the next reset starts another one.

    Args:
        python: RoboMME's interpreter; by default what `ROBOMME_PYTHON` says.
        cameras: Names of the cameras whose images are wanted: `front`, `wrist`. What nobody looks
            at is not drawn, which makes it up to 30 times as fast.
        subgoals: Whether `subgoal` can be asked. RoboMME finds places in its pictures, so the
            front view is then drawn at every step.
        answer_s: Seconds that it may take to start, and for each answer. Seen on machines with too
            much to do: 300 to start, 190 for a reset, 120 for a step.
    """

    name = "robomme"
    about = "the official simulator, RoboMME"
    remote = True
    settings = ("cameras", "python", "subgoals", "answer_s")
    scripted = False
    episode_s = 1800.0

    def __init__(
        self,
        python: str | os.PathLike[str] | None = None,
        cameras: Sequence[str] = CAMERAS,
        answer_s: float = 900.0,
        subgoals: bool = True,
    ):
        self._cameras, self._subgoals = choose_cameras(cameras), subgoals
        self._python, self._answer_s = find_python(python), answer_s
        self._process = Process(self._python, answer_s)
        self._subgoal: str | None = None

    @property
    def patches(self) -> tuple[str, ...]:
        """In what its ManiSkill was patched, in words: RoboMME requires a fork of that."""
        return self._process.patches

    @classmethod
    def versions(cls, python: str | None = None) -> dict[str, str]:
        """Return what is installed in its interpreter: `robomme`, `robomme_mani_skill`, and so on.

        And so for Python, sapien, torch and numpy, where known; with the commit, if it was
        installed from one. Read from the metadata of installed packages: RoboMME is not started.
        """
        return installed_versions(find_python(python))

    @classmethod
    def episodes(cls) -> list[EpisodeId]:
        """List its episodes: their numbers are those of the embedded suite."""
        return episode_ids()

    def act(self, policy: str, known: Mapping[int, str] | None = None) -> NDArray[np.float32]:
        """Refuse with `UnknownNameError`: RoboMME has no built-in policy."""
        raise UnknownNameError(
            f"the robomme simulator has no built-in policy {policy!r}",
            "oracle, guess and recall play on the embedded suite, tabletop, only.",
        )

    def subgoal(self) -> Subgoal:
        """Return RoboMME's own subgoal of now; see `Simulator.subgoal`."""
        self._running()
        if not self._subgoals:
            raise InvalidOptionError(
                "this simulator was made without subgoals", "Make it with subgoals=True."
            )
        if not (self._subgoal or "").strip():
            raise UnknownNameError(
                f"RoboMME in {self._python} tells no subgoal now",
                "Run without its subgoals, or with a newer RoboMME.",
            )
        return read_grounded(str(self._subgoal))

    @property
    def pid(self) -> int | None:
        """The id of RoboMME's process, or None if there is none."""
        return self._process.pid

    def close(self) -> None:
        """End RoboMME's process; further calls but `close` are errors."""
        super().close()
        self._process.end()

    def _begin(self, episode: EpisodeId, demonstration: bool) -> Begun:
        if episode.answer is not None:
            raise UnknownNameError(
                f"{episode}: RoboMME draws scene and answer together; it has no other answer",
                f"Give the episode itself, {episode.scene}, or use the simulator tabletop.",
            )
        known = self._process.families
        if episode.family not in known:
            raise UnknownNameError.among("family", episode.family, self.name, known)
        if self._process.pid is None or self._process.played >= EPISODES:
            self._process.end()
            self._process = Process(self._python, self._answer_s)
        self._process.played += 1
        about, arrays = self._process.call(
            "reset",
            family=episode.family,
            split=episode.split,
            index=episode.index,
            max_steps=MAX_STEPS,
            cameras=self._cameras,
            demonstration=demonstration,
            subgoals=self._subgoals,
        )
        self._subgoal = about["subgoal"]
        first = self._observation(arrays, self._cameras)
        images = {camera: arrays[camera][:-1] for camera in self._cameras if demonstration}
        no_actions = np.empty((0, ACTION_SIZE), np.float32)
        lesson = Demonstration(images, arrays["states"][:-1], no_actions)
        info = EpisodeInfo(tuple(about["goals"]), about["difficulty"], about["seed"], self.name)
        return lesson, first, info

    def _execute(
        self, episode: EpisodeId, action: NDArray[np.float32], observe: bool
    ) -> tuple[Observation, Status]:
        answer, arrays = self._process.call("step", action=action.tolist(), observe=observe)
        status = Status(answer["status"])
        if status is Status.ERROR:
            what = f"reports an error at step {self._steps}: {answer['message']}"
            raise self._process.error(what)
        self._subgoal = answer["subgoal"]
        return self._observation(arrays, self._cameras if observe else ()), status

    def _observation(self, arrays: Arrays, cameras: tuple[str, ...]) -> Observation:
        """Return the last frames and state as an observation of its own memory."""
        images = {camera: arrays[camera][-1].copy() for camera in cameras}
        for camera, image in images.items():
            if (image.shape, image.dtype) != (FRAME_SHAPE, np.uint8):
                raise InvalidOptionError(
                    f"RoboMME's {camera} camera in {self._python} gives {image.shape} "
                    f"{image.dtype}; expected {FRAME_SHAPE} uint8",
                    "Install the RoboMME whose recordings are published.",
                )
        return Observation(images, arrays["states"][-1].copy())
