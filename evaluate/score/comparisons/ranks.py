"""Systems compared: difference to the best, ranks, all pairs, and who loses more from k0 on."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.evaluate.score.outcomes import (
    Flags,
    Outcomes,
    Statuses,
    rate_of,
    success,
)
from robomme_interference_data.evaluate.systems import base_of, is_bound
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.stats.bootstrap import DRAWS, Floats, Interval, drawn_means
from robomme_interference_data.stats.intervals import mover_interval
from robomme_interference_data.stats.significance import ALPHA, holm, sign_flip
from robomme_interference_data.viz.tables import Table

from .contrast import START, Contrast
from .pairs import NO_PAIRS, Pairs, compare_unpaired, pair


def against(outcomes: Outcomes, condition: str, one: str, other: str, here: Flags) -> Pairs:
    """Compare `one` with the `other`, unpaired where histories differ, over some episodes."""
    sides = [outcomes.status[outcomes.cell(name, condition)][here] for name in (other, one)]
    if outcomes.pairable(one, other):
        return pair(*sides)
    return compare_unpaired(*map(rate_of, sides))


def to_best(
    outcomes: Outcomes, condition: str, systems: Sequence[str], here: Flags
) -> tuple[str, dict[str, Pairs]]:
    """Return the first system of the highest rate, and the comparisons of the others with it."""
    cells = [outcomes.status[outcomes.cell(one, condition)][here] for one in systems]
    rates = [rate_of(cell).value for cell in cells]
    best = systems[rates.index(max(rates))]
    others = [system for system in systems if system != best]
    return best, {one: against(outcomes, condition, one, best, here) for one in others}


def tied_with_best(best: str, others: Mapping[str, Pairs]) -> set[str]:
    """Return the best and the systems not distinguishable from it; empty for a single system."""
    ps = holm([pairs.p for pairs in others.values()])
    tied = {system for system, p in zip(others, ps, strict=True) if not p < ALPHA}
    return tied | {best} if others else set()


def ranked(outcomes: Outcomes) -> Iterator[tuple[str, list[str]]]:
    """Yield each condition and the systems ranked in it: complete cells, no references."""
    for place, condition in enumerate(outcomes.conditions):
        whole = zip(outcomes.systems, outcomes.complete[:, place], strict=True)
        yield condition, [system for system, has in whole if has and not is_bound(system)]


def systems_of(outcomes: Outcomes) -> list[Contrast]:
    """Compare the ranked systems of each condition with the best (`systems`), and all pairs."""
    every: Flags = np.ones(len(outcomes.episodes), bool)
    found = {"systems": list[Contrast](), "matrix": list[Contrast]()}
    for condition, systems in ranked(outcomes):
        if len(systems) < 2:
            continue
        best, compared = to_best(outcomes, condition, systems, every)
        rows = [("systems", system, best, pairs) for system, pairs in compared.items()]
        for two in combinations(systems, 2):
            rows.append(("matrix", *two, against(outcomes, condition, *two, every)))
        for table, system, other, pairs in rows:
            names = (outcomes.simulator, system, condition, (other, condition))
            found[table].append(Contrast(*names, table, pairs, complete=True))
    return [*found["systems"], *found["matrix"]]


def rank_table(every: Iterable[Outcomes], draws: int = DRAWS) -> Table:
    """Return the rank of each ranked system with its bootstrap interval over episodes."""
    rows = []
    for outcomes in every:
        for condition, systems in ranked(outcomes):
            if len(systems) < 2:
                continue
            sides = [
                outcomes.status[outcomes.cell(s, condition)][outcomes.expected] for s in systems
            ]
            means = drawn_means(np.stack([*map(success, sides)], axis=1), outcomes.simulator, draws)
            rates = np.array([rate_of(side).value for side in sides])
            bounds = np.quantile(_ranks(means), (0.025, 0.975), axis=0, method="nearest").T
            rows += [
                (outcomes.simulator, condition, system, float(rate), int(rank), int(low), int(high))
                for system, rate, rank, (low, high) in zip(
                    systems, rates, _ranks(rates[None])[0], bounds, strict=True
                )
            ]
    return Table.make(
        "ranks",
        "Ranks of systems",
        "simulator condition system rate:rate rank:count rank_low:count rank_high:count",
        rows,
        "Complete cells only; rank 1 is the highest rate, and equal rates share a rank. rank_low "
        f"to rank_high: the middle 95% of a system's ranks in {draws:,} bootstrap draws of "
        "episodes, the same draws for all systems.",
    )


def _ranks(rates: Floats) -> NDArray[np.int64]:
    """Return 1 + the number of systems with a higher rate, `(D, S)`."""
    return 1 + np.stack([(rates > column[:, None]).sum(axis=1) for column in rates.T], axis=1)


# --- differences of changes --------------------------------------------------------------------


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
