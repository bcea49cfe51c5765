"""Random changes of images, the same for all images of an item and a camera."""

from collections.abc import Callable, Sequence
from typing import Any

import torch

from .draws import number_from
from .layout import memory_entry


def transform_images(
    batch: dict[str, Any],
    cameras: Sequence[str],
    transform: Callable[[torch.Tensor], torch.Tensor],
    keys: Sequence[tuple[int, ...]],
) -> None:
    """Change the images of a batch at random, all images of an item and a camera in the same way.

    The current image and those in memory are changed by one call, as frames of a video, with values
    from 0 to 1: some of LeRobot's transforms leave bytes unchanged.

    Args:
        batch: A batch with the names of the layout `plain`; is changed.
        cameras: Features of the cameras.
        transform: From `(M + 1, 3, S, S) float32` to the same.
        keys: For each item, what its random numbers follow from.
    """
    for place, key in enumerate(keys):
        for camera in cameras:
            now, memory = batch[camera][place], batch[memory_entry(camera)][place]
            # On CPUs only: other generators belong to the training.
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(number_from("transform", *key, camera))
                changed = transform(torch.cat([memory, now[None]]).float() / 255)
            pixels = (changed * 255).round().clamp(0, 255).to(torch.uint8)
            memory.copy_(pixels[:-1])
            now.copy_(pixels[-1])
