"""Resize frames for training and, in the same way, for a policy in a rollout."""

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.storage.resize import resize_image


def resize(frames: NDArray[np.uint8], size: int | None) -> NDArray[np.uint8]:
    """Return frames with their channels first, as squares of `size` pixels.

    Each pixel is the mean of the area that it covers, as in `build --resize`; the result is the
    same on every machine.

    Args:
        frames: `(T, H, W, 3) uint8` RGB.
        size: Side in pixels; None for no change of size.

    Returns:
        `(T, 3, size, size) uint8`, or `(T, 3, H, W) uint8` if `size` is None.
    """
    if size is not None and frames.shape[1:3] != (size, size):
        resized = np.empty((len(frames), size, size, frames.shape[3]), np.uint8)
        for target, frame in zip(resized, frames, strict=True):
            target[...] = resize_image(frame, size, size)
        frames = resized
    return np.ascontiguousarray(frames.transpose(0, 3, 1, 2))
