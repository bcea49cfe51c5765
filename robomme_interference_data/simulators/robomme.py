"""The official simulator: RoboMME, in an interpreter of its own."""

import os
import re
import shutil
import subprocess
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import Pipe
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingExtraError,
    SimulatorCrashError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.rollouts import Status
from robomme_interference_data.simulators import robomme_worker
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
from robomme_interference_data.subgoal import Subgoal, read_grounded

PYTHON_VARIABLE = "ROBOMME_PYTHON"
"""Environment variable with the path of RoboMME's interpreter."""

FRAME_SHAPE = (256, 256, 3)

EPISODES = 5
"""Episodes that a process of RoboMME's plays before another takes its place.

Its memory grows as it plays, to 2.6 GB with a demonstration of 1077 frames, and shrinks little
afterwards. A new one starts with 1.5 GB, in the tenth part of the time of an episode or less.
"""

_LOG_LINES = 20
"""How much of what a process printed last is kept, and shown when it breaks."""

_ENVIRONMENT = {
    "PYTHONFAULTHANDLER": "1",  # a crash in a library leaves a traceback
    "PYTHONSAFEPATH": "1",  # else the worker's neighbours would hide modules of the same names
    "PYTHONUNBUFFERED": "1",  # else what it printed last is lost when it dies
}

_INSTALL = (
    "Install RoboMME (https://github.com/RoboMME/robomme_benchmark) into an environment of its own "
    f"and give its Python: --robomme-python PATH, or export {PYTHON_VARIABLE}=PATH."
)

_CONTROL = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]|[\x00-\x08\x0b-\x1f\x7f]")
"""Colours and what else only a terminal should obey."""

