"""Play one episode with a built-in policy, and optionally record a video."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import FPS, MAX_STEPS
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.storage.files import atomic_path
from robomme_interference_data.viz.episode_video import EpisodeVideo, check_pillow

from .base import Simulator
from .episode import check_drawn

Images = Mapping[str, NDArray[np.uint8]]

NO_POLICY = "none"
"""Plays the demonstration only."""


def play(simulator: Simulator, episode: str, policy: str, video: Path | None) -> dict[str, Any]:
    """Play an episode's demonstration, then a policy; return what `simulate` prints about it."""
    with _recording(video, episode, policy) as add:
        lesson, first, info = simulator.reset(episode)
        check_drawn(lesson, first, first.images)
        steps, status = 0, Status.ONGOING
        for index in range(len(lesson)):
            images = {camera: frames[index] for camera, frames in lesson.images.items()}
            add(images, info.goal, f"demonstration, frame {index}", status)
        add(first.images, info.goal, _step(steps), status)
        while status is Status.ONGOING and policy != NO_POLICY:
            seen, status = simulator.step(simulator.act(policy))
            steps += 1
            add(seen.images, info.goal, _step(steps), status)
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


def _step(steps: int) -> str:
    return f"step {steps} of {MAX_STEPS}"


@contextmanager
def _recording(
    path: Path | None, episode: str, policy: str
) -> Iterator[Callable[[Images, str, str, Status], None]]:
    """Yield a function that adds the images of all cameras, side by side, to a video."""
    if path is None:
        yield lambda images, goal, moment, status: None
        return
    check_pillow("a video")  # before the episode is played
    with atomic_path(path) as partial:
        video: EpisodeVideo | None = None

        def add(images: Images, goal: str, moment: str, status: Status) -> None:
            nonlocal video
            video = video or EpisodeVideo(partial, FPS, len(images))
            text = (episode, f"policy: {policy}", "", goal)
            video.add(images, text, (moment, str(status)))

        yield add
        if video is not None:
            video.close()
