"""Play one episode with a built-in policy, and film it."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from robomme_interference_data.constants import FPS
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.rollouts import Status

from .base import EpisodeInfo, Simulator

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

NO_POLICY = "none"
"""Plays the demonstration only."""

_LESSON, _LIVE = (40, 90, 200), (230, 130, 20)
"""Colours of the bar above the pictures: blue, and orange while the policy acts."""


@dataclass(frozen=True)
class Played:
    """An episode that was played.

    Attributes:
        info: What the simulator reports of it.
        lesson_frames: Frames of its demonstration.
        status: How it ended.
        steps: Executed steps.
    """

    info: EpisodeInfo
    lesson_frames: int
    status: Status
    steps: int


def play(simulator: Simulator, episode: EpisodeId, policy: str, video: Path | None) -> Played:
    """Play an episode: its demonstration, then a policy.

    Args:
        simulator: The simulator.
        episode: The episode.
        policy: A policy that the simulator has, or `NO_POLICY`.
        video: File to write a video to, with all cameras side by side; None for none.
    """
    from robomme_interference_data.storage.encode import CLIP, VideoEncoder
    from robomme_interference_data.storage.files import atomic_path

    with ExitStack() as stack:
        path = None if video is None else stack.enter_context(atomic_path(video))
        lesson, seen, info = simulator.reset(str(episode))
        clip = None
        if path is not None:
            first = _picture(seen.images, _LIVE)
            height, width, _ = first.shape
            clip = VideoEncoder(path, CLIP, FPS, height, width, container="mp4")
            for index in range(len(lesson)):
                images = {camera: frames[index] for camera, frames in lesson.images.items()}
                clip.add(_picture(images, _LESSON))
            clip.add(first)
        steps, status = 0, Status.ONGOING
        while status is Status.ONGOING and policy != NO_POLICY:
            seen, status = simulator.step(simulator.act(policy))
            steps += 1
            if clip is not None:
                clip.add(_picture(seen.images, _LIVE))
        if clip is not None:
            clip.close()
    return Played(info, len(lesson), status, steps)


def _picture(
    images: "dict[str, NDArray[np.uint8]]", colour: tuple[int, int, int]
) -> "NDArray[np.uint8]":
    """Return the cameras side by side, under a bar of a colour."""
    import numpy as np

    views = np.concatenate(list(images.values()), axis=1)
    return np.concatenate([np.full((16, views.shape[1], 3), colour, np.uint8), views])
