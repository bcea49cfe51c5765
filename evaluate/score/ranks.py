"""Systems set against each other within a condition: which of them cannot be told from the best."""

from collections.abc import Mapping, Sequence

import numpy as np

from robomme_interference_data.evaluate.score.cube import Cube, Flags, success, trials
from robomme_interference_data.evaluate.score.pairs import Pairs, apart, pair
from robomme_interference_data.significance import SURE, holm


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
    counted = [
        (rates[~np.isnan(rates)], trials(side)) for side in sides for rates in [success(side)]
    ]
    return apart([(float(rates.mean()), worth, len(rates)) for rates, worth in counted])


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
    rates = [np.nanmean(success(cube.status[cube.cell(s, condition)][here])) for s in systems]
    # Rounded: means of repeats that are equal may differ in the last bit.
    best = systems[int(np.argmax(np.round(rates, 12)))]
    return {s: None if s == best else against(cube, condition, s, best, here) for s in systems}


def cannot_be_told(compared: Mapping[str, Pairs | None]) -> set[str]:
    """Return the systems that cannot be told from the best, itself included; none of one alone.

    Args:
        compared: As `to_best` returns it.
    """
    others = {system: pairs.p for system, pairs in compared.items() if pairs}
    near = {s for s, p in zip(others, holm([*others.values()]), strict=True) if not p < SURE}
    return near | {*compared} - {*others} if others else set()
