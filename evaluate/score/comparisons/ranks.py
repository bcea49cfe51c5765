"""Systems set against each other within a condition: differences to the best, ranks, all pairs."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.evaluate.score.outcomes import Flags, Outcomes, rate_of, success
from robomme_interference_data.evaluate.systems import is_bound
from robomme_interference_data.stats.bootstrap import DRAWS, Floats, drawn_means
from robomme_interference_data.stats.significance import ALPHA, holm
from robomme_interference_data.viz.tables import Table

from .contrast import Contrast
from .pairs import Pairs, compare_unpaired, pair


def against(outcomes: Outcomes, condition: str, one: str, other: str, here: Flags) -> Pairs:
    """Compare `one` with the `other`, unpaired where histories differ, over some episodes."""
    sides = [outcomes.status[outcomes.cell(name, condition)][here] for name in (other, one)]
    if outcomes.pairable(one, other):
        return pair(*sides)
    return compare_unpaired(*map(rate_of, sides))


def to_best(
    outcomes: Outcomes, condition: str, systems: Sequence[str], here: Flags
) -> tuple[str, dict[str, Pairs]]:
    """Return the first system of the highest rate, and the others' comparisons with it.

    Each has a complete cell under the condition; the episodes that are compared are `(E,) bool`.
    """
    cells = [outcomes.status[outcomes.cell(one, condition)][here] for one in systems]
    rates = [rate_of(cell).value for cell in cells]
    best = systems[rates.index(max(rates))]
    others = [system for system in systems if system != best]
    return best, {one: against(outcomes, condition, one, best, here) for one in others}


def tied_with_best(best: str, others: Mapping[str, Pairs]) -> set[str]:
    """Return the systems that cannot be told from the best, itself included; none of one alone."""
    ps = holm([pairs.p for pairs in others.values()])
    near = {system for system, p in zip(others, ps, strict=True) if not p < ALPHA}
    return near | {best} if others else set()


def ranked(outcomes: Outcomes) -> Iterator[tuple[str, list[str]]]:
    """Yield each condition and the systems that are ranked in it: of complete cells, no bounds."""
    for place, condition in enumerate(outcomes.conditions):
        whole = zip(outcomes.systems, outcomes.complete[:, place], strict=True)
        yield condition, [system for system, has in whole if has and not is_bound(system)]


def systems_of(outcomes: Outcomes) -> list[Contrast]:
    """Compare the ranked systems of each condition with the best, then all pairs of them.

    The first are of the table `systems`, the others of `matrix`: each with those after it.
    """
    every: Flags = np.ones(len(outcomes.episodes), bool)
    found, matrix = list[Contrast](), list[Contrast]()
    for condition, systems in ranked(outcomes):
        if len(systems) < 2:
            continue

        def contrast(
            system: str, other: str, table: str, pairs: Pairs, condition: str = condition
        ) -> Contrast:
            names = (outcomes.simulator, system, condition, (other, condition))
            return Contrast(*names, table, pairs, complete=True)

        best, compared = to_best(outcomes, condition, systems, every)
        found += [contrast(s, best, "systems", pairs) for s, pairs in compared.items()]
        for two in combinations(systems, 2):
            pairs = against(outcomes, condition, *two, every)
            matrix.append(contrast(*two, "matrix", pairs))
    return found + matrix


def rank_table(every: Iterable[Outcomes], draws: int = DRAWS) -> Table:
    """Return the rank of each ranked system with the interval that draws of episodes give it."""
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
        "Complete cells; 1 is the highest rate, equal rates share a rank. rank_low to rank_high: "
        f"the middle 95% of a system's ranks in {draws:,} draws of episodes, the same for all "
        "systems.",
    )


def _ranks(rates: Floats) -> NDArray[np.int64]:
    """Return 1 + the number of systems with a higher rate, `(D, S)`."""
    return 1 + np.stack([(rates > own[:, None]).sum(axis=1) for own in rates.T], axis=1)
