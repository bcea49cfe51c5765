"""What the leak probe concludes from plays that repeat each other, or differ.

A rollout is repeated after other rollouts. If its values differ, all plays are repeated in the same
order: a state that survives a reset gives the same differences again, noise does not.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import combinations

from .trace import Event, Play


class ProbeVerdict(Enum):
    """What plays show."""

    INDEPENDENT = "independent"
    """All values are the same after any predecessor."""

    LEAK = "leak"
    """Values differ after another predecessor, and never after the same one."""

    NOISE = "nondeterministic"
    """Values differ after the same predecessor, too."""


@dataclass(frozen=True)
class FirstDifference:
    """The first value in which two plays of a rollout differ."""

    event: Event
    first: Play
    second: Play


def judge(plays: Sequence[Play]) -> tuple[ProbeVerdict, FirstDifference | None]:
    """Return what plays show, and the earliest difference that shows it.

    The values of a play follow either from all that its client did since it was new, or, in a
    process or server that outlives its clients, from the play just before. If no two plays with
    the same past differ, and two that do differ were both repeated, a state survives.
    """
    apart = _differences(plays)
    if not apart:
        return ProbeVerdict.INDEPENDENT, None
    for past in (_since_new, _just_before):
        explained = all(past(each.first) != past(each.second) for each in apart)
        times = Counter(map(past, plays))
        repeated = [
            each for each in apart if min(times[past(each.first)], times[past(each.second)]) > 1
        ]
        if explained and repeated:
            return ProbeVerdict.LEAK, min(repeated, key=_step)
    same = [each for each in apart if _since_new(each.first) == _since_new(each.second)]
    return ProbeVerdict.NOISE, min(same or apart, key=_step)


def _since_new(play: Play) -> tuple[object, ...]:
    return play.planned.item, play.planned.beside, play.past


def _just_before(play: Play) -> tuple[object, ...]:
    return play.planned.item, play.planned.beside, play.after


def _step(difference: FirstDifference) -> int:
    return difference.event.step


def _differences(plays: Sequence[Play]) -> list[FirstDifference]:
    """Return the first difference of each two plays of a rollout that differ."""
    found = []
    for first, second in combinations(plays, 2):
        if first.planned.item == second.planned.item:
            event = first_difference(first.events, second.events)
            if event is not None:
                found.append(FirstDifference(event, first, second))
    return found


def first_difference(first: Sequence[Event], second: Sequence[Event]) -> Event | None:
    """Return the first event in which two traces differ, as far as both go; None without one."""
    return next((b for a, b in zip(first, second, strict=False) if a != b), None)
