"""Systems set against each other within a condition: differences to the best, ranks, all pairs."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.evaluate.score.outcomes import (
    Cube,
    Flags,
    counting,
    rate_of,
    success,
    trials,
)
from robomme_interference_data.evaluate.systems import is_bound
from robomme_interference_data.stats.bootstrap import DRAWS, Floats, drawn_means
from robomme_interference_data.stats.significance import SURE, holm
from robomme_interference_data.viz.tables import Table

from .contrasts import Contrast
from .pairs import Pairs, apart, pair


def against(cube: Cube, condition: str, one: str, other: str, here: Flags) -> Pairs:
    """Compare a system with another one under a condition, unpaired where their histories differ.

    Args:
        cube: What came of the rollouts.
        condition: Name of the condition.
        one: The system; differences are its rate − the other's.
        other: The other one.
        here: The episodes that are compared, `(E,) bool`.
    """
    sides = [cube.status[cube.cell(name, condition)][here] for name in (other, one)]
    if cube.pairable(one, other):
        return pair(*sides)
    counted = [int(counting(side).any(-1).sum()) for side in sides]
    return apart([(rate_of(s), trials(s), n) for s, n in zip(sides, counted, strict=True)])


def to_best(
    cube: Cube, condition: str, systems: Sequence[str], here: Flags
) -> dict[str, Pairs | None]:
    """Compare systems with the one of the highest rate, of equal ones the first.

    Args:
        cube: What came of the rollouts.
        condition: Name of the condition, under which each system has a complete cell.
        systems: Their names, in the order of tables.
        here: The episodes that are compared, `(E,) bool`.

    Returns:
        System to its comparison, and the best to None.
    """
    best = max(systems, key=lambda one: rate_of(cube.status[cube.cell(one, condition)][here]))
    return {s: None if s == best else against(cube, condition, s, best, here) for s in systems}


def cannot_be_told(compared: Mapping[str, Pairs | None]) -> set[str]:
    """Return the systems that cannot be told from the best, itself included; none of one alone.

    Args:
        compared: As `to_best` returns it.
    """
    others = {system: pairs.p for system, pairs in compared.items() if pairs}
    near = {s for s, p in zip(others, holm([*others.values()]), strict=True) if not p < SURE}
    return near | {*compared} - {*others} if others else set()


def ranked(cube: Cube) -> Iterator[tuple[str, list[str]]]:
    """Yield each condition and the systems that are ranked in it: of complete cells, no bounds."""
    for place, condition in enumerate(cube.conditions):
        whole = zip(cube.systems, cube.complete[:, place], strict=True)
        yield condition, [system for system, has in whole if has and not is_bound(system)]


def systems_of(cube: Cube) -> list[Contrast]:
    """Compare the ranked systems of each condition with the best, then all pairs of them.

    The first are of the table `systems`, the others of `matrix`: each with those after it.
    """
    every: Flags = np.ones(len(cube.episodes), bool)
    found, pairs = [], []
    for condition, systems in ranked(cube):
        if len(systems) < 2:
            continue
        compared = to_best(cube, condition, systems, every)
        best = next(system for system, pairs in compared.items() if pairs is None)
        found += [
            _contrast(cube, condition, system, best, "systems", pairs)
            for system, pairs in compared.items()
            if pairs is not None
        ]
        pairs += [
            _contrast(cube, condition, *two, "matrix", against(cube, condition, *two, every))
            for two in combinations(systems, 2)
        ]
    return found + pairs


def _contrast(
    cube: Cube, condition: str, system: str, other: str, table: str, pairs: Pairs
) -> Contrast:
    return Contrast(
        *(cube.simulator, system, condition, (other, condition), table, pairs),
        complete=True,
    )


def rank_table(cubes: Iterable[Cube], draws: int = DRAWS) -> Table:
    """Return the rank of each ranked system with the interval that draws of episodes give it."""
    rows = []
    for cube in cubes:
        for condition, systems in ranked(cube):
            if len(systems) < 2:
                continue
            sides = [cube.status[cube.cell(s, condition)][cube.expected] for s in systems]
            means = drawn_means(np.stack([*map(success, sides)], axis=1), cube.simulator, draws)
            rates = np.array([*map(rate_of, sides)])
            bounds = np.quantile(_ranks(means), (0.025, 0.975), axis=0, method="nearest").T
            rows += [
                (cube.simulator, condition, system, float(rate), int(rank), int(low), int(high))
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
