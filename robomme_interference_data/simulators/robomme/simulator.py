"""The official simulator, RoboMME, in a separate Python environment."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import FAMILIES, MAX_STEPS, VALUE_NAMES
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.subgoal import Subgoal, read_grounded
from robomme_interference_data.simulators.episode import CAMERAS, EpisodeStart, Observation
from robomme_interference_data.simulators.remote.process import Arrays, RemoteProcess
from robomme_interference_data.simulators.remote.simulator import RemoteSimulator
from robomme_interference_data.simulators.sapien_renderer import renderer_in
from robomme_interference_data.simulators.tabletop.episodes import episode_ids
from robomme_interference_data.storage.cache import cache_folder

from . import versions as robomme_versions
from . import worker as robomme_worker
from .heldout import heldout_ids, heldout_setup
from .recorded_scene import read_scene
from .scenes import OfficialScene

FRAME_SHAPE = (256, 256, 3)

EPISODES = 5
"""Episodes that one process plays before a new one replaces it; five times as many without images.

Its memory grows up to 2.6 GB, with a demonstration of 1077 frames, and hardly shrinks afterwards;
without images it stays at 2.3 GB. A new process takes 1.5 GB, and 10 s.
"""


class RoboMMESimulator(RemoteSimulator):
    """The official simulator; see `RemoteSimulator`. The constructor starts RoboMME's process.

    RoboMME plays the demonstration at every reset, in a new environment.
    It does not return the demonstration's actions, so `Demonstration.actions` is `(0, 8)`. In the
    families with a stick (`PatternLock`, `RouteStick`) the gripper's opening is always 0, and its
    action has no effect. Its built-in policies act with the motion planners that play the
    demonstrations; they raise `SimulatorCrashError` if these find no motion, or if this version of
    RoboMME has other attributes than those that the answer is read from.

    A new process replaces the old one every few episodes, because RoboMME's memory grows; results
    do not depend on that.

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
    settings = ("python", "cameras", "subgoals", "answer_s")
    worker = Path(robomme_worker.__file__)
    needs = "RoboMME (https://github.com/RoboMME/robomme_benchmark)"
    oldest_python = (3, 10)
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
        self._subgoals = subgoals
        cache = str(cache_folder("robomme"))
        super().__init__(
            python, cameras, answer_s, subgoals=subgoals, max_steps=MAX_STEPS, cache=cache
        )
        drawn = bool(self._cameras or subgoals)
        self.episodes_per_process = EPISODES if drawn else 5 * EPISODES
        self._scene: OfficialScene | None = None
        self._answer: Any = None  # what the solvers act out
        self._follows = False  # whether it has got a subgoal

    @property
    def patches(self) -> tuple[str, ...]:
        """What was patched because the installed ManiSkill is not RoboMME's fork."""
        return tuple(self._found["patches"])

    @classmethod
    def versions(cls, python: str | None = None) -> dict[str, str]:
        """Return the versions in RoboMME's interpreter.

        They are of `robomme`, `robomme_mani_skill` and so on, and include Python, sapien, torch and
        numpy, the commit of a package that was installed from one, and `robomme_patches`, what is
        patched in ManiSkill.
        """
        program = Path(robomme_versions.__file__)
        return cls.interpreter(python).versions(program, (str(cache_folder("robomme")),))

    @classmethod
    def renderer(cls, python: str | None = None) -> str | None:
        """Return the renderer in RoboMME's interpreter; see `Simulator.renderer`."""
        return renderer_in(cls.interpreter(python).path)

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
        self.call("follow", text=text, points=points, seed=self._seed)
        return np.array(self.fact("action"), np.float32)

    def subgoal(self) -> Subgoal:
        """Return RoboMME's current subgoal; see `Simulator.subgoal`."""
        self._running()
        if not self._subgoals:
            raise InvalidOptionError(
                "this simulator was made without subgoals", "Make it with subgoals=True."
            )
        if not (self._subgoal or "").strip():
            raise UnknownNameError(
                f"RoboMME in {self._interpreter.path} provides no subgoal",
                "Run without subgoals, or with a newer RoboMME.",
            )
        return read_grounded(str(self._subgoal))

    def _start(self) -> RemoteProcess:
        process = super()._start()
        self._found, _ = process.call("describe")
        return process

    def _begin(self, episode: EpisodeId, frame_step: int) -> EpisodeStart:
        if episode.answer is not None:
            raise UnknownNameError(
                f"{episode}: RoboMME cannot combine a scene with another answer",
                f"Use the episode {episode.scene}, or the simulator tabletop.",
            )
        families = [family for family in self._found["families"] if family in FAMILIES]
        if episode.family not in families:
            raise UnknownNameError.among("family", episode.family, self.name, families)
        start = super()._begin(episode, frame_step)
        self._subgoal = self.fact("subgoal")
        return start

    def _chosen(self, episode: EpisodeId) -> dict[str, Any]:
        setup = heldout_setup(episode)
        # RoboMME knows no held-out split: it gets their seeds in place of those of another one.
        split = episode.split if setup is None else "test"
        return {**super()._chosen(episode), "split": split, "setup": setup}

    def _evidence(
        self, episode: EpisodeId, arrays: Arrays
    ) -> tuple[tuple[EvidenceSpan, ...] | None, str | None]:
        """Keep the scene; return the lesson's evidence and the scene as JSON, None if unknown."""
        facts = self._facts
        self._scene, self._answer, self._follows = None, None, False
        self._seed, self._unreadable = facts["seed"], facts.get("unreadable", "")
        if facts["scene"] is None:
            return None, None
        text = json.dumps(facts["scene"], separators=(",", ":"), sort_keys=True)
        self._scene = read_scene(episode.family, text, facts["difficulty"])
        return self._scene.evidence(arrays["moments"][:-1]), text

    def _act(
        self, policy: str, known: Mapping[int, str], answer: int | None
    ) -> NDArray[np.float32]:
        if self._answer is None:
            self._answer = self._choose(policy, known, answer)
        self.call("act", answer=self._answer)
        return np.array(self.fact("action"), np.float32)

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
        executed = super()._execute(episode, action, observe)
        self._subgoal = self.fact("subgoal")
        return executed

    def _observation(self, arrays: Arrays, cameras: Sequence[str]) -> Observation:
        seen = super()._observation(arrays, cameras)
        for camera, image in seen.images.items():
            if image.shape != FRAME_SHAPE or image.dtype != np.uint8:
                raise InvalidOptionError(
                    f"RoboMME's {camera} camera in {self._interpreter.path} gives {image.shape} "
                    f"{image.dtype}; expected {FRAME_SHAPE} uint8",
                    "Install the RoboMME version of the published recordings.",
                )
        return seen
