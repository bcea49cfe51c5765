"""The official simulator: RoboMME, in an interpreter of its own."""

import os
import shutil
import socket
import subprocess
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    MissingExtraError,
    SimulatorCrashError,
    UnknownNameError,
    nearest,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators import robomme_worker
from robomme_interference_data.simulators.base import (
    Demonstration,
    EpisodeInfo,
    Observation,
    Status,
)

__all__ = ["PYTHON_VARIABLE", "RoboMMESimulator"]

PYTHON_VARIABLE = "ROBOMME_PYTHON"
"""Environment variable with the path of RoboMME's interpreter."""

CAMERAS = ("front", "wrist")

FRAME_SHAPE = (256, 256, 3)

_LOG_LINES = 20
"""How much of what the worker printed last is kept, and shown when it breaks."""

_ENVIRONMENT = {
    "PYTHONFAULTHANDLER": "1",  # a crash in a library leaves a traceback
    "PYTHONSAFEPATH": "1",  # else the worker's neighbours would hide modules of the same names
    "PYTHONUNBUFFERED": "1",  # else what it printed last is lost when it dies
}

_INSTALL = (
    "Install RoboMME (https://github.com/RoboMME/robomme_benchmark) into an environment of its own "
    f"and give its Python: --robomme-python PATH, or export {PYTHON_VARIABLE}=PATH."
)


