"""What every simulator serves, whatever engine is behind it."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.errors import (
    InvalidOptionError,
    SimulatorCrashError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.shifts import Shift
from robomme_interference_data.schema.subgoal import Subgoal

CAMERAS = ("front", "wrist")
"""The cameras of every simulator, in the order in which they are listed."""

ACTION_SIZE = 8
"""Numbers of an action, and of a state: 7 joints, then the gripper."""


@dataclass(frozen=True)
class Observation:
    """What a policy sees at one time step.

    Attributes:
        images: Camera name (`front`, `wrist`) to image, `(256, 256, 3) uint8` RGB; only the
            cameras that the simulator was asked to draw, and empty where no images were wanted.
        state: `(8,) float32`: 7 joint positions in rad, then the gripper's opening, which is the
            way of one finger, 0 closed to 0.04 m open.
        subgoal: What a policy is told to do next, where something in front of it says so.
    """

    images: dict[str, NDArray[np.uint8]]
    state: NDArray[np.float32]
    subgoal: Subgoal | None = None


@dataclass(frozen=True)
class Demonstration:
    """The lesson of an episode: T time steps, the first live observation not among them.

    Attributes:
        images: Camera name to frames, `(T, H, W, 3) uint8` RGB; empty where they
            were not wanted.
        states: `(T, 8) float32`, as `Observation.state`; `states[t]` belongs to frame t.
        actions: `(T, 8) float32`: the action taken at time step t, after frame t was seen: 7
            absolute joint targets in rad, then the gripper, −1 closed to 1 open.
        evidence: Which frames show the hidden answer, part by part; None where the simulator
            does not say. Never handed to a policy.
    """

    images: dict[str, NDArray[np.uint8]]
    states: NDArray[np.float32]
    actions: NDArray[np.float32]
    evidence: tuple[EvidenceSpan, ...] | None = None

    def __len__(self) -> int:
        return len(self.states)

    def __repr__(self) -> str:
        cameras = {name: frames.shape for name, frames in self.images.items()}
        return f"Demonstration(frames={len(self)}, images={cameras})"


@dataclass(frozen=True)
class EpisodeInfo:
    """What may be known of an episode besides its frames. The hidden answer is not in it.

    Attributes:
        goals: All wordings of the goal; at least one.
        difficulty: `easy`, `medium` or `hard`.
        seed: Seed of the scene.
        simulator: Name under which the simulator is registered.
    """

    goals: tuple[str, ...]
    difficulty: str
    seed: int
    simulator: str

    @property
    def goal(self) -> str:
        """The goal in words: the first of its wordings."""
        return self.goals[0]


Begun = tuple[Demonstration, Observation, EpisodeInfo]


class Simulator(ABC):
    """One episode at a time of the benchmark's task families.

    An episode that is refused, breaks or ends leaves none to step. One that goes on after 1300
    steps has timed out. A backend begins and executes in `_begin` and `_execute`; an object with
    the same `reset`, `step`, `act` and `close` will do as well.

    What a simulator supports are attributes and methods of its class, known before one is made. A
    function that makes one, and is no class, has those of this class.

    Attributes:
        name: Name under which it is registered.
        about: What its episodes are, for cards: `the official simulator, RoboMME`.
        remote: Whether it runs in another process: then `evaluate` decodes the history while it
            begins the episode.
        settings: Which settings of a run are arguments of its constructor: `cameras` (those that
            somebody looks at), `shift`, `python` (another interpreter's path), `subgoals` (whether
            `subgoal` will be asked), `answer_s` (seconds that a call may take).
        scripted: Whether `act` can play an episode out.
        shifts: Whether it can show its live scene under shifts.
        suite_version: Version of its episodes; None where they have none of their own.
        packages: Distributions of this environment that it uses.
        episode_s: Seconds that an episode may take when it is recorded.
    """

    name: ClassVar[str] = ""
    about: ClassVar[str] = ""
    remote: ClassVar[bool] = False
    settings: ClassVar[tuple[str, ...]] = ()
    scripted: ClassVar[bool] = True
    shifts: ClassVar[bool] = False
    suite_version: ClassVar[int | None] = None
    packages: ClassVar[tuple[str, ...]] = ()
    episode_s: ClassVar[float] = 300.0
    _episode: EpisodeId | None = None
    _steps = 0
    _closed = False

    @classmethod
    def versions(cls, python: str | None = None) -> dict[str, str]:
        """Return the versions on which its results depend, by name, without starting it.

        Args:
            python: Path of its own interpreter, if it has one.
        """
        return {} if cls.suite_version is None else {cls.name: str(cls.suite_version)}

    @classmethod
    def episodes(cls) -> list[EpisodeId]:
        """List its episodes that have demonstrations."""
        return []

    @classmethod
    def other_answer(cls, episode: EpisodeId) -> int | None:
        """Return the number of another answer that an episode's scene allows; None if unknown."""
        return None

    @classmethod
    def scene(cls, family: str, seed: int, difficulty: str) -> Any:
        """Return the scene of a recorded episode, to be looked at and not played.

        That is an object with the methods of `tabletop.family.Family` that concern answers; None
        where the possible answers are not known.
        """
        return None

    def views(self, shifts: Iterable[Shift]) -> Iterator[Observation]:
        """Yield what is seen now as under each of several shifts; the scene stays unchanged."""
        raise UnknownNameError(f"the simulator {type(self).__name__} has no shifts")

    def reset(self, episode_id: str, demonstration: bool = True) -> Begun:
        """Start an episode: play its demonstration, then set the scene for execution.

        The same id gives the same frames, states and first observation, bit for bit.

        Args:
            episode_id: `<Family>/<split>/<index>`, such as `MoveCube/test/3`.
            demonstration: Whether the frames of the demonstration are wanted. It is played in any
                case; without, a simulator need not draw it, and its `images` may be empty.

        Returns:
            The demonstration, the first live observation, and what may be known of the episode.

        Raises:
            InvalidIdError: The text is not an episode id.
            UnknownNameError: There is no such family or episode.
            SimulatorCrashError: The simulator is closed.
        """
        self._check_open()
        self._episode = None
        episode = EpisodeId.parse(str(episode_id))
        begun = self._begin(episode, demonstration)
        self._episode, self._steps = episode, 0
        return begun

    def step(self, action: NDArray[np.float32], observe: bool = True) -> tuple[Observation, Status]:
        """Execute one action for a tenth of a second.

        Args:
            action: `(8,) float32`: 7 absolute joint targets in rad, gripper −1 closed to 1 open.
            observe: Whether the images are wanted; without, a simulator need not draw them, and
                the observation's `images` may be empty. The state is always there.

        Raises:
            InvalidOptionError: The action has another shape, or is not finite.
            SimulatorCrashError: There is no episode to step, or the simulator is closed.
        """
        episode = self._running()
        action = action_array(action)
        self._episode = None
        self._steps += 1
        seen, status = self._execute(episode, action, observe)
        if status is Status.ONGOING and self._steps >= MAX_STEPS:
            status = Status.TIMEOUT
        if status is Status.ONGOING:
            self._episode = episode
        return seen, status

    @abstractmethod
    def act(self, policy: str, known: Mapping[int, str] | None = None) -> NDArray[np.float32]:
        """Return the next action, `(8,) float32`, of a built-in policy.

        Args:
            policy: `oracle`, which reads the hidden answer; `guess`, which draws one at random
                from the episode's seed; or `recall`, which draws one of those that agree with
                what is known. Keep to one of them throughout an episode.
            known: For `recall`, at its first action: parts of the answer by number, in words as
                the evidence of a demonstration has them; those that are believed most come first.

        Raises:
            UnknownNameError: The simulator has no such policy.
            SimulatorCrashError: There is no episode to act in, or the simulator is closed.
        """

    def subgoal(self) -> Subgoal:
        """Return what is to be done next, as the scene stands: it knows the hidden answer.

        Raises:
            UnknownNameError: The simulator does not tell.
            SimulatorCrashError: There is no episode, or the simulator is closed.
        """
        raise UnknownNameError(f"the simulator {type(self).__name__} has no subgoals of its own")

    def follow_subgoal(self, subgoal: Subgoal | None) -> NDArray[np.float32]:
        """Return the next action, `(8,) float32`, of a script that does what a subgoal says.

        It finds what words and points name among all that the scene allows; where they leave it
        open, and without a subgoal, it draws from the episode's seed. Keep to it throughout an
        episode.

        Raises:
            UnknownNameError: The simulator has no such script.
            SimulatorCrashError: There is no episode to act in, or the simulator is closed.
        """
        raise UnknownNameError(
            f"the simulator {type(self).__name__} has no script that follows subgoals"
        )

    def close(self) -> None:
        """Release everything; further calls but `close` are errors."""
        self._episode, self._closed = None, True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_open(self) -> None:
        if self._closed:
            raise SimulatorCrashError("the simulator is closed", "Make another one.")

    def _running(self) -> EpisodeId:
        """Return the episode that runs."""
        self._check_open()
        if self._episode is None:
            raise SimulatorCrashError(
                "the simulator runs no episode", "Call reset('<Family>/<split>/<index>') first."
            )
        return self._episode

    @abstractmethod
    def _begin(self, episode: EpisodeId, demonstration: bool) -> Begun:
        """Start an episode."""

    @abstractmethod
    def _execute(
        self, episode: EpisodeId, action: NDArray[np.float32], observe: bool
    ) -> tuple[Observation, Status]:
        """Execute one action in the episode that runs."""


