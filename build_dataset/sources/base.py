"""What every source of recorded episodes serves."""

from collections.abc import Generator, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robomme_interference_data.constants import DIFFICULTIES
from robomme_interference_data.errors import SourceError, nearest
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.records import EvidenceSpan


@dataclass(frozen=True)
class Frame:
    """One recorded time step.

    Attributes:
        images: Camera name (`front`, `wrist`, …) to image, `(H, W, 3) uint8` RGB.
        state: Robot state, `(S,) float32`; RoboMME's has 8 values: 7 joint positions in rad, and
            the gripper opening in m.
        action: Action of this time step, `(A,) float32`, or None if actions were not recorded;
            RoboMME's has 8 values: 7 absolute joint targets in rad, gripper −1 closed to 1 open.
        is_demonstration: Whether the frame belongs to the demonstration; None if the source
            does not say.
    """

    images: dict[str, NDArray[np.uint8]]
    state: NDArray[np.float32]
    action: NDArray[np.float32] | None
    is_demonstration: bool | None


@dataclass(frozen=True)
class SourceEpisode:
    """A recorded episode, as its source lists it: nothing of it was read yet.

    Attributes:
        id: Episode id.
        key: Where the source finds the episode again, and what changes if the recording does
            (such as a file's time and size): must be picklable.
    """

    id: EpisodeId
    key: Any = field(default=None, compare=False)


@dataclass(frozen=True)
class Recording:
    """An episode that is being read.

    Attributes:
        goals: Wordings of the goal; at least one.
        seed: Seed of the simulator, or None if not recorded.
        difficulty: `easy`, `medium` or `hard`, or None if not recorded.
        simulator: `robomme`, `tabletop`, or what the source names; None for real robots.
        exact: False if the frames were lossily compressed before they came here.
        frames: The frames in order, a bounded number in memory at a time. Closing it early
            releases the files.
        evidence: Which frames of the demonstration show the hidden answer, part by part; None
            where the source does not say.
    """

    goals: tuple[str, ...]
    seed: int | None
    difficulty: str | None
    simulator: str | None
    exact: bool
    frames: Generator[Frame]
    evidence: tuple[EvidenceSpan, ...] | None = None

    def __post_init__(self) -> None:
        if not self.goals or not all(goal.strip() for goal in self.goals):
            raise SourceError(
                f"the goal is {' and '.join(map(repr, self.goals)) or 'missing'}",
                "Say it in words.",
            )
        if self.difficulty not in (None, *DIFFICULTIES):
            raise SourceError(
                f"the difficulty is {self.difficulty!r}; expected one of {', '.join(DIFFICULTIES)}",
                nearest(self.difficulty, DIFFICULTIES, more=""),
            )


class Source(Protocol):
    """A place with recorded episodes, to be inherited from. Picklable: workers get a copy each.

    Attributes:
        provenance: What a dataset built from it records about it, `kind` among it; the same on
            every machine (no local paths), e.g. a Hub repository with its commit.
        time_limit: Seconds that reading and storing one episode may take, by default.
        whole: Whether episodes go on after the first live observation, as units need.
    """

    provenance: dict[str, Any]
    time_limit: float = 1800.0
    whole: bool = True

    def episodes(self) -> list[SourceEpisode]:
        """List all episodes, in the canonical order of their ids.

        Raises:
            SourceError: The recordings cannot be used; says which, why and what to do.
        """
        ...

    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        """Open an episode that `episodes` listed. What it holds is known by reading it.

        Args:
            episode: The episode.
            cameras: Names of the cameras that are wanted: no others are read; None for all.

        Raises:
            InvalidOptionError: The episode has no such camera.
            SourceError, MissingFileError, FormatError, HubError: The
                recording cannot be read, or, while it is read, breaks off. Which episode it is
                need not be said.
        """
        ...

    def contradict(self, episode: SourceEpisode) -> SourceEpisode:
        """Return the episode in the very scene of one that `episodes` listed, with another answer.

        Raises:
            SourceError: The source cannot make it.
        """
        raise SourceError(
            f"no contradicting lesson of {episode.id}: in what {self.provenance['kind']} gives, "
            "scene and answer come together",
            "Conditions with contradicting lessons, stale-k<n> and misled-k<n>, are for the source "
            "tabletop, which draws them apart.",
        )

    def close(self) -> None:
        """Release what is held from one episode to the next: nothing, unless a source says so."""
        return


def file_state(path: Path) -> tuple[int, int] | None:
    """Return what changes when a file, or a folder of files, does; None if there is none.

    Returns:
        The latest time of change in ns, and the size in bytes.
    """
    if not path.exists():
        return None
    found = [file.stat() for file in (path.iterdir() if path.is_dir() else [path])]
    latest = max((one.st_mtime_ns for one in found), default=0)
    return latest, sum(one.st_size for one in found)


def demonstration_length(flags: ArrayLike, what: str) -> int:
    """Return the number of demonstration frames of an episode.

    Args:
        flags: Whether each frame belongs to the demonstration, `(T,) bool`.
        what: What says so, for the message.
    """
    shown = np.asarray(flags, bool)
    length = int(shown.sum())
    if shown[length:].any():
        raise SourceError(
            f"{what} is true in {length} frames, not all of them at the beginning",
            "A demonstration comes first and in one piece: mend the recording, or leave it out.",
        )
    return length


def compose(
    streams: Mapping[str, Generator[NDArray[np.uint8]]],
    states: NDArray[np.float32],
    actions: NDArray[np.float32] | None,
    lesson: int | None,
) -> Generator[Frame]:
    """Yield the frames of an episode whose images and vectors lie apart.

    Args:
        streams: Camera name to its images in order; each is exhausted after the last frame, so
            that it may tell that it had more, and is closed however the reading ends.
        states: `(T, S) float32`.
        actions: `(T, A) float32`, or None if not recorded.
        lesson: Number of demonstration frames; None if the source does not say.
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
