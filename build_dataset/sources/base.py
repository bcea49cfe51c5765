"""What every source of recorded episodes serves."""

from collections.abc import Generator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.ids import EpisodeId

__all__ = ["Frame", "Recording", "Source", "SourceEpisode", "choose_cameras"]


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
    """

    goals: tuple[str, ...]
    seed: int | None
    difficulty: str | None
    simulator: str | None
    exact: bool
    frames: Generator[Frame]


class Source(Protocol):
    """A place with recorded episodes. Instances are picklable: workers get a copy each.

    Attributes:
        provenance: What a dataset built from it records about it, `kind` among it; the same on
            every machine (no local paths), e.g. a Hub repository with its commit.
        time_limit: Seconds that reading and storing one episode may take, by default.
        whole: Whether episodes go on after the first live observation, as units need.
    """

    time_limit: float
    whole: bool

    @property
    def provenance(self) -> dict[str, Any]:
        """See above."""
        ...

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
            SourceError: The recording cannot be read, or, while it is read, breaks off.
        """
        ...

    def close(self) -> None:
        """Release what is held from one episode to the next."""
        ...


def choose_cameras(
    wanted: tuple[str, ...] | None, there: tuple[str, ...], what: object
) -> tuple[str, ...]:
    """Return the cameras that are wanted of those that are there, sorted.

    Raises:
        InvalidOptionError: One is not there; `what` says where.
    """
    for camera in wanted or ():
        if camera not in there:
            raise InvalidOptionError.one_of(f"{what}: camera", camera, there)
    return tuple(sorted(there if wanted is None else set(wanted)))
