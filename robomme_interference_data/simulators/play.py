"""Play one episode with a built-in policy, and optionally record a video."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import FPS
from robomme_interference_data.errors import MissingExtraError
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.storage.encode import CLIP, VideoEncoder
from robomme_interference_data.storage.files import atomic_path

from .base import Simulator

Images = Mapping[str, NDArray[np.uint8]]
Color = tuple[int, int, int]

NO_POLICY = "none"
"""Plays the demonstration only."""

_BAR = 20
"""Height of the bar above the images, which names what they show, in pixels."""

_LESSON, _LIVE = (40, 90, 200), (180, 90, 0)
"""Colors of the bar: blue, and orange while the policy acts; white letters are legible on both."""


def play(simulator: Simulator, episode: str, policy: str, video: Path | None) -> dict[str, Any]:
    """Play an episode's demonstration, then a policy; return what `simulate` prints about it."""
    with _recording(video) as add:
        lesson, seen, info = simulator.reset(episode)
        for index in range(len(lesson)):
            images = {camera: frames[index] for camera, frames in lesson.images.items()}
            add(images, _LESSON, "demonstration")
        acts = f"policy: {policy}"
        add(seen.images, _LIVE, acts)
        steps, status = 0, Status.ONGOING
        while status is Status.ONGOING and policy != NO_POLICY:
            seen, status = simulator.step(simulator.act(policy))
            steps += 1
            add(seen.images, _LIVE, acts)
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


def check_pillow(what: str) -> None:
    """Check that Pillow, which writes on videos, is installed; `what` needs it, for the message."""
    try:
        import PIL  # noqa: F401
    except ImportError as error:
        raise MissingExtraError.needs(what, "pillow", "retrieval") from error


@contextmanager
def _recording(video: Path | None) -> Iterator[Callable[[Images, Color, str], None]]:
    """Yield a function that adds the images of all cameras, side by side, to a video.

    A bar above each image has the name of its camera; that of the first also says what is shown.
    """
    if video is None:
        yield lambda images, color, what: None
        return
    check_pillow("a video")
    with atomic_path(video) as path:
        encoder: VideoEncoder | None = None

        def add(images: Images, color: Color, what: str) -> None:
            nonlocal encoder
            views = np.concatenate(list(images.values()), axis=1)
            picture = np.concatenate([_bar(images, color, what), views])
            height, width, _ = picture.shape
            encoder = encoder or VideoEncoder(path, CLIP, FPS, height, width, container="mp4")
            encoder.add(picture)

        yield add
        if encoder is not None:
            encoder.close()


def _bar(images: Images, color: Color, what: str) -> NDArray[np.uint8]:
    """Return the bar above the images, `(20, W, 3) uint8`."""
    from PIL import Image, ImageDraw, ImageFont

    width = sum(image.shape[1] for image in images.values())
    bar = Image.new("RGB", (width, _BAR), color)
    draw, font, left = ImageDraw.Draw(bar), ImageFont.load_default(13), 0
    for number, (camera, image) in enumerate(images.items()):
        text = camera if number else f"{what}, {camera}"
        draw.text((left + 4, 2), text, fill="white", font=font)
        left += image.shape[1]
    return np.asarray(bar)
