"""Geometry and layout that several families share."""

import math

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray

from .bodies import Body, Placement
from .motion import Arm, eased

Spot = tuple[float, float]
Vector = NDArray[np.float64]

ABOVE = 0.001
"""How far above a surface the stick's tip stops when it touches it, in m."""


def row(
    rng: RandomState, count: int, x: float, spacing: float, jitter: float = 0.01, zigzag: float = 0
) -> list[Spot]:
    """Return spots in a row across the table, each displaced by up to `jitter`, in m."""
    spots = []
    for number in range(count):
        dx, dy = rng.uniform(-jitter, jitter, 2)
        side = zigzag if number % 2 else -zigzag
        spots.append((x + side + dx, (number - (count - 1) / 2) * spacing + dy))
    return spots


def shuffled(rng: RandomState, count: int) -> list[int]:
    """Return the numbers from 0 to `count` − 1 in random order."""
    return [int(number) for number in rng.permutation(count)]


def along(body: Body, to: Placement, steps: int) -> list[Placement]:
    """Return the placements of a body on a straight path, one per time step."""
    start, way = body.p, np.array(to.p) - body.p
    placements = []
    for step in range(1, steps + 1):
        x, y, z = start + eased(step / steps) * way
        placements.append(Placement((float(x), float(y), float(z)), body.home.yaw))
    return placements


def is_near(body: Body, other: Body, distance: float) -> bool:
    """Whether two bodies are within a distance of each other, seen from above."""
    return math.dist(body.p[:2], other.p[:2]) < distance


def distance_to_segment(point: Vector, one: Vector, other: Vector) -> float:
    """Return the distance of a point from the segment between two points, in m."""
    way = other - one
    part = float(np.clip((point - one) @ way / max(float(way @ way), 1e-12), 0, 1))
    return float(np.linalg.norm(point - one - part * way))


def push_down(button: Body, arm: Arm) -> bool:
    """Move the cap of a button with the closed gripper; return whether it is pressed."""
    x, y, top = button.home.p
    tip = arm.tip
    above = abs(tip[0] - x) < button.size and abs(tip[1] - y) < button.size and arm.opening < 0.01
    z = min(top, max(float(tip[2]), top - 0.015)) if above else top
    button.put(Placement((x, y, z)))
    return z < top - 0.006
