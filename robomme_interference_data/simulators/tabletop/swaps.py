"""Families whose things look alike and change places at the end of a demonstration."""

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import pairwise, permutations
from typing import Any, ClassVar

import numpy as np
from numpy.random import RandomState

from .bodies import Body, Placement
from .family import Family, consistent
from .layout import Spot, shuffled
from .motion import Arm, Script, eased

Pair = tuple[int, int]

STEPS = 30  # time steps of a swap


class SwapFamily(Family):
    """A family whose answer is the number of a thing, or the numbers of several.

    Things may swap places in pairs after the answer was shown. Each swap is then a part to
    remember: without it, one knows where a thing was, but not where it is.

    Attributes:
        gap: Distance in m from the row of things to the lanes beside it.
        count: How many things there are.
        swaps: Pairs of things that swap places, one pair after the other.
    """

    gap: ClassVar[float]
    count: int
    swaps: Sequence[Pair] = ()

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

    def parts(self, answer: Any) -> tuple[str, ...]:
        """Return the texts of the answer, then one text per swap; see `Family.parts`."""
        return (*self.answer_texts(answer), *_texts(_swapped_places(self.swaps)))

    def choice(self, answer: Any) -> int:
        """Return the place where the thing ends that is asked for; of several, the first."""
        return _final_places(answer, _swapped_places(self.swaps))[0]

    def agreeing(self, known: Mapping[int, str]) -> list[Any]:
        """Return the answers that may end where the right one does; see `Family.agreeing`."""
        actual = _swapped_places(self.swaps)
        possible = _all_swaps(self.count) if self.swaps else {actual: ()}
        first = len(self.answer_texts(self.answers[0]))
        fitting = consistent([*possible.items()], known, first)
        ends = {_final_places(one, swaps) for one in super().agreeing(known) for swaps in fitting}
        return [answer for answer in self.answers if _final_places(answer, actual) in ends]


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


def lanes(spots: Sequence[Spot], pair: Pair, gap: float) -> list[list[Spot]]:
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


def _swapped_places(swaps: Iterable[Pair]) -> tuple[Pair, ...]:
    """Return the pairs of places of the swaps: all that is visible when things look alike."""
    at: dict[int, int] = {}
    pairs = []
    for one, other in swaps:
        places = at.get(one, one), at.get(other, other)
        at[other], at[one] = places
        pairs.append((min(places), max(places)))
    return tuple(pairs)


@cache
def _all_swaps(count: int) -> dict[tuple[Pair, ...], tuple[str, ...]]:
    """Return every possible series of swaps of `count` things, with its texts."""
    all_pairs = (_swapped_places(swap_pairs(order)) for order in permutations(range(count)))
    return {pairs: _texts(pairs) for pairs in all_pairs}


def _final_places(answer: Any, pairs: Iterable[Pair]) -> tuple[int, ...]:
    """Return the places where the things of an answer end."""
    places = [answer] if isinstance(answer, int) else list(answer)
    for one, other in pairs:
        places = [other if at == one else one if at == other else at for at in places]
    return tuple(places)


def _texts(pairs: Iterable[Pair]) -> tuple[str, ...]:
    return tuple(f"those at places {one} and {other} change places" for one, other in pairs)
