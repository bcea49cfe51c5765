"""What several families share in laying out a scene and in what the scene does by itself."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray

from .kit import Body, Place
from .motion import Arm, Script, eased

Spot = tuple[float, float]
Vector = NDArray[np.float64]

STEPS = 30  # time steps of an exchange
ABOVE = 0.001
"""How far above a thing the stick's tip stops that is to touch it, in m."""


def row(
    rng: RandomState, count: int, x: float, spacing: float, jitter: float = 0.01, zigzag: float = 0
) -> list[Spot]:
    """Places in a row across the table, each off by up to `jitter`, in m."""
    places = []
    for number in range(count):
        dx, dy = rng.uniform(-jitter, jitter, 2)
        side = zigzag if number % 2 else -zigzag
        places.append((x + side + dx, (number - (count - 1) / 2) * spacing + dy))
    return places


def shuffled(rng: RandomState, count: int) -> list[int]:
    """The numbers from 0 to `count` − 1 in random order."""
    return [int(number) for number in rng.permutation(count)]


def exchanges(order: Sequence[int]) -> list[tuple[int, int]]:
    """Pairs of numbers that change places one after the other, as their order has it: none returns.

    Of three, one pair does and the third stays. Of four or more every one ends elsewhere: two
    and two, and with an odd count three in a ring.
    """
    count = len(order)
    pairs = list(zip(order[0:-1:2], order[1::2], strict=False))
    if count % 2 and count > 3:
        pairs.append((order[-3], order[-1]))
    return pairs


def along(body: Body, to: Place, steps: int) -> list[Place]:
    """The places of a body on its straight way somewhere."""
    start, way = body.p, np.array(to.p) - body.p
    places = []
    for step in range(1, steps + 1):
        x, y, z = start + eased(step / steps) * way
        places.append(Place((float(x), float(y), float(z)), body.home.yaw))
    return places


def lanes(spots: Sequence[Spot], pair: tuple[int, int], gap: float) -> list[list[Spot]]:
    """The ways of two of the things at `spots` that change places, a spot per time step.

    They meet nobody: one goes along a lane `gap` m beyond all spots, the other along one as far
    before them, and both come and go straight across.
    """
    (x0, y0), (x1, y1) = (spots[number] for number in pair)
    far, near = max(x for x, _ in spots) + gap, min(x for x, _ in spots) - gap
    ways = []
    for corners in (
        [(x0, y0), (far, y0), (far, y1), (x1, y1)],
        [(x1, y1), (near, y1), (near, y0), (x0, y0)],
    ):
        done = np.cumsum([0.0, *(math.dist(a, b) for a, b in pairwise(corners))])
        at = [eased(step / STEPS) * done[-1] for step in range(1, STEPS + 1)]
        xs, ys = (np.interp(at, done, axis) for axis in np.transpose(corners))
        ways.append([(float(x), float(y)) for x, y in zip(xs, ys, strict=True)])
    return ways


def swap(groups: Sequence[Sequence[Body]], pair: tuple[int, int], gap: float) -> Script:
    """Two of several groups of bodies change places, see `lanes`; each stays as it is.

    The bodies must be held, and their homes are where they end up.
    """
    spots = [(float(group[0].p[0]), float(group[0].p[1])) for group in groups]
    for now in zip(*lanes(spots, pair, gap), strict=True):
        for number, (x, y) in zip(pair, now, strict=True):
            for body in groups[number]:
                body.put(Place((x, y, float(body.p[2])), body.home.yaw))
        yield
    for number, (x, y) in zip(pair, now, strict=True):
        for body in groups[number]:
            body.home = Place((x, y, body.home.p[2]), body.home.yaw)


def is_near(body: Body, other: Body, distance: float) -> bool:
    """Whether two bodies are within a distance of each other, seen from above."""
    return math.dist(body.p[:2], other.p[:2]) < distance


def off_line(point: Vector, one: Vector, other: Vector) -> float:
    """Distance of a point from the straight line between two points, in m."""
    way = other - one
    part = float(np.clip((point - one) @ way / max(float(way @ way), 1e-12), 0, 1))
    return float(np.linalg.norm(point - one - part * way))


def push_down(button: Body, arm: Arm) -> bool:
    """Let the cap of a button follow the closed gripper; return whether it is pressed."""
    x, y, top = button.home.p
    tip = arm.tip
    above = abs(tip[0] - x) < button.size and abs(tip[1] - y) < button.size and arm.opening < 0.01
    z = min(top, max(float(tip[2]), top - 0.015)) if above else top
    button.put(Place((x, y, z)))
    return z < top - 0.006
