"""What several families share in laying out a scene and in what the scene does by itself."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.random import RandomState

from robomme_interference_data.simulators.tabletop.kit import Body, Place
from robomme_interference_data.simulators.tabletop.motion import Arm, Script

__all__ = ["along", "is_near", "push_down", "row", "shuffled", "swap", "touched"]

Spot = tuple[float, float]


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


def along(body: Body, to: Place, steps: int, bend: float = 0.0) -> list[Place]:
    """The places of a body on its way somewhere: straight, or bent by `bend` m to its left."""
    start, end = body.p, np.array(to.p)
    way = end - start
    left = np.array([-way[1], way[0], 0.0]) / max(float(np.linalg.norm(way[:2])), 1e-9)
    places = []
    for step in range(1, steps + 1):
        part = step / steps
        part = part * part * (3 - 2 * part)
        x, y, z = start + part * way + bend * math.sin(math.pi * part) * left
        places.append(Place((float(x), float(y), float(z)), body.home.yaw))
    return places


def swap(one: Sequence[Body], other: Sequence[Body], bend: float = 0.07, steps: int = 20) -> Script:
    """Two groups of bodies change places on bent ways; each group stays as it is.

    The bodies must be held, and their homes are where they end up.
    """
    ways = []
    for group, goal in ((one, other), (other, one)):
        x, y, _ = goal[0].p
        for body in group:
            ways.append((body, along(body, Place((x, y, body.p[2])), steps, bend)))
    for step in range(steps):
        for body, places in ways:
            body.put(places[step])
        yield
    for body, places in ways:
        x, y, _ = places[-1].p
        body.home = Place((x, y, body.home.p[2]), body.home.yaw)


def is_near(body: Body, other: Body, distance: float) -> bool:
    """Whether two bodies are within a distance of each other, seen from above."""
    return math.dist(body.p[:2], other.p[:2]) < distance


def touched(arm: Arm, spots: Sequence[Spot], radius: float, low: float = 0.03) -> int | None:
    """Return which of the flat things at `spots` the stick's tip is on, or None."""
    x, y, z = arm.tip
    for number, spot in enumerate(spots):
        if z < low and math.dist((x, y), spot) < radius:
            return number
    return None


def push_down(button: Body, arm: Arm) -> bool:
    """Let the cap of a button follow the closed gripper; return whether it is pressed."""
    x, y, top = button.home.p
    tip = arm.tip
    above = abs(tip[0] - x) < button.size and abs(tip[1] - y) < button.size and arm.opening < 0.01
    z = min(top, max(float(tip[2]), top - 0.015)) if above else top
    button.put(Place((x, y, z)))
    return z < top - 0.006
