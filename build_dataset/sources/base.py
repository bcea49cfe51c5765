"""The interface of a source of recorded episodes."""

import re
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import CAMERA_PREFIX, DIFFICULTIES
from robomme_interference_data.errors import InterferenceError, SourceError, named, nearest
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.records import MAX_GOAL, Day, EvidenceSpan
from robomme_interference_data.storage.limits import MAX_NAME, MAX_RATE, MIN_RATE

from ..alike import same_rate
from .flags import parse_flags

_LARGEST_SEED = 1 << 63
_CAMERA = re.compile(r"\w[\w .-]*")
_MAX_CAMERA = MAX_NAME - len(CAMERA_PREFIX)

CAMERA_NAMES = f"letters, digits, spaces, _, . and -, with at most {_MAX_CAMERA} characters"
"""What the name of a camera consists of, for errors: it is a part of paths."""


def is_camera_name(name: str) -> bool:
    """Return whether a camera can have a name."""
    fits = len(name) <= _MAX_CAMERA and _CAMERA.fullmatch(name) is not None
    return fits and not name.endswith((" ", "."))  # Windows has no folders of such names


@dataclass(frozen=True)
class Frame:
    """One recorded time step.

    Attributes:
        images: Camera name (`front`, `wrist`, …) to image, `(H, W, 3) uint8` RGB.
        state: Robot state, `(S,) float32`; RoboMME's has 8 values: 7 joint positions in rad, and
            the gripper opening in m.
        action: Action of this time step, `(A,) float32`, or None if actions were not recorded;
            RoboMME's has 8 values: 7 absolute joint targets in rad, gripper −1 closed to 1 open.
        is_demonstration: Whether the frame belongs to the demonstration; None if unknown.
    """

    images: dict[str, NDArray[np.uint8]]
    state: NDArray[np.float32]
    action: NDArray[np.float32] | None
    is_demonstration: bool | None


@dataclass(frozen=True)
class SourceEpisode:
    """A recorded episode in a source's list; its frames are not read yet.

    Attributes:
        id: Episode id.
        key: How the source finds the episode; changes with the recording (it holds, for example,
            the file's time and size). Must be picklable.
        marked: False if the source knows that it cannot tell where the demonstration ends.
        further: Whether it is built only if its number is given.
        day: The day that a query of a day is asked about, whose number chooses it; None for others.
        ability: What a query of a day needs of a memory; None for others.
        problem: Why it cannot be used, if the list already shows that; None if it can be read.
    """

    id: EpisodeId
    key: Any = field(default=None, compare=False)
    marked: bool = field(default=True, compare=False)
    further: bool = field(default=False, compare=False)
    day: EpisodeId | None = field(default=None, compare=False)
    ability: str | None = field(default=None, compare=False)
    problem: InterferenceError | None = field(default=None, compare=False)

    def check(self) -> None:
        """Raise the problem, if there is one."""
        if self.problem is not None:
            raise self.problem


@dataclass(frozen=True)
class Robot:
    """The robot of an episode; all episodes of a dataset have the same one.

    Attributes:
        fps: Frames per second; None if the recording does not state it.
        type: Name of the robot, as in LeRobot's `robot_type`, or None.
        names: `observation.state` and `action` to the names of their values, where known.
    """

    fps: float | None = None
    type: str | None = None
    names: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def at(self, given: float | None) -> float:
        """Return the frame rate: the recorded one or, if that is unknown, the given one.

        Raises:
            SourceError: Neither is known, or they differ.
        """
        if self.fps is None and given is None:
            raise SourceError(
                "the recording does not state its frame rate",
                f"Give it with {named('fps')}; in a frames folder a column fps can hold it.",
            )
        if self.fps is not None and given is not None and not same_rate(self.fps, given):
            raise SourceError(
                f"the recording states {self.fps:g} frames per second; {named('fps')} is {given:g}",
                "Leave it out, or correct the recording.",
            )
        rate = given if self.fps is None else self.fps
        if rate is None or not MIN_RATE <= rate <= MAX_RATE:
            raise SourceError(
                f"{rate} frames per second; expected {MIN_RATE:g} to {MAX_RATE:,.0f}",
                "Correct the rate of the recording.",
            )
        return rate

    def check_names(self, features: Mapping[str, Sequence[int]]) -> None:
        """Check that the known names are one for each value of a vector."""
        for feature in sorted(self.names.keys() & features.keys()):
            names, size = self.names[feature], features[feature][0]
            if not len({*names}) == len(names) == size:
                raise SourceError(
                    f"{feature} has {size} values, and the names {', '.join(names)}",
                    "Give one name for each value.",
                )
            if longest := [name for name in names if len(name) > MAX_NAME]:
                raise SourceError(
                    f"a value of {feature} has a name of {len(longest[0])} characters; expected at "
                    f"most {MAX_NAME}",
                    "Shorten the name.",
                )


