"""Things that look alike and change places at the end of a demonstration."""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import permutations
from typing import Any, ClassVar

from numpy.random import RandomState

from .family import Family, narrowed
from .kit import Body
from .motion import Arm, Script
from .stage import exchanges, shuffled, swap

Pair = tuple[int, int]


class SwapFamily(Family):
    """A family whose answer is one of several things, or several of them, by their numbers.

    They may change places in pairs once the answer was shown. Then each exchange is a part to be
    seen: who missed one knows where a thing was, and not where it is.

    Attributes:
        count: How many things there are.
        swaps: Those that change places, one pair after the other.
    """

    gap: ClassVar[float]
    """From their row to the lanes beside it, in m."""

    count: int
    swaps: Sequence[Pair] = ()

    def draw_swaps(self, rng: RandomState) -> None:
        """Choose what changes places."""
        self.swaps = exchanges(shuffled(rng, self.count))

    def swap(self, arm: Arm, groups: Sequence[Sequence[Body]], first: int) -> Script:
        """Let groups of bodies change places; the first exchange is the part `first`."""
        for part, pair in enumerate(self.swaps, first):
            self.showing = (part,)
            yield from swap(groups, pair, self.gap)
            self.showing = ()
            yield from arm.wait(5)

    def parts(self, answer: Any) -> tuple[str, ...]:
        """What is told of the answer, and then each exchange; see `Family.parts`."""
        return (*self.told(answer), *_words(_way(self.swaps)))

    def choice(self, answer: Any) -> int:
        """Where what is asked for has ended: of several things, the first."""
        return _end(answer, _way(self.swaps))[0]

    def agreeing(self, known: Mapping[int, str]) -> list[Any]:
        """The answers that may have ended where the right one did; see `Family.agreeing`."""
        way = _way(self.swaps)
        possible = _all_ways(self.count) if self.swaps else {way: ()}
        shown = len(self.told(self.answers[0]))
        fits = narrowed([*possible.items()], known, shown)
        places = {_end(answer, one) for answer in super().agreeing(known) for one in fits}
        return [answer for answer in self.answers if _end(answer, way) in places]


def _way(swaps: Iterable[Pair]) -> tuple[Pair, ...]:
    """Return at which places things are exchanged: what can be seen of those that look alike."""
    at: dict[int, int] = {}
    found = []
    for one, other in swaps:
        places = at.get(one, one), at.get(other, other)
        at[other], at[one] = places
        found.append((min(places), max(places)))
    return tuple(found)


@cache
def _all_ways(count: int) -> dict[tuple[Pair, ...], tuple[str, ...]]:
    """Return every way in which so many things may change places, and the same in words."""
    ways = (_way(exchanges(order)) for order in permutations(range(count)))
    return {way: _words(way) for way in ways}


def _end(answer: Any, way: Iterable[Pair]) -> tuple[int, ...]:
    """Return where the things of an answer end."""
    places = [answer] if isinstance(answer, int) else list(answer)
    for one, other in way:
        places = [other if at == one else one if at == other else at for at in places]
    return tuple(places)


def _words(way: Iterable[Pair]) -> tuple[str, ...]:
    return tuple(f"those at places {one} and {other} change places" for one, other in way)