Arrays = dict[str, NDArray[Any]]


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
        cameras: Names of the cameras whose images are wanted: `front`, `wrist`.
        answer_s: Seconds that it may take to start, and for each answer. Seen on machines with too
            much to do: 300 to start, 190 for a reset, 120 for a step.

    Raises:
        InvalidOptionError: No interpreter is given, none is at that path, or no such camera.
        MissingExtraError: That interpreter has no RoboMME, cannot import it, or has numpy 2.
        SimulatorCrashError: It died, or took too long to start.
    """

    name = "robomme"
    remote = True

    def __init__(
        self,
        python: str | os.PathLike[str] | None = None,
        cameras: Sequence[str] = CAMERAS,
        answer_s: float = 900.0,
    ):
        self._cameras = choose_cameras(cameras)
        self._python, self._answer_s = find_python(python), answer_s
        self._process = _Process(self._python, answer_s)
        self._subgoal: str | None = None

    @property
    def versions(self) -> dict[str, str]:
        """Versions in its interpreter: `robomme_python`, `robomme_numpy`, `robomme` if known."""
        return self._process.versions

    def act(self, policy: str, known: Mapping[int, str] | None = None) -> NDArray[np.float32]:
        """Refuse with `UnknownNameError`: RoboMME has no built-in policy."""
        raise UnknownNameError(
            f"the robomme simulator has no built-in policy {policy!r}",
            "oracle, guess and recall play on the embedded suite only: --simulator tabletop.",
        )

    def subgoal(self) -> Subgoal:
        """Return RoboMME's own subgoal of now; see `Simulator.subgoal`."""
        self._running()
        if not (self._subgoal or "").strip():
            raise UnknownNameError(
                f"RoboMME in {self._python} tells no subgoal now",
                "Run without --subgoals oracle, or with a newer RoboMME.",
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
            self._process = _Process(self._python, self._answer_s)
        self._process.played += 1
        about, arrays = self._process.call(
            "reset",
            family=episode.family,
            split=episode.split,
            index=episode.index,
            max_steps=MAX_STEPS,
            cameras=self._cameras,
            demonstration=demonstration,
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
                    "Install the ManiSkill that RoboMME's pyproject.toml names, not the one on "
                    "the package index.",
                )
        return Observation(images, arrays["states"][-1].copy())


class _Process:
    """`robomme_worker.py` in RoboMME's interpreter; see `RoboMMESimulator` for what it raises."""

    def __init__(self, python: str, answer_s: float):
        self._python, self._answer_s = python, answer_s
        self._log: deque[bytes] = deque(maxlen=_LOG_LINES)
        self._channel, theirs = Pipe()
        try:
            with theirs:
                self._process = subprocess.Popen(
                    [python, robomme_worker.__file__, str(theirs.fileno())],
                    pass_fds=[theirs.fileno()],
                    env={**os.environ, **_ENVIRONMENT},
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                )
        except OSError as error:
            self._channel.close()
            raise InvalidOptionError(
                f"{python} cannot be run as RoboMME's Python: {error}", _INSTALL
            ) from error
        self.pid: int | None = self._process.pid
        self.played = 0
        self._logger = threading.Thread(target=self._keep_log, daemon=True)
        self._logger.start()
        hello, _ = self._answer("start")
        if "problem" in hello:
            self.end()
            raise MissingExtraError(f"{python} cannot run RoboMME: {hello['problem']}", _INSTALL)
        self.families: tuple[str, ...] = tuple(hello["families"])
        self.versions: dict[str, str] = hello["versions"]

    def call(self, call: str, **arguments: Any) -> tuple[dict[str, Any], Arrays]:
        """Call one of the worker's functions, `reset` or `step`.

        Raises:
            UnknownNameError: RoboMME has no such episode.
            SimulatorCrashError: The call failed, the process died, or it took too long.
        """
        with suppress(OSError):  # it died: the answer will say so
            robomme_worker.send(self._channel, {"call": call, **arguments})
        answer, found = self._answer(call)
        if "unknown" in answer:
            raise UnknownNameError(f"no such episode: in robomme {answer['unknown']}")
        if "failed" in answer:
            raise self.error(f"failed during {call}: {answer['failed']}")
        return answer, found

    def _answer(self, call: str) -> tuple[dict[str, Any], Arrays]:
        try:
            if not self._channel.poll(self._answer_s):
                self.end(now=True)
                raise self.error(
                    f"took more than {self._answer_s:g} s to {call}; its process was ended"
                )
            return robomme_worker.receive(self._channel)
        except (EOFError, OSError) as error:
            self.end()
            raise self.error(f"died during {call}, exit code {self._process.returncode}") from error
        except BaseException:  # such as Ctrl-C: what comes later would be taken for another answer
            self.end(now=True)
            raise

    def error(self, what: str) -> SimulatorCrashError:
        """Return an error that shows what was printed last, without a terminal's escapes."""
        if self.pid is None:
            self._logger.join(5)  # until it has read all
        lines = [line.decode(errors="replace").rstrip() for line in list(self._log)]
        return SimulatorCrashError(
            f"the robomme simulator in {self._python} {what}",
            _CONTROL.sub("", "\n".join(["It printed last:", *lines])) if lines else None,
        )

    def end(self, *, now: bool = False) -> None:
        """End the process, if it runs."""
        self.pid = None
        self._channel.close()  # the worker ends when it reads the end of it
        if now:
            self._process.kill()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _keep_log(self) -> None:
        """Keep the last lines that it prints, until it ends."""
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            self._log.extend(lines)


def find_python(python: str | os.PathLike[str] | None) -> str:
    """Return the absolute path of the interpreter that is given, or that the environment names.

    Args:
        python: A path; or text, which may also be the name of a program, as in a shell.

    Raises:
        InvalidOptionError: None is given, or there is none at that path.
    """
    given = os.fspath(python) if python is not None else os.environ.get(PYTHON_VARIABLE, "")
    if not given:
        raise InvalidOptionError(
            "the robomme simulator needs RoboMME's own interpreter, and none is given", _INSTALL
        )
    # As text: `Path` would take a "./" away, and the name of a program be left.
    path = os.path.expanduser(given)  # noqa: PTH111
    if isinstance(python, os.PathLike):
        path = os.path.abspath(path)  # noqa: PTH100
    if (found := shutil.which(path)) is None:
        raise InvalidOptionError(f"{given} is not an executable file", _INSTALL)
    # Not resolved: the interpreter of a virtual environment is a link.
    return os.path.abspath(found)  # noqa: PTH100
