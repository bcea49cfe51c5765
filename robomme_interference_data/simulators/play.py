"""Play one episode with a built-in policy, and optionally record a video."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import FPS
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.storage.encode import CLIP, VideoEncoder
from robomme_interference_data.storage.files import atomic_path

from .base import Simulator

Images = Mapping[str, NDArray[np.uint8]]
Color = tuple[int, int, int]

NO_POLICY = "none"
"""Plays the demonstration only."""

_LESSON, _LIVE = (40, 90, 200), (230, 130, 20)
"""Colors of the bar above the images: blue, and orange while the policy acts."""


def play(simulator: Simulator, episode: str, policy: str, video: Path | None) -> dict[str, Any]:
    """Play an episode's demonstration, then a policy; return what `simulate` prints about it."""
    with _recording(video) as add:
        lesson, seen, info = simulator.reset(episode)
        for index in range(len(lesson)):
            add({camera: frames[index] for camera, frames in lesson.images.items()}, _LESSON)
        add(seen.images, _LIVE)
        steps, status = 0, Status.ONGOING
        while status is Status.ONGOING and policy != NO_POLICY:
            seen, status = simulator.step(simulator.act(policy))
            steps += 1
            add(seen.images, _LIVE)
    return {
        "episode": episode,
        "simulator": info.simulator,
        "goal": info.goal,
        "difficulty": info.difficulty,
        "seed": info.seed,
        "policy": policy,
        "status": str(status),
        "lesson_frames": len(lesson),
        "steps": steps,
    }


@contextmanager
def _recording(video: Path | None) -> Iterator[Callable[[Images, Color], None]]:
    """Yield a function that adds the images of all cameras, side by side, to a video."""
    if video is None:
        yield lambda images, color: None
        return
    with atomic_path(video) as path:
        encoder: VideoEncoder | None = None

        def add(images: Images, color: Color) -> None:
            nonlocal encoder
            views = np.concatenate(list(images.values()), axis=1)
            bar = np.full((16, views.shape[1], 3), color, np.uint8)
            picture = np.concatenate([bar, views])
            height, width, _ = picture.shape
            encoder = encoder or VideoEncoder(path, CLIP, FPS, height, width, container="mp4")
            encoder.add(picture)

        yield add
        if encoder is not None:
            encoder.close()