class RoboMMESimulator:
    """See `Simulator`. RoboMME runs in a worker process, which is started at once.

    Each episode gets a fresh environment, and RoboMME plays its demonstration at every reset:
    5 to 125 s on two cores. RoboMME returns no actions of its demonstrations, so
    `Demonstration.actions` is empty, `(0, 8)`. In the families with a stick (`PatternLock`,
    `RouteStick`) the gripper's opening is 0 throughout, and its action is without effect. RoboMME
    would let an episode go on after 1300 steps; here its status is then `timeout`.

    When the worker dies, or takes too long, it is ended and the call raises
    `SimulatorCrashError`; the next reset starts another one.

    Args:
        python: RoboMME's interpreter; by default what `ROBOMME_PYTHON` says.
        cameras: Names of the cameras whose images are wanted: `front`, `wrist`.
        start_s: Seconds that the worker may take to start and import RoboMME.
        reset_s: Seconds that a reset may take.
        step_s: Seconds that a step may take.

    Raises:
        InvalidOptionError: No interpreter is given, or there is none at that path.
        UnknownNameError: There is no such camera.
        MissingExtraError: That interpreter has no RoboMME, cannot import it, or has numpy 2.
        SimulatorCrashError: It died, or took too long to start.
    """

    name = "robomme"

    def __init__(
        self,
        python: str | os.PathLike[str] | None = None,
        cameras: Sequence[str] = CAMERAS,
        start_s: float = 300.0,
        reset_s: float = 900.0,
        step_s: float = 120.0,
    ):
        for camera in cameras:
            if camera not in CAMERAS:
                raise UnknownNameError(
                    f"the robomme simulator has no camera {camera!r}", nearest(camera, CAMERAS)
                )
        self._cameras = tuple(camera for camera in CAMERAS if camera in cameras)
        self._python = _find(python)
        self._limits = {"start": start_s, "reset": reset_s, "step": step_s}
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._log: deque[bytes] = deque(maxlen=_LOG_LINES)
        self._logger: threading.Thread | None = None
        self._episode: EpisodeId | None = None
        self._steps = 0
        self._closed = False
        self.families: tuple[str, ...] = ()
        self._start()

    def reset(
        self, episode_id: str, demonstration: bool = True
    ) -> tuple[Demonstration, Observation, EpisodeInfo]:
        """Start an episode; see `Simulator.reset`.

        Raises:
            InvalidOptionError: RoboMME draws images of another size than 256×256.
        """
        episode = EpisodeId.parse(str(episode_id))
        if episode.family not in self.families:
            raise UnknownNameError(
                f"robomme has no family {episode.family!r}", nearest(episode.family, self.families)
            )
        if self._closed:
            raise SimulatorCrashError("the simulator is closed", "Make another one.")
        self._episode = None
        if self._process is None:
            self._start()
        about, arrays = self._call(
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
        action = np.asarray(action, dtype=np.float32)
        if action.shape != (8,) or not np.isfinite(action).all():
            raise InvalidOptionError(
                f"an action is 8 finite numbers, not {action.shape} {action.tolist()}",
                "Expected 7 absolute joint targets in rad, then the gripper, −1 closed to 1 open.",
            )
        answer, arrays = self._call("step", {"action": action[None]}, observe=observe)
        if answer["status"] == Status.ERROR:
            raise self._broken(f"reports an error at step {self._steps + 1}: {answer['message']}")
        self._steps += 1
        status = Status(answer["status"])
        if status is Status.ONGOING and self._steps >= MAX_STEPS:
            status = Status.TIMEOUT
        if status is not Status.ONGOING:
            self._episode = None
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
        return None if self._process is None else self._process.pid

    def close(self) -> None:
        """End the worker."""
        self._closed = True
        self._end()

    def _end(self) -> None:
        process, channel = self._process, self._channel
        self._process = self._channel = self._episode = None
        if channel is not None:
            channel.close()  # the worker ends when it reads the end of its socket
        if process is not None:
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _start(self) -> None:
        """Start the worker and hear what its interpreter has."""
        self._channel, theirs = socket.socketpair()
        try:
            with theirs:
                self._process = subprocess.Popen(
                    [self._python, robomme_worker.__file__, str(theirs.fileno())],
                    pass_fds=[theirs.fileno()],
                    env={**os.environ, **_ENVIRONMENT},
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                )
        except OSError as error:
            self._end()
            raise InvalidOptionError(
                f"{self._python} cannot be run as RoboMME's Python: {error}", _INSTALL
            ) from error
        self._log.clear()
        self._logger = threading.Thread(target=_keep, args=(self._process, self._log), daemon=True)
        self._logger.start()
        hello, _ = self._answer("start")
        if "problem" in hello:
            self._end()
            raise MissingExtraError(
                f"{self._python} cannot run RoboMME: {hello['problem']}", _INSTALL
            )
        self.families = tuple(hello["families"])

    def _call(
        self, call: str, arrays: dict[str, NDArray[Any]] | None = None, **arguments: Any
    ) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        assert self._channel is not None
        with suppress(OSError):  # it died: the answer will say so
            robomme_worker.send(self._channel, {"call": call, **arguments}, arrays)
        answer, found = self._answer(call)
        if "unknown" in answer:
            raise UnknownNameError(f"no such episode: in robomme {answer['unknown']}")
        if "failed" in answer:
            raise self._broken(f"failed during {call}: {answer['failed']}")
        return answer, found

    def _answer(self, call: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        assert self._channel is not None and self._process is not None
        limit = self._limits[call]
        self._channel.settimeout(limit)
        try:
            return robomme_worker.receive(self._channel)
        except TimeoutError:
            self._process.kill()
            raise self._broken(
                f"took more than {limit:g} s to {call}; its process was ended", ended=True
            ) from None
        except (EOFError, ConnectionError) as error:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(5)
            code = self._process.returncode
            raise self._broken(f"died during {call}, exit code {code}", ended=True) from error
        except BaseException:  # such as Ctrl-C: an answer half read leaves the two out of step
            self._process.kill()
            self._end()
            raise

    def _broken(self, what: str, ended: bool = False) -> InterferenceError:
        """Return the error for what went wrong; no episode runs any more."""
        episode = "" if self._episode is None else f" ({self._episode})"
        self._episode = None
        if ended:
            self._end()
            if self._logger is not None:
                self._logger.join(5)  # until it has read what was printed last
        lines = [line.decode(errors="replace").rstrip() for line in list(self._log)]
        return SimulatorCrashError(
            f"the robomme simulator in {self._python} {what}{episode}",
            "\n".join(["It printed last:", *lines]) if lines else None,
        )

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


def _find(python: str | os.PathLike[str] | None) -> str:
    """Return the path of the interpreter."""
    given = os.fspath(python) if python is not None else os.environ.get(PYTHON_VARIABLE, "")
    if not given:
        raise InvalidOptionError(
            "the robomme simulator needs RoboMME's own interpreter, and none is given", _INSTALL
        )
    # Not resolved: the interpreter of a virtual environment is a link.
    found = shutil.which(Path(given).expanduser())
    if found is None:
        raise InvalidOptionError(f"{given} is not an executable file", _INSTALL)
    return found


def _keep(process: subprocess.Popen[bytes], log: deque[bytes]) -> None:
    """Keep the last lines that a process prints, until it ends."""
    assert process.stdout is not None
    with process.stdout as lines:
        log.extend(lines)
