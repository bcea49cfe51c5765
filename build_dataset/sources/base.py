"""What every source of recorded episodes serves."""

from collections.abc import Generator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.ids import EpisodeId

__all__ = ["Frame", "Source", "SourceEpisode"]


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
    """A recorded episode, as its source lists it.

    Attributes:
        id: Episode id.
        goals: Wordings of the goal; at least one.
        raw_length: Recorded frames.
        demonstration_length: Frames of the demonstration, which come first; None if the source
            does not mark them. The frame at this index is the first live observation.
        seed: Seed of the simulator, or None if not recorded.
        difficulty: `easy`, `medium` or `hard`, or None if not recorded.
        simulator: `robomme`, `tabletop`, or what the source names; None for real robots.
        exact: False if the frames were lossily compressed before they came here.
        cameras: Camera name to `(height, width)` in pixels.
        key: Where the source finds the episode again, and what changes if the recording does
            (such as a file's time and size): must be picklable.
        state_size: Values in a state.
        action_size: Values in an action; None if actions were not recorded.
    """

    id: EpisodeId
    goals: tuple[str, ...]
    raw_length: int
    demonstration_length: int | None
    seed: int | None
    difficulty: str | None
    simulator: str | None
    exact: bool
    cameras: dict[str, tuple[int, int]]
    key: Any = field(compare=False)
    state_size: int = 8
    action_size: int | None = 8


class Source(Protocol):
    """A place with recorded episodes. Instances are picklable: workers get a copy each.

    Attributes:
        kind: Name under which the source is registered, e.g. `robomme-h5`.
        provenance: What a dataset built from it records about it; the same on every machine
            (no local paths), e.g. a Hub repository with its commit.
    """

    kind: str

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

    def read(self, episode: SourceEpisode) -> Generator[Frame]:
        """Stream the frames of an episode in order, a bounded number in memory at a time.

        The episode is one that `episodes` listed, with some of its cameras or all: only those in
        `episode.cameras` are read.

        Callers may stop early; closing the generator releases the files.

        Raises:
            SourceError: The recording breaks off or does not fit what `episodes` said of it.
        """
        ...
