"""Systems compared: all pairs, the best ones, and ranks."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Flags, Outcomes, rate_of
from robomme_interference_data.evaluate.systems import is_reference
from robomme_interference_data.stats.significance import ALPHA, holm
from robomme_interference_data.stats.signs import simultaneous
from robomme_interference_data.viz.tables import Table

from .contrast import Contrast
from .pairs import Pairs, compare_unpaired, pair


def against(outcomes: Outcomes, condition: str, one: str, other: str, here: Flags) -> Pairs:
    """Compare `one` with the `other`, unpaired where histories differ, over some episodes."""
    sides = [outcomes.status[outcomes.cell(name, condition)][here] for name in (other, one)]
    if outcomes.pairable(one, other):
        return pair(*sides)
    return compare_unpaired(*map(rate_of, sides))


def all_pairs(
    outcomes: Outcomes, condition: str, systems: Sequence[str], here: Flags
) -> dict[tuple[str, str], Pairs]:
    """Compare each pair of systems, the first with the second, over some episodes."""
    two = combinations(systems, 2)
    return {both: against(outcomes, condition, *both, here) for both in two}


def rank_bounds(
    systems: Sequence[str], compared: Mapping[tuple[str, str], Pairs]
) -> dict[str, tuple[int, int]]:
    """Return the ranks that each system can have, from its comparisons with all others.

    The first rank is 1 + the number of systems that are significantly better, the last the number
    of systems less those that are significantly worse, by p after Holm's correction over all pairs.
    With 95% confidence, all true ranks are within their bounds.
    """
    better = dict.fromkeys(systems, 0)
    worse = dict.fromkeys(systems, 0)
    ps = holm([pairs.p for pairs in compared.values()])
    for ((one, other), pairs), p in zip(compared.items(), ps, strict=True):
        if p < ALPHA:
            above, below = (one, other) if pairs.change.value > 0 else (other, one)
            better[below] += 1
            worse[above] += 1
    return {name: (1 + better[name], len(systems) - worse[name]) for name in systems}


def tied_with_best(systems: Sequence[str], compared: Mapping[tuple[str, str], Pairs]) -> set[str]:
    """Return the systems that no other one is significantly better than; empty for one system."""
    bounds = rank_bounds(systems, compared) if len(systems) > 1 else {}
    return {name for name, (first, _) in bounds.items() if first == 1}


def ranked(outcomes: Outcomes) -> Iterator[tuple[str, list[str]]]:
    """Yield each condition and the systems ranked in it: complete cells, no references."""
    for place, condition in enumerate(outcomes.conditions):
        whole = zip(outcomes.systems, outcomes.complete[:, place], strict=True)
        yield condition, [system for system, has in whole if has and not is_reference(system)]


def systems_of(outcomes: Outcomes) -> list[Contrast]:
    """Compare the ranked systems of each condition: each with the highest rate, and all pairs.

    Both are corrected over all pairs, since the highest rate is chosen from the same data.
    """
    every: Flags = np.ones(len(outcomes.episodes), bool)
    found = {"systems": list[Contrast](), "matrix": list[Contrast]()}
    for condition, systems in ranked(outcomes):
        if len(systems) < 2:
            continue
        compared = all_pairs(outcomes, condition, systems, every)
        ps = zip(compared, holm([pairs.p for pairs in compared.values()]), strict=True)
        corrected = {frozenset(both): p for both, p in ps}
        rates = [rate_of(outcomes.status[outcomes.cell(one, condition)]).value for one in systems]
        best = systems[rates.index(max(rates))]
        rows = [("matrix", *both, pairs) for both, pairs in compared.items()]
        for one in systems:
            if one != best:
                rows.append(("systems", one, best, against(outcomes, condition, one, best, every)))
        for table, one, other, pairs in rows:
            more = {"p_holm": corrected[frozenset((one, other))], "tests": len(compared)}
            if table == "systems":
                joint = pairs.at(simultaneous(len(compared)))
                more |= {"low": joint.low, "high": joint.high}
            names = (outcomes.simulator, one, condition, (other, condition), table)
            found[table].append(Contrast(*names, pairs, complete=True, more=more))
    return [*found["systems"], *found["matrix"]]


def rank_table(every: Iterable[Outcomes]) -> Table:
    """Return the rank of each ranked system, and the ranks that it can have."""
    rows = []
    for outcomes in every:
        here: Flags = np.ones(len(outcomes.episodes), bool)
        for condition, systems in ranked(outcomes):
            if len(systems) < 2:
                continue
            bounds = rank_bounds(systems, all_pairs(outcomes, condition, systems, here))
            cells = [outcomes.status[outcomes.cell(one, condition)] for one in systems]
            rates = {name: rate_of(cell).value for name, cell in zip(systems, cells, strict=True)}
            rows += [
                (outcomes.simulator, condition, name, rate, rank, *bounds[name])
                for name, rate in rates.items()
                for rank in [1 + sum(other > rate for other in rates.values())]
            ]
    return Table.make(
        "ranks",
        "Ranks of systems",
        "simulator condition system rate:rate rank:count rank_low:count rank_high:count",
        rows,
        "Complete cells only; rank 1 is the highest rate, and equal rates share a rank. rank low "
        "to rank high: the ranks that the system can have, from the significant differences of the "
        "table matrix (p holm below 0.05): 1 + the systems that are better, to the number of "
        "systems less those that are worse. All of a condition hold at once with 95% confidence.",
    )
