"""Systems compared under one condition: all pairs, and the ranks that follow from them."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Flags, Outcomes
from robomme_interference_data.evaluate.score.partners import share_weights
from robomme_interference_data.stats.bootstrap import Interval
from robomme_interference_data.stats.significance import ALPHA, holm
from robomme_interference_data.stats.signs import simultaneous
from robomme_interference_data.viz.tables import Table

from .comparison import (
    BOTH_SIDES,
    COMPLETE,
    RATES,
    SIDES,
    ComparisonTable,
    comparison_table,
    detectable,
)
from .contrast import Contrast, Effect, Measure
from .pairs import Pairs, compare_cells

_PairsOfSystems = Mapping[tuple[str, str], Pairs]


def all_pairs(
    outcomes: Outcomes, condition: str, systems: Sequence[str], here: Flags
) -> _PairsOfSystems:
    """Compare each pair of systems over some episodes: the first one's rate minus the second's.

    Systems whose histories may differ are compared unpaired.
    """
    compared = {}
    for system, other in combinations(systems, 2):
        second = outcomes.status[outcomes.cell(system, condition)][here]
        first = outcomes.status[outcomes.cell(other, condition)][here]
        compared[system, other] = compare_cells(
            first,
            second,
            outcomes.training,
            same_weights=share_weights(outcomes, system, other),
            paired=outcomes.pairable(system, other),
        )
    return compared


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
    for ((system, other), pairs), p in zip(compared.items(), ps, strict=True):
        if p < ALPHA:
            above, below = (system, other) if pairs.change.value > 0 else (other, system)
            better[below] += 1
            worse[above] += 1
    return {name: (1 + better[name], len(systems) - worse[name]) for name in systems}


def tied_with_best(systems: Sequence[str], compared: Mapping[tuple[str, str], Pairs]) -> set[str]:
    """Return the systems that no other one is significantly better than; empty for one system."""
    bounds = rank_bounds(systems, compared) if len(systems) > 1 else {}
    return {name for name, (first, _) in bounds.items() if first == 1}


@dataclass(frozen=True)
class Ranking:
    """A system among the ranked systems of a condition."""

    rank: int  # 1 for the highest rate
    rank_low: int  # the ranks that it can have, see `rank_bounds`
    rank_high: int
    best_system: str  # the highest rate, the first of equal ones
    behind: Interval  # its rate minus the best's, with an interval for all pairs; NaN for the best
    p_holm: float  # of that difference, corrected over all pairs, since the best is chosen by them

    @property
    def tied_with_best(self) -> bool:
        """Whether no other system is significantly better."""
        return self.rank_low == 1


def rankings(rates: Mapping[str, float], compared: _PairsOfSystems) -> dict[str, Ranking]:
    """Return where each of several systems stands, from rates and all pairs of them."""
    bounds = rank_bounds([*rates], compared)
    best = max(rates, key=lambda name: rates[name])
    ps = holm([pairs.p for pairs in compared.values()])
    p_holm = {frozenset(both): p for both, p in zip(compared, ps, strict=True)}
    ranking_of = {}
    for name, rate in rates.items():
        ranking_of[name] = Ranking(
            rank=1 + sum(other > rate for other in rates.values()),
            rank_low=bounds[name][0],
            rank_high=bounds[name][1],
            best_system=best,
            behind=_behind(name, best, compared),
            p_holm=p_holm.get(frozenset((name, best)), math.nan),
        )
    return ranking_of


def _behind(name: str, best: str, compared: _PairsOfSystems) -> Interval:
    """Return the difference of a system to the best one."""
    if name == best:
        return Interval(math.nan)
    level = simultaneous(len(compared))
    if (name, best) in compared:
        return compared[name, best].at(level)
    value, low, high = compared[best, name].at(level)
    return Interval(0.0 - value, -high, -low)  # -value of a tie would be -0.0


MATRIX = ComparisonTable(
    name="matrix",
    title="All pairs of systems",
    columns=SIDES | RATES | COMPLETE,
    corrected="the tests of a condition in one simulator",
    note=f"Complete cells within each condition. {BOTH_SIDES}",
)


def matrix_table(contrasts: Iterable[Contrast]) -> Table:
    """Return all pairs of systems among some comparisons."""
    pairs = [
        contrast
        for contrast in contrasts
        if contrast.effect is Effect.SYSTEMS and contrast.measure is Measure.SUCCESS
    ]
    table = comparison_table(MATRIX, pairs)
    return replace(table, note=f"{table.note} {detectable(pairs)}".strip())


def system_pairs(outcomes: Outcomes) -> Iterator[Contrast]:
    """Yield all pairs of the ranked systems of each condition.

    Ranked are complete cells, of systems that are no references.
    """
    all_episodes: Flags = np.ones(len(outcomes.episodes), bool)
    for place, condition in enumerate(outcomes.conditions):
        systems = [
            system
            for at, system in enumerate(outcomes.systems)
            if outcomes.complete[at, place] and not outcomes.is_reference(system)
        ]
        for (system, other), pairs in all_pairs(outcomes, condition, systems, all_episodes).items():
            yield Contrast(
                outcomes.simulator,
                system,
                condition,
                (other, condition),
                Effect.SYSTEMS,
                pairs,
                complete=True,
                group=("matrix", condition),
            )
