"""An encoder without weights: a small colour image and its gradients.

It knows colours and where they are, and nothing of objects. That suffices where the camera does
not move and scenes differ in what lies on the table; it would not on a moving camera.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Thumbnail"]

CELLS = 8
"""Cells along each side. More cells follow the arm, which moves, more than the scene, which
stays."""


class Thumbnail:
    """Mean colours of 8 × 8 cells and their differences to the next cell, right and below.

    Features are centred on the mean over the data set: what all frames share (table, walls, the
    robot's base) says nothing about which session a frame is of.
    """

    name = "thumbnail"
    centred = True
    batch = 64
    threshold = None
    computed_in = "numpy"

    @property
    def fingerprint(self) -> dict[str, Any]:
        """What determines the features."""
        return {"name": self.name, "version": 1, "cells": CELLS}

    def prepare(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the features, `(N, 528) float32`: colours from 0 to 1, then differences."""
        height, width = images.shape[1:3]
        rows, columns = _overlaps(height), _overlaps(width)
        sums = np.empty((len(images), CELLS, CELLS, 3))
        # Products and sums of integers below 2⁵³: exact in float64, in whatever order.
        for number, image in enumerate(images):
            bands = rows @ image.reshape(height, -1).astype(np.float64)
            sums[number] = np.tensordot(bands.reshape(CELLS, width, 3), columns, (1, 1)).swapaxes(1, 2)
        colours = sums / (255 * height * width)
        right = np.diff(colours, axis=2)
        below = np.diff(colours, axis=1)
        parts = [part.reshape(len(images), -1) for part in (colours, right, below)]
        return np.concatenate(parts, axis=1).astype(np.float32)

    def features(self, prepared: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what `prepare` made."""
        return prepared


def _overlaps(pixels: int) -> NDArray[np.float64]:
    """Return how much each pixel of a side lies in each cell, `(8, pixels)`, in 1/8 pixels."""
    edges = np.arange(CELLS + 1) * pixels
    starts = np.arange(pixels) * CELLS
    upper = np.minimum(edges[1:, None], starts + CELLS)
    lower = np.maximum(edges[:-1, None], starts)
    return np.maximum(upper - lower, 0).astype(np.float64)
