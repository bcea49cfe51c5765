"""An encoder without weights: a small colour image and its gradients.

It knows colours and where they are, and nothing of objects. That suffices where the camera does
not move and scenes differ in what lies on the table; it would not on a moving camera. Of the light
it knows little: the image's mean colour is taken off.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import KEY_FRAMES
from robomme_interference_data.errors import InvalidOptionError

CELLS = 8
"""Cells along each side. More cells follow the arm, which moves, more than the scene, which
stays."""


class Thumbnail:
    """Mean colours of 8 × 8 cells, less the image's, and their differences to the next cells.

    Features are centred on the mean of the distractor units: what all frames share (table, walls,
    the robot's base) says nothing about which session a frame is of.
    """

    name = "thumbnail"
    centred = True
    batch = KEY_FRAMES  # from which threads decode
    computed_in = "numpy"

    def __init__(self) -> None:
        self.fingerprint: dict[str, Any] = {"name": self.name, "version": 2, "cells": CELLS}

    def prepare(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the features, `(N, 528) float32`: colours, then differences right and below."""
        height, width = images.shape[1:3]
        if min(height, width) < CELLS:
            expected = f"{CELLS} × {CELLS} or more for thumbnail"
            raise InvalidOptionError.expected("pixels", (height, width), expected)
        rows, columns = _edges(height), _edges(width)
        # Sums of integers: exact, in whatever order.
        bands = np.add.reduceat(images, rows[:-1], axis=1, dtype=np.uint32)
        sums = np.add.reduceat(bands, columns[:-1], axis=2)
        pixels = np.diff(rows)[:, None, None] * np.diff(columns)[None, :, None]
        mean = sums.sum(axis=(1, 2), keepdims=True) / (255 * height * width)
        colours = sums / (255 * pixels) - mean
        right = np.diff(colours, axis=2)
        below = np.diff(colours, axis=1)
        parts = [part.reshape(len(images), -1) for part in (colours, right, below)]
        return np.concatenate(parts, axis=1).astype(np.float32)

    def features(self, prepared: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what `prepare` made."""
        return prepared


def _edges(pixels: int) -> NDArray[np.int64]:
    """Return the first pixel of each cell of a side, and the end, `(9,)`."""
    return np.arange(CELLS + 1) * pixels // CELLS
