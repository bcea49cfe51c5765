"""Where a point of the scene is in the front camera's image: pure."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.schema.subgoal import Pixel

FRONT_EYE = (0.80, 0.0, 0.64)
"""Where the front camera stands, in m: the table up to x = 0.14 m, and at its home pose the whole
arm but for the top of its shoulder."""

FRONT_TARGET = (-0.30, 0.0, 0.21)
"""Where it looks, in m."""

FRONT_VIEW = math.radians(46)
SIZE = 256
"""Pixels of its image, down and across."""


def looking(eye: Sequence[float], target: Sequence[float]) -> NDArray[np.float64]:
    """Return the pose of a camera that looks from one point at another, `(4, 4)`.

    As sapien has it: x ahead, y to the left, z up.
    """
    ahead = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    left = np.cross((0.0, 0.0, 1.0), ahead)
    left /= np.linalg.norm(left)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([ahead, left, np.cross(ahead, left)], axis=1)
    pose[:3, 3] = eye
    return pose


def to_pixels(
    points: Iterable[Sequence[float] | NDArray[np.float64]],
    pose: NDArray[np.float64] | None = None,
) -> tuple[Pixel, ...]:
    """Return where points are in the front image, (y, x) in pixels; beyond it, at its edge.

    Args:
        points: Of the scene, `(3,)` each, in m, before the camera.
        pose: The camera's; None where no shift has moved it.
    """
    pose = looking(FRONT_EYE, FRONT_TARGET) if pose is None else pose
    focal = SIZE / 2 / math.tan(FRONT_VIEW / 2)
    found = []
    for point in points:
        ahead, left, up = pose[:3, :3].T @ (np.asarray(point) - pose[:3, 3])
        y, x = (math.floor(SIZE / 2 - focal * part / ahead) for part in (up, left))
        found.append((min(max(y, 0), SIZE - 1), min(max(x, 0), SIZE - 1)))
    return tuple(found)
