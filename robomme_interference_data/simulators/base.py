"""The interface of every simulator."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import FPS, MAX_STEPS
from robomme_interference_data.errors import (
    InvalidOptionError,
    SimulatorCrashError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.shifts import Shift
from robomme_interference_data.schema.subgoal import Subgoal

from .episode import ACTION_SIZE, CAMERAS, EpisodeStart, Observation, action_array, check_start
from .scene import Scene

SCRIPTED = ("oracle", "guess", "recall", "answer")
"""Built-in policies of `Simulator.act`."""

BUILT_IN = (*SCRIPTED, "follow-subgoals")
"""All built-in policies of a simulator."""


class Simulator(ABC):
    """Runs one episode of its task families at a time.

    An episode ends when `step` returns another status than `ongoing`, when a call raises, or after
    1300 steps (`timeout`). Subclasses implement `_begin`, `_execute` and, if they have built-in
    policies, `_act`. Instead of a subclass, any object with the methods `reset`, `step`, `act` and
    `close` works as well.

    Class attributes and class methods declare what a simulator supports, before one is made. For a
    function that makes one they are those of the class in its return annotation, else of this one.

    Attributes:
        name: Registered name.
        about: What its episodes are, for cards, such as `the official simulator, RoboMME`.
        cameras: Names of its cameras, in the order of videos.
        fps: Observations per second: an action is executed for the time between two of them.
        state_names: Names of the values of a state; None if they have none.
        action_names: Names of the values of an action; None if they have none.
        settings: Settings of a run that its constructor accepts: `cameras` (to render), `shift`,
            `subgoals` (whether `subgoal` will be called), `answer_s` (seconds that a call may
            take), `buffer_set` (its location), `python` (its own interpreter). A function accepts
            those that are its parameters. Its other arguments are set by `--simulator-option`.
        policies: Its built-in policies: those of `act`, and `follow-subgoals` if it has
            `follow_subgoal`.
        shifts: Whether it supports shifts of the live scene.
        own_episodes: Whether it plays only episodes that were recorded on it.
        plays_back: Whether it plays back recorded executions: for offline evaluation only.
        try_out: Whether `evaluate` begins an episode before the run, so that a mistake in a new
            simulator is an error of the run, and not of every rollout.
        suite_version: Version of its episodes; None if they have none.
        packages: Distributions of this environment that it uses.
        episode_s: Seconds that recording one episode may take.
        worker_gb: Memory in GB that a worker with it takes.
        action_size: Length of an action; an instance may set another one.
    """

    name: ClassVar[str] = ""
    about: ClassVar[str] = ""
    cameras: Sequence[str] = CAMERAS
    fps: ClassVar[float] = FPS
    state_names: ClassVar[tuple[str, ...] | None] = None
    action_names: ClassVar[tuple[str, ...] | None] = None
    settings: ClassVar[tuple[str, ...]] = ()
    policies: ClassVar[tuple[str, ...]] = BUILT_IN
    shifts: ClassVar[bool] = False
    own_episodes: ClassVar[bool] = False
    plays_back: ClassVar[bool] = False
    try_out: ClassVar[bool] = True
    suite_version: ClassVar[int | None] = None
    packages: ClassVar[tuple[str, ...]] = ()
    episode_s: ClassVar[float] = 300.0
    worker_gb: ClassVar[float] = 1.5
    action_size: int = ACTION_SIZE
    _episode: EpisodeId | None = None
    _steps = 0
    _closed = False

    @classmethod
    def versions(cls) -> dict[str, str]:
        """Return the versions that its results depend on, by name, without starting it.

        They are the `suite_version`, and those of the `packages` that are installed.

        Raises:
            InvalidOptionError: Its own interpreter, if it has one, does not run.
        """
        versions = {}
        if cls.suite_version is not None:
            versions[cls.name or cls.__name__] = str(cls.suite_version)
        for package in cls.packages:
            with suppress(PackageNotFoundError):
                versions[package] = version(package)
        return versions

    @classmethod
    def renderer(cls) -> str | None:
        """Return what draws its images on this machine, without starting it: a device and driver.

        Datasets and runs record it, because images differ between renderers. None if it is unknown.

        Raises:
            InvalidOptionError: Its own interpreter, if it has one, does not run.
        """
        return None

    @classmethod
    def episodes(cls) -> list[EpisodeId]:
        """Return its episodes that have demonstrations, in canonical order."""
        return []

    @classmethod
    def extra_episodes(cls) -> list[EpisodeId]:
        """Return episodes, in canonical order, that are built only if their numbers are given."""
        return []

    @classmethod
    def other_answer(cls, episode: EpisodeId) -> int | None:
        """Return the number of another answer that an episode's scene allows.

        Args:
            episode: The episode, without an answer of its own in the id.

        Returns:
            The number for `EpisodeId.answer`, from 0; None if the answers are unknown.
        """
        return None

    @classmethod
    def scene(
        cls, family: str, seed: int, difficulty: str, recorded: str | None = None
    ) -> Scene | None:
        """Return the scene of a recorded episode, for questions about its answer.

        Args:
            family: Task family.
            seed: Seed of the scene.
            difficulty: `easy`, `medium` or `hard`.
            recorded: `Demonstration.scene`.

        Returns:
            The scene; None if the possible answers are unknown.

        Raises:
            FormatError: What was recorded is damaged.
        """
        return None

    def views(self, shifts: Iterable[Shift]) -> Iterator[Observation]:
        """Yield the current observation under each of several shifts; the scene stays unchanged.

        Args:
            shifts: The shifts, in the order of the observations.

        Raises:
            UnknownNameError: The simulator does not support shifts.
            SimulatorCrashError: No episode is running, or the simulator is closed.
        """
        raise UnknownNameError(f"the simulator {type(self).__name__} does not support shifts")

    def reset(self, episode_id: str, demonstration: int = True) -> EpisodeStart:
        """Start an episode: play its demonstration, then set up the live scene.

        The same id gives the same frames, states and first observation, bit for bit.

        Args:
            episode_id: `<Family>/<split>/<index>`, such as `MoveCube/test/3`.
            demonstration: Whether to return the frames of the demonstration; a number n for every
                n-th of them, as in `states[::n]`. It is played in any case, but a simulator may
                skip rendering the others.

        Returns:
            The demonstration; the first live observation; the public facts about the episode.

        Raises:
            InvalidIdError: The text is not an episode id.
            InvalidOptionError: `demonstration` is negative.
            UnknownNameError: The family or episode does not exist.
            SimulatorError: What the subclass returned has other shapes or types.
            SimulatorCrashError: The simulator failed, or is closed.
        """
        self._check_open()
        self._episode = None
        episode = EpisodeId.parse(str(episode_id))
        if demonstration < 0:
            expected = "True, False, or n for every n-th frame"
            raise InvalidOptionError.expected("demonstration", demonstration, expected)
        start = self._begin(episode, int(demonstration))
        check_start(start, type(self).__name__, self.cameras, self.action_size)
        self._episode, self._steps = episode, 0
        return start

    def step(self, action: NDArray[np.float32], observe: bool = True) -> tuple[Observation, Status]:
        """Execute one action for the time between two observations, 0.1 s on RoboMME.

        Args:
            action: `(action_size,) float32`; on RoboMME 7 absolute joint targets in rad, then the
                gripper, −1 closed to 1 open.
            observe: Whether to return images; `False` lets a simulator skip rendering and leave
                `images` empty. The state is always returned.

        Returns:
            The observation after the action, and the status of the episode.

        Raises:
            InvalidOptionError: The action has another shape or is not finite; the episode
                continues unchanged.
            SimulatorCrashError: The simulator failed, no episode is running, or it is closed.
        """
        episode = self._running()
        action = action_array(action, size=self.action_size)
        self._episode = None
        self._steps += 1
        observation, status = self._execute(episode, action, observe)
        status = Status(status)
        if status is Status.ONGOING and self._steps >= MAX_STEPS:
            status = Status.TIMEOUT
        if status is Status.ONGOING:
            self._episode = episode
        return observation, status

    def act(
        self, policy: str, known: Mapping[int, str] | None = None, answer: int | None = None
    ) -> NDArray[np.float32]:
        """Return the next action of a built-in policy.

        Args:
            policy: `oracle` uses the hidden answer; `guess` draws an answer from the episode's
                seed; `recall` draws one that agrees with `known`; `answer` uses the one that is
                given. Use the same policy throughout an episode.
            known: For `recall`, at its first action: known parts of the answer, number to text as
                in the demonstration's evidence, the most trusted first.
            answer: For `answer`, at its first action: the number of an answer in `Scene.answers`.

        Returns:
            The action, `(8,) float32`, as `step` takes it.

        Raises:
            InvalidOptionError: The scene has no answer of this number.
            UnknownNameError: The simulator has no such policy.
            SimulatorCrashError: No episode is running, or the simulator is closed.
        """
        self._running()
        if policy not in SCRIPTED or policy not in self.policies:
            raise UnknownNameError.among("built-in policy", policy, self.name, self.policies)
        return self._act(policy, known or {}, answer)

    def subgoal(self) -> Subgoal:
        """Return the next subgoal for the current state; it depends on the hidden answer.

        Returns:
            The subgoal; its points are (y, x) in pixels of the current front image.

        Raises:
            UnknownNameError: The simulator provides no subgoals.
            SimulatorCrashError: No episode is running, or the simulator is closed.
        """
        raise UnknownNameError(f"the simulator {type(self).__name__} provides no subgoals")

    def follow_subgoal(self, subgoal: Subgoal | None) -> NDArray[np.float32]:
        """Return the next action of a script that follows subgoals without knowing the answer.

        It selects what the words and points of the subgoal match in the scene. Where they are
        ambiguous, and without a subgoal, it draws from the episode's seed. Use only this policy
        throughout an episode.

        Args:
            subgoal: The subgoal that was written since the last call, perhaps the same one again;
                None if none was.

        Returns:
            The action, `(8,) float32`, as `step` takes it.

        Raises:
            UnknownNameError: The simulator has no such script.
            SimulatorCrashError: No episode is running, or the simulator is closed.
        """
        raise UnknownNameError(f"the simulator {type(self).__name__} cannot follow subgoals")

    def columns(self) -> dict[str, Any]:
        """Return further columns of the row of the episode that has ended, by name."""
        return {}

    def close(self) -> None:
        """Release all resources; afterwards, every method except `close` raises."""
        self._episode, self._closed = None, True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_open(self) -> None:
        if self._closed:
            raise SimulatorCrashError("the simulator is closed", "Make a new one.")

    def _running(self) -> EpisodeId:
        """Return the running episode."""
        self._check_open()
        if self._episode is None:
            raise SimulatorCrashError(
                "no episode is running", "Call reset('<Family>/<split>/<index>') first."
            )
        return self._episode

    def _act(
        self, policy: str, known: Mapping[int, str], answer: int | None
    ) -> NDArray[np.float32]:
        """Return the next action of one of `policies`; see `act`."""
        raise UnknownNameError(
            f"the simulator {type(self).__name__} cannot act as {policy}",
            "Define `_act`, or declare `policies = ()`: docs/how-to/another-benchmark.md.",
        )

    @abstractmethod
    def _begin(self, episode: EpisodeId, frame_step: int) -> EpisodeStart:
        """Start an episode, and return every n-th frame of its demonstration, none if 0."""

    @abstractmethod
    def _execute(
        self, episode: EpisodeId, action: NDArray[np.float32], observe: bool
    ) -> tuple[Observation, Status]:
        """Execute one action in the running episode; see `step`."""
