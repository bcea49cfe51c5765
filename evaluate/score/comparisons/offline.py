"""Paired comparisons of action errors along recordings: between conditions, and systems."""

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Outcomes, mean_errors
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.stats.bootstrap import DRAWS
from robomme_interference_data.stats.signs import sign_flips

from .contrast import START, Contrast, comparable
from .pairs import pair_errors

_Cell = tuple[str, str]  # system and condition

CHANGES, SYSTEMS = "action_error_changes", "action_error_systems"
"""The tables of comparisons offline, see `tables.SPECS`."""


def error_contrasts(outcomes: Outcomes, draws: int = DRAWS) -> list[Contrast]:
    """Compare the conditions of each system, and all pairs of systems under each condition."""
    compared = [(CHANGES, *cells) for system in outcomes.systems for cells in _of(outcomes, system)]
    compared += [(SYSTEMS, *cells) for cells in _between(outcomes)]
    if not compared:
        return []
    errors = mean_errors(outcomes.action_l1)
    sides = [[errors[outcomes.cell(*cell)] for cell in cells] for _, *cells in compared]
    changes = np.stack([(after - before).round(12) for before, after in sides], axis=1)
    tests = sign_flips(changes, outcomes.simulator, draws)
    contrasts = []
    for (table, against, cell), (before, after), test in zip(compared, sides, tests, strict=True):
        pairs = pair_errors(before, after, test)
        complete = all(bool(outcomes.complete[outcomes.cell(*one)]) for one in (against, cell))
        if pairs.n:
            contrasts.append(
                Contrast(outcomes.simulator, *cell, against, table, pairs, complete=complete)
            )
    return contrasts


def _of(outcomes: Outcomes, system: str) -> Iterator[tuple[_Cell, _Cell]]:
    """Yield no-history, k0 and the other kind that each condition of a system is compared with."""
    conditions = outcomes.ran(system)
    floor = (system, NO_HISTORY) if NO_HISTORY in conditions else None
    pairs = [
        ((system, reference), (system, condition))
        for reference in (NO_HISTORY, START)
        for condition in conditions
        if reference in conditions and condition not in (NO_HISTORY, reference)
    ]
    pairs += [(other, (system, name)) for name, other in comparable(system, conditions, floor)]
    yield from dict.fromkeys(pairs)


def _between(outcomes: Outcomes) -> Iterator[tuple[_Cell, _Cell]]:
    """Yield each pair of systems under each condition, the second one after the first.

    A system that ran without history only, such as a baseline, is compared with the others under
    all of their conditions.
    """
    # Baselines are what other systems are compared with.
    ordered = sorted(outcomes.systems, key=lambda name: outcomes.ran(name) != [NO_HISTORY])
    for first, second in combinations(ordered, 2):
        if not outcomes.pairable(first, second):
            continue
        for condition in outcomes.conditions:
            against, cell = (_cell(outcomes, name, condition) for name in (first, second))
            # Two baselines are compared once, not under each condition of the others.
            if against and cell and condition in (against[1], cell[1]):
                yield against, cell


def _cell(outcomes: Outcomes, system: str, condition: str) -> _Cell | None:
    """Return the cell of a system that is compared under a condition, or None."""
    ran = outcomes.ran(system)
    if condition in ran:
        return system, condition
    return (system, NO_HISTORY) if ran == [NO_HISTORY] else None
