"""An encoder without weights: a small color image and its gradients.

It encodes colors and their positions, but no objects. This suffices for a static camera and scenes
that differ in what is on the table. Subtracting the image's mean color removes most of the light.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import KEY_FRAMES
from robomme_interference_data.errors import InvalidOptionError

CELLS = 8
"""Cells along each side; with more, the moving arm outweighs the static scene."""


class Thumbnail:
    """Mean colors of 8 × 8 cells minus the image's mean, and their differences to the next cells.

    Features are centered on the mean of the distractor units, because what all frames share (table,
    walls, the robot's base) does not distinguish sessions.
    """

    name = "thumbnail"
    centered = True
    batch = KEY_FRAMES  # frames between key frames, which threads decode separately
    computed_in = "numpy"

    def __init__(self) -> None:
        self.fingerprint: dict[str, Any] = {"name": self.name, "version": 2, "cells": CELLS}

    def prepare(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the features, `(N, 528) float32`: colors, then differences right and below."""
        height, width = images.shape[1:3]
        if min(height, width) < CELLS:
            expected = f"{CELLS} × {CELLS} or more for thumbnail"
            raise InvalidOptionError.expected("pixels", (height, width), expected)
        rows, columns = _edges(height), _edges(width)
        # Sums of integers are exact in any order.
        bands = np.add.reduceat(images, rows[:-1], axis=1, dtype=np.uint32)
        sums = np.add.reduceat(bands, columns[:-1], axis=2)
        pixels = np.diff(rows)[:, None, None] * np.diff(columns)[None, :, None]
        mean = sums.sum(axis=(1, 2), keepdims=True) / (255 * height * width)
        colors = sums / (255 * pixels) - mean
        right = np.diff(colors, axis=2)
        below = np.diff(colors, axis=1)
        parts = [part.reshape(len(images), -1) for part in (colors, right, below)]
        return np.concatenate(parts, axis=1).astype(np.float32)

    def features(self, prepared: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the features, which `prepare` computed."""
        return prepared


def _edges(pixels: int) -> NDArray[np.int64]:
    """Return the first pixel of each cell of a side, and the end, `(9,)`."""
    return np.arange(CELLS + 1) * pixels // CELLS
