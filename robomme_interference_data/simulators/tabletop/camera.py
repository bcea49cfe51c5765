"""Projection of the scene's points into the front camera's image."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.schema.subgoal import Pixel

FRONT_EYE = (0.80, 0.0, 0.64)
"""Position of the front camera in m. It sees the table up to x = 0.14 m, and at its home pose the
whole arm except the top of its shoulder."""

FRONT_TARGET = (-0.30, 0.0, 0.21)
"""The point that it faces, in m."""

AWAY = 1.0
"""Whatever slides as far to a side, in m, is out of both cameras' view."""

FRONT_VIEW = math.radians(46)
SIZE = 256
"""Pixels of its image, vertically and horizontally."""


def looking(eye: Sequence[float], target: Sequence[float]) -> NDArray[np.float64]:
    """Return the pose, `(4, 4)`, of a camera at `eye` that faces `target`.

    Axes as in sapien: x ahead, y to the left, z up.
    """
    ahead = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    left = np.cross((0.0, 0.0, 1.0), ahead)
    left /= np.linalg.norm(left)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([ahead, left, np.cross(ahead, left)], axis=1)
    pose[:3, 3] = eye
    return pose


def to_pixels(
    points: Iterable[Sequence[float] | NDArray[np.float64]], pose: NDArray[np.float64] | None = None
) -> tuple[Pixel, ...]:
    """Project points, `(3,)` in m, into the front image, (y, x) in pixels, clipped to its edges.

    The points must be in front of the camera. `pose` is the camera's, if a shift has moved it.
    """
    pose = looking(FRONT_EYE, FRONT_TARGET) if pose is None else pose
    focal = SIZE / 2 / math.tan(FRONT_VIEW / 2)
    pixels = []
    for point in points:
        ahead, left, up = pose[:3, :3].T @ (np.asarray(point) - pose[:3, 3])
        y, x = (math.floor(SIZE / 2 - focal * part / ahead) for part in (up, left))
        pixels.append((min(max(y, 0), SIZE - 1), min(max(x, 0), SIZE - 1)))
    return tuple(pixels)
