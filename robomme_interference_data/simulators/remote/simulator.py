"""Simulators that run in a Python interpreter of their own."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import SimulatorError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import (
    Demonstration,
    EpisodeInfo,
    EpisodeStart,
    Observation,
    choose_cameras,
)
from robomme_interference_data.simulators.sapien_renderer import renderer_in

from . import versions as versions_program
from .interpreter import Interpreter
from .process import Arrays, RemoteProcess

_WORKER_HINT = (
    "`reset` and `step` of the class `Episodes` return facts and arrays: see "
    "docs/how-to/another-benchmark.md."
)


class RemoteSimulator(Simulator):
    """A simulator whose libraries need another Python, in a process of that; see `Simulator`.

    A subclass declares what `Simulator` lists, and names the file of its worker. That file has a
    class `Episodes`, runs in the other interpreter, and need not import this package: Python 3.8
    and numpy are enough. The interpreter is `python`, or the one that the environment variable
    `<NAME>_PYTHON` names, such as `ROBOMME_PYTHON`.

    The methods of `Episodes` return facts, a dictionary of what JSON can hold, and arrays by name.
    The first axis of an array is time:

    - `__init__(cameras, **options)`: names of the cameras to draw, and `options`.
    - `reset(family, split, index, frame_step)` starts an episode and plays its lesson of T steps.
      Facts: `goals` (list of texts); optional `seed`, `difficulty`, `evidence` (list of
      `{"part", "text", "start", "stop"}`), `scene` (text). Or only `unknown`: why there is no such
      episode. Arrays: `states` (T + 1, S) float32 and, of each camera, images (N + 1, H, W, 3)
      uint8, the last of them of the first live observation; optional `actions` (T, A) float32. N is
      T / `frame_step`, rounded up: every n-th frame of the lesson is drawn; none if it is 0.
    - `step(action, observe)` executes an action, a list of A numbers. Facts: `status`, such as
      `ongoing`; with the status `error` also `message`. Arrays: `states` (1, S) and, if `observe`,
      an image (1, H, W, 3) of each camera.
    - `act(policy, known, answer)`, for built-in policies: see `Simulator.act`; `known` is a list of
      pairs. Fact: `action`, a list of A numbers.
    - `close()` ends the running episode.

    If the process dies or takes too long, it is ended and the call raises `SimulatorCrashError`;
    the next reset starts a new one. An exception in a method ends the episode only.

    Attributes:
        worker: File with the class `Episodes`.
        needs: What is to be installed in its environment, for errors.
        oldest_python: The oldest Python that can run the worker.
        remote_packages: Distributions in its environment whose versions are recorded.
        episodes_per_process: Episodes that a process plays before a new one replaces it, such as
            where its memory grows; None for all. An instance may set another number.

    Args:
        python: The interpreter; by default that of the environment variable.
        cameras: Names of the cameras to draw; all by default.
        answer_s: Seconds that it may take to start, and for each call.
        options: Further arguments of `Episodes`, as `--simulator-option` sets them.

    Raises:
        InvalidOptionError: The interpreter is missing, too old or does not run, or a camera is
            unknown.
        MissingExtraError: The interpreter lacks a library.
        NoRendererError: Vulkan does not work on this machine.
        SimulatorCrashError: The worker does not start.
    """

    worker: ClassVar[Path]
    needs: ClassVar[str] = "the simulator"
    oldest_python: ClassVar[tuple[int, int]] = (3, 8)
    remote_packages: ClassVar[tuple[str, ...]] = ("numpy",)
    episodes_per_process: int | None = None
    settings: ClassVar[tuple[str, ...]] = ("python", "cameras", "answer_s")

    def __init__(
        self,
        python: str | os.PathLike[str] | None = None,
        cameras: Sequence[str] | None = None,
        answer_s: float = 900.0,
        **options: Any,
    ):
        self._cameras = choose_cameras(cameras, self.cameras)
        self._interpreter = self.interpreter(python)
        self._answer_s = answer_s
        self._options = {"cameras": self._cameras, **options}
        self._facts: dict[str, Any] = {}
        self._process = self._start()

    @classmethod
    def interpreter(cls, python: str | os.PathLike[str] | None = None) -> Interpreter:
        """Return its interpreter; None reads the environment variable."""
        return Interpreter.find(cls.name, cls.needs, cls.oldest_python, python)

    @classmethod
    def versions(cls, python: str | None = None) -> dict[str, str]:
        """Return the versions in its interpreter: of Python and of `remote_packages`."""
        interpreter = cls.interpreter(python)
        program = Path(versions_program.__file__)
        return super().versions() | interpreter.versions(program, (cls.name, *cls.remote_packages))

    @classmethod
    def renderer(cls, python: str | None = None) -> str | None:
        """Return SAPIEN's renderer in its interpreter, if `remote_packages` has it; else None."""
        if "sapien" not in cls.remote_packages:
            return None
        return renderer_in(cls.interpreter(python).path)

    @property
    def pid(self) -> int | None:
        """The id of its process, or None if there is none."""
        return self._process.pid

    def close(self) -> None:
        """End its process; afterwards, every method except `close` raises."""
        super().close()
        self._process.end()

    def call(self, method: str, **arguments: Any) -> Arrays:
        """Call a method of the worker; return the arrays, and keep the facts."""
        self._facts, arrays = self._process.call(method, **arguments)
        return arrays

    def fact(self, name: str) -> Any:
        """Return a fact of the worker's last answer, which must have it."""
        if name not in self._facts:
            raise self._incomplete(f"has no fact {name!r}")
        return self._facts[name]

    def _start(self) -> RemoteProcess:
        return RemoteProcess(self._interpreter, self.worker, self._options, self._answer_s)

    def _begin(self, episode: EpisodeId, frame_step: int) -> EpisodeStart:
        process, most = self._process, self.episodes_per_process
        if process.pid is None or (most is not None and process.played >= most):
            process.end()
            self._process = self._start()
        self._process.played += 1
        arrays = self.call("reset", **self._chosen(episode), frame_step=frame_step)
        first = self._observation(arrays, self._cameras)
        images = {camera: arrays[camera][:-1] for camera in self._cameras if frame_step}
        actions = arrays.get("actions", np.empty((0, self.action_size), np.float32))
        evidence = self._evidence(episode, arrays)
        lesson = Demonstration(images, arrays["states"][:-1], actions, *evidence)
        facts = self._facts
        goals = self.fact("goals")
        if not isinstance(goals, list) or not goals:  # the letters of a text are no goals
            raise self._incomplete(f"has the goals {goals!r}; expected a list of texts")
        info = EpisodeInfo(tuple(goals), facts.get("difficulty"), facts.get("seed"), self.name)
        return lesson, first, info

    def _chosen(self, episode: EpisodeId) -> dict[str, Any]:
        """Return the arguments of `reset` that choose an episode."""
        return {"family": episode.family, "split": episode.split, "index": episode.index}

    def _evidence(
        self, episode: EpisodeId, arrays: Arrays
    ) -> tuple[tuple[EvidenceSpan, ...] | None, str | None]:
        """Return the evidence and the scene of a lesson; see `Demonstration`."""
        spans = self._facts.get("evidence")
        evidence = None if spans is None else tuple(EvidenceSpan(**span) for span in spans)
        return evidence, self._facts.get("scene")

    def _execute(
        self, episode: EpisodeId, action: NDArray[np.float32], observe: bool
    ) -> tuple[Observation, Status]:
        arrays = self.call("step", action=action.tolist(), observe=observe)
        status = self.fact("status")
        if status not in list(Status):
            raise self._incomplete(f"has the status {status!r}; expected {', '.join(Status)}")
        if status == Status.ERROR:
            what = f"reports an error at step {self._steps}: {self.fact('message')}"
            raise self._process.error(what)
        return self._observation(arrays, self._cameras if observe else ()), Status(status)

    def _act(
        self, policy: str, known: Mapping[int, str], answer: int | None
    ) -> NDArray[np.float32]:
        self.call("act", policy=policy, known=list(known.items()), answer=answer)
        return np.array(self.fact("action"), np.float32)

    def _observation(self, arrays: Arrays, cameras: Sequence[str]) -> Observation:
        """Copy the last frames and state into an observation."""
        if missing := [name for name in ("states", *cameras) if name not in arrays]:
            raise self._incomplete(f"has no array {missing[0]!r}")
        images = {camera: arrays[camera][-1].copy() for camera in cameras}
        return Observation(images, arrays["states"][-1].copy())

    def _incomplete(self, fault: str) -> SimulatorError:
        return SimulatorError(f"an answer of the worker {self.worker} {fault}", _WORKER_HINT)
