"""Families whose things look alike and change places at the end of a demonstration."""

import math
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise, permutations
from typing import ClassVar

import numpy as np
from numpy.random import RandomState

from robomme_interference_data.simulators.scene import Pair, SwapScene, swap_texts, swapped_places

from .bodies import Body, Placement
from .family import Family, TablePoint, shuffled
from .motion import Arm, Script, eased

STEPS = 30  # time steps of a swap


class SwapFamily(SwapScene, Family):
    """A family whose things may swap places; see `SwapScene`.

    Attributes:
        gap: Distance in m from the row of things to the lanes beside it.
        count: How many things there are.
    """

    gap: ClassVar[float]
    count: int

    def draw_swaps(self, rng: RandomState) -> None:
        """Draw the pairs that swap places."""
        self.swaps = swap_pairs(shuffled(rng, self.count))

    def swap(self, arm: Arm, groups: Sequence[Sequence[Body]], first: int) -> Script:
        """Swap the places of groups of bodies; the first swap shows the part `first`.

        The bodies must be held; where they end becomes their home.
        """
        for part, pair in enumerate(self.swaps, first):
            self.showing = (part,)
            spots = [(float(group[0].p[0]), float(group[0].p[1])) for group in groups]
            for positions in zip(*lanes(spots, pair, self.gap), strict=True):
                for number, (x, y) in zip(pair, positions, strict=True):
                    for body in groups[number]:
                        body.put(Placement((x, y, float(body.p[2])), body.home.yaw))
                yield
            for number, (x, y) in zip(pair, positions, strict=True):
                for body in groups[number]:
                    body.home = Placement((x, y, body.home.p[2]), body.home.yaw)
            self.showing = ()
            yield from arm.wait(5)

    def possible_swaps(self) -> Mapping[tuple[Pair, ...], tuple[str, ...]]:
        """Return every possible series of swaps; see `SwapScene.possible_swaps`."""
        return _all_swaps(self.count) if self.swaps else {(): ()}


def swap_pairs(order: Sequence[int]) -> list[Pair]:
    """Return pairs that swap places one after the other, so that no thing returns to its place.

    Of three things, one pair swaps and the third stays. Of four or more every one ends elsewhere:
    two and two, and with an odd count three in a ring.
    """
    count = len(order)
    pairs = list(zip(order[0:-1:2], order[1::2], strict=False))
    if count % 2 and count > 3:
        pairs.append((order[-3], order[-1]))
    return pairs


def lanes(spots: Sequence[TablePoint], pair: Pair, gap: float) -> list[list[TablePoint]]:
    """Return the paths of two things that swap places, a spot per time step.

    They collide with nothing: one moves along a lane `gap` m beyond all spots, the other along a
    lane as far in front of them.
    """
    (x0, y0), (x1, y1) = (spots[number] for number in pair)
    far, near = max(x for x, _ in spots) + gap, min(x for x, _ in spots) - gap
    paths = []
    for corners in (
        [(x0, y0), (far, y0), (far, y1), (x1, y1)],
        [(x1, y1), (near, y1), (near, y0), (x0, y0)],
    ):
        done = np.cumsum([0.0, *(math.dist(a, b) for a, b in pairwise(corners))])
        at = [eased(step / STEPS) * done[-1] for step in range(1, STEPS + 1)]
        xs, ys = (np.interp(at, done, axis) for axis in np.transpose(corners))
        paths.append([(float(x), float(y)) for x, y in zip(xs, ys, strict=True)])
    return paths


@cache
def _all_swaps(count: int) -> dict[tuple[Pair, ...], tuple[str, ...]]:
    """Return every possible series of swaps of `count` things, with its texts."""
    all_pairs = (swapped_places(swap_pairs(order)) for order in permutations(range(count)))
    return {pairs: swap_texts(pairs) for pairs in all_pairs}
