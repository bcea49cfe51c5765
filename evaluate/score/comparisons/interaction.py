"""Whether one system falls more than another: the paired difference of their changes."""

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Outcomes, Statuses, success
from robomme_interference_data.evaluate.systems import base_of, is_bound
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.stats.bootstrap import Interval
from robomme_interference_data.stats.intervals import mover_interval
from robomme_interference_data.stats.significance import sign_flip

from .contrast import START, Contrast
from .pairs import NO_PAIRS, Pairs, pair
from .ranks import ranked, to_best


def interactions_of(outcomes: Outcomes) -> list[Contrast]:
    """Compare each system's change from k0 with that of the best at k0, and of its base.

    The change is to the most sessions under which both have rows. Systems whose histories may
    differ are left out, and so are references.
    """
    leader, contrasts = None, []
    if systems := dict(ranked(outcomes)).get(START):
        leader, _ = to_best(outcomes, START, systems, np.ones(len(outcomes.episodes), bool))
    for system in outcomes.systems:
        if is_bound(system):
            continue
        others = dict.fromkeys(one for one in (leader, base_of(system)) if one and one != system)
        for other in others:
            if other in outcomes.systems and outcomes.pairable(system, other):
                contrasts += _contrasts(outcomes, system, other)
    return contrasts


def _contrasts(outcomes: Outcomes, system: str, other: str) -> list[Contrast]:
    common = [parse_condition(c) for c in outcomes.ran(system) if c in outcomes.ran(other)]
    ks = {one.k: one.name for one in common if one.kind.name == "k"}
    if len(ks) < 2 or 0 not in ks:
        return []
    last = ks[max(ks)]
    places = [outcomes.cell(name, c) for name in (other, system) for c in (START, last)]
    sides = np.stack([outcomes.status[place] for place in places])
    complete = all(bool(outcomes.complete[place]) for place in places)
    names = (outcomes.simulator, system, last, (other, last), "interaction")
    return [Contrast(*names, changes(sides[:2], sides[2:]), complete)]


def changes(first: Statuses, second: Statuses) -> Pairs:
    """Compare two changes over the episodes that count in all four cells.

    Each side is its outcomes before and after, `(2, E, M) int8`. The interval combines those of
    both changes and their correlation (`mover_interval`); the test is the exact sign-flip test of
    the episodes' differences of differences. `first` and `second` of the result are the changes,
    `pairs` episodes, gained and lost those whose change is higher or lower on the second side.
    """
    values = success(np.stack([*first, *second]))
    known = ~np.isnan(values).any(axis=0)
    n = int(known.sum())
    one, other = (pair(*(part[known] for part in side)) for side in (first, second))
    if not n:
        return NO_PAIRS
    old, new = values[1, known] - values[0, known], values[3, known] - values[2, known]
    spread = float(old.std() * new.std())
    phi = float(((old - old.mean()) * (new - new.mean())).mean()) / spread if spread else 0.0
    gap = round(other.change.value - one.change.value, 12)
    change, within = (
        Interval(gap, *mover_interval(b.value, (b.low, b.high), a.value, (a.low, a.high), phi, 2.0))
        for a, b in ((one.change, other.change), (one.within, other.within))
    )
    steps = (new - old).round(12)
    counts = (n, int((steps > 0).sum()), int((steps < 0).sum()))
    kind = other.interval if one.interval == other.interval else "clusters"
    sides = (one.change.value, other.change.value)
    return Pairs(n, *sides, change, within, kind, *counts, *sign_flip(steps))
