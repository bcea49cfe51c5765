"""Systems compared: all pairs, the best ones, and ranks."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Flags, Outcomes, rate_of
from robomme_interference_data.stats.significance import ALPHA, holm
from robomme_interference_data.stats.signs import simultaneous
from robomme_interference_data.viz.tables import Table

from .contrast import Contrast
from .pairs import Pairs, compare_unpaired, pair

_Compared = dict[tuple[str, str], Pairs]


def against(outcomes: Outcomes, condition: str, one: str, other: str, here: Flags) -> Pairs:
    """Compare `one` with the `other`, unpaired where histories differ, over some episodes."""
    sides = [outcomes.status[outcomes.cell(name, condition)][here] for name in (other, one)]
    if outcomes.pairable(one, other):
        return pair(*sides)
    return compare_unpaired(*map(rate_of, sides))


def all_pairs(outcomes: Outcomes, condition: str, systems: Sequence[str], here: Flags) -> _Compared:
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


def ranked(outcomes: Outcomes) -> Iterator[tuple[str, dict[str, float], _Compared]]:
    """Yield each condition with several ranked systems, their rates, and each pair compared.

    Ranked are complete cells, of systems that are no references.
    """
    every: Flags = np.ones(len(outcomes.episodes), bool)
    for place, condition in enumerate(outcomes.conditions):
        rates = {
            system: rate_of(outcomes.status[at, place]).value
            for at, system in enumerate(outcomes.systems)
            if outcomes.complete[at, place] and not outcomes.is_reference(system)
        }
        if len(rates) > 1:
            yield condition, rates, all_pairs(outcomes, condition, list(rates), every)


def systems_of(outcomes: Outcomes) -> list[Contrast]:
    """Compare the ranked systems of each condition: each with the highest rate, and all pairs.

    Both are corrected over all pairs, since the highest rate is chosen from the same data.
    """
    every: Flags = np.ones(len(outcomes.episodes), bool)
    found = {"systems": list[Contrast](), "matrix": list[Contrast]()}
    for condition, rates, compared in ranked(outcomes):
        ps = zip(compared, holm([pairs.p for pairs in compared.values()]), strict=True)
        corrected = {frozenset(both): p for both, p in ps}
        best = max(rates, key=lambda one: rates[one])
        rows = [("matrix", *both, pairs) for both, pairs in compared.items()]
        for one in rates:
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
        for condition, rates, compared in ranked(outcomes):
            bounds = rank_bounds(list(rates), compared)
            for name, rate in rates.items():
                rank = 1 + sum(other > rate for other in rates.values())
                rows.append((outcomes.simulator, condition, name, rate, rank, *bounds[name]))
    return Table(
        "ranks",
        "Ranks of systems",
        {
            "simulator": "text",
            "condition": "text",
            "system": "text",
            "rate": "rate",
            "rank": "count",
            "rank_low": "count",
            "rank_high": "count",
        },
        rows,
        "Complete cells only; rank 1 is the highest rate, and equal rates share a rank. rank low "
        "to rank high: the ranks that the system can have, from the significant differences of the "
        "table matrix (p holm below 0.05): 1 + the systems that are better, to the number of "
        "systems less those that are worse. All of a condition hold at once with 95% confidence.",
    )
