"""The official simulator, RoboMME, in a separate Python environment."""

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import FAMILIES, MAX_STEPS, VALUE_NAMES
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.subgoal import Subgoal, read_grounded
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import (
    ACTION_SIZE,
    CAMERAS,
    Demonstration,
    EpisodeInfo,
    EpisodeStart,
    Observation,
    choose_cameras,
)
from robomme_interference_data.simulators.tabletop.episodes import episode_ids

from .heldout import heldout_ids, heldout_setup
from .process import Arrays, Process, find_python, installed_versions
from .recorded_scene import read_scene
from .scenes import OfficialScene

FRAME_SHAPE = (256, 256, 3)

EPISODES = 5
"""Episodes that one process plays before a new one replaces it; five times as many without images.

Its memory grows up to 2.6 GB, with a demonstration of 1077 frames, and hardly shrinks afterwards;
without images it stays at 2.3 GB. A new process takes 1.5 GB, and 10 s.
"""


class RoboMMESimulator(Simulator):
    """The official simulator; see `Simulator`. The constructor starts RoboMME's process.

    RoboMME plays the demonstration at every reset, in a new environment.
    It does not return the demonstration's actions, so `Demonstration.actions` is `(0, 8)`. In the
    families with a stick (`PatternLock`, `RouteStick`) the gripper's opening is always 0, and its
    action has no effect. Its built-in policies act with the motion planners that play the
    demonstrations; they raise `SimulatorCrashError` if these find no motion, or if this version of
    RoboMME has other attributes than those that the answer is read from.

    A new process replaces the old one every few episodes, because RoboMME's memory grows; results
    do not depend on that. If the process dies or takes too long, it is ended and the call raises
    `SimulatorCrashError`; the next reset starts a new one.

    Args:
        python: RoboMME's interpreter; by default the environment variable `ROBOMME_PYTHON`.
        cameras: Names of the cameras to render: `front`, `wrist`. Without any, it is up to 30
            times as fast.
        answer_s: Seconds that it may take to start, and for each call. On overloaded machines, up
            to 300 s to start, 190 s for a reset and 120 s for a step occur.
        subgoals: Whether `subgoal` can be called. RoboMME locates points in its images, so it then
            renders the front camera when a subgoal begins.

    Raises:
        InvalidOptionError: The interpreter is missing or does not run, or a camera is unknown.
        MissingExtraError: The interpreter cannot run RoboMME.
        SimulatorCrashError: RoboMME does not start.
    """

    state_names = VALUE_NAMES
    action_names = VALUE_NAMES
    name = "robomme"
    about = "the official simulator, RoboMME"
    settings = ("cameras", "subgoals", "answer_s")
    own_episodes = True
    try_out = False
    episode_s = 1800.0
    worker_gb = 2.5

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
        self._scene: OfficialScene | None = None
        self._answer: Any = None  # what the solvers act out
        self._follows = False  # whether it has got a subgoal

    @property
    def patches(self) -> tuple[str, ...]:
        """What was patched because the installed ManiSkill is not RoboMME's fork."""
        return self._process.patches

    @classmethod
    def versions(cls) -> dict[str, str]:
        """Return the versions in the interpreter `ROBOMME_PYTHON`.

        They are of `robomme`, `robomme_mani_skill` and so on, and include Python, sapien, torch and
        numpy, and the commit of a package that was installed from one.
        """
        return installed_versions(find_python(None))

    @classmethod
    def episodes(cls) -> list[EpisodeId]:
        """Return its episodes: the ids of the embedded suite, and those of the held-out split."""
        return sorted([*episode_ids(), *heldout_ids()])

    @classmethod
    def scene(
        cls, family: str, seed: int, difficulty: str, recorded: str | None = None
    ) -> OfficialScene | None:
        """Return the recorded scene; None if none was recorded. See `Simulator.scene`."""
        return None if recorded is None else read_scene(family, recorded, difficulty)

    def follow_subgoal(self, subgoal: Subgoal | None) -> NDArray[np.float32]:
        """Return the next action towards a subgoal; see `Simulator.follow_subgoal`.

        The words are RoboMME's own, with or without points. A subgoal that is not understood
        changes nothing.
        """
        self._running()
        if subgoal is None and not self._follows:
            return self.act("guess")
        self._known_scene()
        self._follows = True
        text = None if subgoal is None else subgoal.text
        points = [] if subgoal is None else [list(point) for point in subgoal.points]
        response, _ = self._process.call("follow", text=text, points=points, seed=self._seed)
        return np.array(response["action"], np.float32)

    def subgoal(self) -> Subgoal:
        """Return RoboMME's current subgoal; see `Simulator.subgoal`."""
        self._running()
        if not self._subgoals:
            raise InvalidOptionError(
                "this simulator was made without subgoals", "Make it with subgoals=True."
            )
        if not (self._subgoal or "").strip():
            raise UnknownNameError(
                f"RoboMME in {self._python} provides no subgoal",
                "Run without subgoals, or with a newer RoboMME.",
            )
        return read_grounded(str(self._subgoal))

    @property
    def pid(self) -> int | None:
        """The id of RoboMME's process, or None if there is none."""
        return self._process.pid

    def close(self) -> None:
        """End RoboMME's process; afterwards, every method except `close` raises."""
        super().close()
        self._process.end()

    def _begin(self, episode: EpisodeId, frame_step: int) -> EpisodeStart:
        if episode.answer is not None:
            raise UnknownNameError(
                f"{episode}: RoboMME cannot combine a scene with another answer",
                f"Use the episode {episode.scene}, or the simulator tabletop.",
            )
        families = [family for family in self._process.families if family in FAMILIES]
        if episode.family not in families:
            raise UnknownNameError.among("family", episode.family, self.name, families)
        setup = heldout_setup(episode)
        most = EPISODES if self._cameras or self._subgoals else 5 * EPISODES
        if self._process.pid is None or self._process.played >= most:
            self._process.end()
            self._process = Process(self._python, self._answer_s)
        self._process.played += 1
        facts, arrays = self._process.call(
            "reset",
            family=episode.family,
            # RoboMME knows no held-out split: it gets their seeds in place of those of another one.
            split=episode.split if setup is None else "test",
            index=episode.index,
            setup=setup,
            max_steps=MAX_STEPS,
            cameras=self._cameras,
            frame_step=frame_step,
            subgoals=self._subgoals,
        )
        self._subgoal = facts["subgoal"]
        first = self._observation(arrays, self._cameras)
        images = {camera: arrays[camera][:-1] for camera in self._cameras if frame_step}
        no_actions = np.empty((0, ACTION_SIZE), np.float32)
        evidence = self._read_facts(facts, episode.family, arrays)
        lesson = Demonstration(images, arrays["states"][:-1], no_actions, *evidence)
        info = EpisodeInfo(tuple(facts["goals"]), facts["difficulty"], facts["seed"], self.name)
        return lesson, first, info

    def _read_facts(
        self, facts: dict[str, Any], family: str, arrays: Arrays
    ) -> tuple[tuple[EvidenceSpan, ...] | None, str | None]:
        """Keep the scene; return the lesson's evidence and the scene as JSON, None if unknown."""
        self._scene, self._answer, self._follows = None, None, False
        self._seed, self._unreadable = facts["seed"], facts.get("unreadable", "")
        if facts["scene"] is None:
            return None, None
        text = json.dumps(facts["scene"], separators=(",", ":"), sort_keys=True)
        self._scene = read_scene(family, text, facts["difficulty"])
        return self._scene.evidence(arrays["moments"][:-1]), text

    def _act(
        self, policy: str, known: Mapping[int, str], answer: int | None
    ) -> NDArray[np.float32]:
        if self._answer is None:
            self._answer = self._choose(policy, known, answer)
        response, _ = self._process.call("act", answer=self._answer)
        return np.array(response["action"], np.float32)

    def _choose(self, policy: str, known: Mapping[int, str], answer: int | None) -> Any:
        """Return the answer that a policy acts out."""
        scene = self._known_scene()
        if policy == "oracle":
            return scene.own_answer(self._seed)
        if policy == "answer":
            count = len(scene.answers)
            if answer is None or not 0 <= answer < count:
                raise InvalidOptionError.expected("answer", answer, f"0 to {count - 1}")
            return scene.answers[answer]
        return scene.recalled(known if policy == "recall" else {}, self._seed)

    def _known_scene(self) -> OfficialScene:
        if self._scene is None:
            raise self._process.error(f"hides its answers: {self._unreadable}")
        return self._scene

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
        """Copy the last frames and state into an observation."""
        images = {camera: arrays[camera][-1].copy() for camera in cameras}
        for camera, image in images.items():
            if (image.shape, image.dtype) != (FRAME_SHAPE, np.uint8):
                raise InvalidOptionError(
                    f"RoboMME's {camera} camera in {self._python} gives {image.shape} "
                    f"{image.dtype}; expected {FRAME_SHAPE} uint8",
                    "Install the RoboMME version of the published recordings.",
                )
        return Observation(images, arrays["states"][-1].copy())
