"""Resize images: one rule for datasets that are built, for training and for a policy in a rollout.

A pixel of the result is the mean of the area that it covers in the given image. Sums are exact
integers, so the result is the same on every machine.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray


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


def resize_image(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Return an image in another size, `(height, width, C) uint8`.

    A pixel that is partly inside an area counts in proportion; the mean is rounded half to even.
    So 4 pixels 0, 10, 20, 30 become the 3 pixels 2, 15, 28: the first covers one pixel and a third,
    (3 · 0 + 1 · 10) / 4 = 2.5.

    Args:
        image: `(H, W, C) uint8`.
        width: Width in pixels, at least 1; may be larger than that of the image.
        height: Height in pixels, at least 1; the same.
    """
    given_height, given_width, channels = image.shape
    if (given_width, given_height) == (width, height):
        return image
    rows = _area_sums(image.reshape(given_height, -1), height, 255)
    columns = rows.reshape(height, given_width, channels).transpose(1, 0, 2)
    sums = _area_sums(columns.reshape(given_width, -1), width, 255 * given_height)
    # The weights of a pixel add up to the given height, and to the given width.
    weight = given_height * given_width
    means, rest = np.divmod(sums.reshape(width, height, channels).transpose(1, 0, 2), weight)
    half = 2 * rest
    means += (half > weight) | ((half == weight) & (means % 2 == 1))
    return means.astype(np.uint8, order="C")


def _area_sums(values: NDArray[Any], size: int, largest: int) -> NDArray[Any]:
    """Return sums over `size` areas of equal length along the first of two axes.

    The unit of length is a `size`-th of a value: a value is `size` long, an area as long as there
    are values. No value is above `largest`.
    """
    given = len(values)
    total = given * size * largest
    exact = values.astype(np.int64 if total > np.iinfo(np.int32).max else np.int32)
    # The border after an area: so many values before it are whole, and a part of the next one.
    whole, part = np.divmod(np.arange(1, size + 1) * given, size)
    before = np.zeros((given + 1, exact.shape[1]), exact.dtype)
    np.cumsum(exact, axis=0, out=before[1:])
    until = size * before[whole]
    cut = part > 0
    until[cut] += part[cut, None].astype(exact.dtype) * exact[whole[cut]]
    until[1:] -= until[:-1].copy()
    return until