@dataclass(frozen=True)
class Recording:
    """An episode that is being read.

    Attributes:
        goals: Wordings of the goal; at least one.
        seed: Seed of the simulator, or None if not recorded.
        difficulty: `easy`, `medium` or `hard`, or None if not recorded.
        simulator: `robomme`, `tabletop`, or another name; None for real robots.
        exact: False if the frames were ever lossily compressed.
        frames: The frames in order, a bounded number in memory at a time. Closing it early
            releases the files.
        evidence: Which frames of the demonstration show the hidden answer, part by part; None
            if unknown.
        robot: The robot.
        action_first: Whether the action of a frame was executed before its observation, instead of
            after it.
        scene: What the scene allows and hides, as in `Demonstration.scene`.
        day: What a day holds, without digests; called when all frames are read. None for others.
    """

    goals: tuple[str, ...]
    seed: int | None
    difficulty: str | None
    simulator: str | None
    exact: bool
    frames: Generator[Frame]
    evidence: tuple[EvidenceSpan, ...] | None = None
    robot: Robot = Robot()
    action_first: bool = False
    scene: str | None = None
    day: Callable[[], Day] | None = None

    def __post_init__(self) -> None:
        if not self.goals or not all(goal.strip() for goal in self.goals):
            raise SourceError(
                f"the goal is {' and '.join(map(repr, self.goals)) or 'missing'}",
                "Describe the goal in words.",
            )
        if sum(map(len, self.goals)) > MAX_GOAL:
            raise SourceError(
                f"the goal has {sum(map(len, self.goals)):,} characters; expected at most "
                f"{MAX_GOAL:,} in all wordings",
                "Shorten the goal.",
            )
        for goal in self.goals:
            if any("\ud800" <= character <= "\udfff" for character in goal):
                raise SourceError(
                    f"the goal is {goal!r}, with half of a character",
                    "Decode the text as it was encoded.",
                )
        if self.seed is not None and not -_LARGEST_SEED <= self.seed < _LARGEST_SEED:
            raise SourceError(
                f"the seed is {self.seed}; expected a whole number of at most 63 bits",
                "Leave the seed out.",
            )
        if self.difficulty not in (None, *DIFFICULTIES):
            raise SourceError(
                f"the difficulty is {self.difficulty!r}; expected one of {', '.join(DIFFICULTIES)}",
                nearest(self.difficulty, DIFFICULTIES, more=""),
            )


class Source(Protocol):
    """A set of recorded episodes; base class of all sources. Picklable: each worker gets a copy.

    Attributes:
        provenance: What a dataset built from the source records about it, including its `kind`;
            the same on every machine (no local paths), e.g. a Hub repository with its commit.
        time_limit_s: Default limit in seconds for reading and storing one episode.
        worker_gb: Memory in GB that a worker with it takes; 0 if that is little.
    """

    provenance: dict[str, Any]
    time_limit_s: float = 1800.0
    worker_gb: float = 0

    def episodes(self) -> list[SourceEpisode]:
        """List all episodes, in the canonical order of their ids.

        Raises:
            SourceError: The recordings cannot be used; names which, why and what to do.
        """
        ...

    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        """Open an episode that `episodes` listed.

        Args:
            episode: The episode.
            cameras: Names of the cameras to read; None for all.

        Raises:
            InvalidOptionError: The episode has no such camera.
            SourceError, MissingFileError, FormatError, HubError: The recording cannot be opened
                or, later, read to its end. The message need not name the episode.
        """
        ...

    def contradict(self, episode: SourceEpisode) -> SourceEpisode:
        """Return the episode in the same scene as a listed one, with another answer.

        Raises:
            SourceError: The source cannot make it.
        """
        raise SourceError(
            f"no contradicting lesson of {episode.id}: the source {self.provenance['kind']} cannot "
            "play the same scene with another answer",
            "Conditions with contradicting lessons, stale-k<n> and misled-k<n>, need the source "
            "tabletop.",
        )

    def close(self) -> None:
        """Release what the source keeps between episodes."""
        return


def file_state(path: Path) -> tuple[int, int] | None:
    """Return the latest change in ns and the size in bytes of a file or of a folder's files."""
    if not path.exists():
        return None
    files = [file.stat() for file in (path.iterdir() if path.is_dir() else [path])]
    return max((file.st_mtime_ns for file in files), default=0), sum(file.st_size for file in files)


def demonstration_length(flags: Iterable[Any], what: str) -> int:
    """Return the number of demonstration frames from `what`, a flag for each frame."""
    try:
        marked = np.array(parse_flags(flags), bool)
    except ValueError as error:
        raise SourceError(f"{what} is {error}", "Correct the recording, or leave it out.") from None
    length = int(marked.sum())
    if marked[length:].any():
        raise SourceError(
            f"{what} is true in {length} frames, not all of them at the beginning",
            "A demonstration is the first part of its episode: correct the recording, or leave it "
            "out.",
        )
    return length


def compose(
    streams: Mapping[str, Generator[NDArray[np.uint8]]],
    states: NDArray[np.float32],
    actions: NDArray[np.float32] | None,
    lesson: int | None,
) -> Generator[Frame]:
    """Yield the frames of an episode whose images and vectors are stored apart.

    Each stream is exhausted after the last frame, so that it can report surplus images, and is
    closed even if reading stops early. `lesson` is the number of demonstration frames, if known.
    """
    with ExitStack() as stack:
        for stream in streams.values():
            stack.enter_context(closing(stream))
        for number, state in enumerate(states):
            yield Frame(
                images={camera: next(stream) for camera, stream in streams.items()},
                state=state,
                action=None if actions is None else actions[number],
                is_demonstration=None if lesson is None else number < lesson,
            )
        for stream in streams.values():
            next(stream, None)