def choose_cameras(wanted: Sequence[str] | None, there: Sequence[str] = CAMERAS) -> tuple[str, ...]:
    """Return the cameras that are wanted, None for all, of those that are there, sorted.

    Raises:
        InvalidOptionError: One is not there.
    """
    for camera in wanted or ():
        if camera not in there:
            raise InvalidOptionError.one_of("camera", camera, there)
    return tuple(sorted(there if wanted is None else set(wanted)))


def action_array(action: ArrayLike, *, chunk: bool = False) -> NDArray[np.float32]:
    """Return an action as `(8,) float32`: the one check of actions.

    Args:
        action: 7 absolute joint targets in rad, then the gripper, −1 closed to 1 open.
        chunk: Whether these are several actions, returned as `(n, 8) float32`, n at least 1.

    Raises:
        InvalidOptionError: It has another shape, or is not finite numbers.
    """
    try:
        given = np.asarray(action)
    except ValueError:  # rows of several lengths
        given = np.empty(0)
    shape = given.shape[1:] if chunk else given.shape
    if shape == (ACTION_SIZE,) and given.dtype.kind in "fiu":
        with np.errstate(over="ignore"):
            array = given.astype(np.float32)
        if len(array) and np.isfinite(array).all():
            return array
    expected = f"(n, {ACTION_SIZE}) actions, n at least 1" if chunk else f"({ACTION_SIZE},) action"
    raise InvalidOptionError(
        f"{given.dtype} {given.shape} {np.array2string(given, threshold=2 * ACTION_SIZE)} is no "
        f"{expected}, of finite numbers",
        "An action is 7 absolute joint targets in rad, then the gripper, −1 closed to 1 open.",
    )
