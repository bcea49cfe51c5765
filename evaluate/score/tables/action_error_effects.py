"""Paired comparisons of action errors along recordings: between conditions, and systems."""

from collections.abc import Iterable, Iterator
from itertools import combinations

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Outcomes, mean_errors
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.stats.bootstrap import DRAWS
from robomme_interference_data.stats.signs import sign_flips
from robomme_interference_data.viz.tables import Table

from .comparison import (
    ACTION_ERRORS,
    ACTION_ERRORS_NOTE,
    COMPLETE,
    SIDES,
    ComparisonTable,
    comparison_table,
)
from .contrast import LESSON_ONLY, Contrast, Effect, Measure, comparable
from .pairs import pair_errors

_SystemCondition = tuple[str, str]


def _between_systems(contrast: Contrast) -> bool:
    return contrast.effect is Effect.SYSTEMS


ACTION_ERROR_EFFECTS = ComparisonTable(
    name="action_error_effects",
    title="Differences of the action error",
    columns=SIDES | {"effect": "text"} | ACTION_ERRORS | COMPLETE,
    corrected="the tests between systems, and among those between conditions of a system",
    note=(
        "difference: action error of the system and condition minus that of those against, over "
        "the n episodes that count on both; negative is better. effect: history, sessions and "
        "interference as in the table effects; systems, all pairs of systems under each condition, "
        "where a system that ran without history only, such as a baseline, is compared under all "
        f"conditions of the others. {ACTION_ERRORS_NOTE}"
    ),
    explain=False,
)


def error_effects_table(contrasts: Iterable[Contrast]) -> Table:
    """Return the comparisons of action errors among some, those between systems last."""
    errors = [contrast for contrast in contrasts if contrast.measure is Measure.ACTION_ERROR]
    return comparison_table(ACTION_ERROR_EFFECTS, sorted(errors, key=_between_systems))


def error_contrasts(outcomes: Outcomes, draws: int = DRAWS) -> list[Contrast]:
    """Compare the conditions of each system, and all pairs of systems under each condition."""
    compared = list[tuple[Effect, _SystemCondition, _SystemCondition]]()
    for system in outcomes.systems:
        compared += _of(outcomes, system)
    compared += [(Effect.SYSTEMS, against, cell) for against, cell in _between(outcomes)]
    if not compared:
        return []
    errors = mean_errors(outcomes.action_l1)
    sides = [
        (errors[outcomes.cell(*against)], errors[outcomes.cell(*cell)])
        for _, against, cell in compared
    ]
    changes = np.stack([(after - before).round(12) for before, after in sides], axis=1)
    tests = sign_flips(changes, outcomes.simulator, draws)
    contrasts = []
    for (effect, against, cell), (before, after), test in zip(compared, sides, tests, strict=True):
        pairs = pair_errors(before, after, test)
        if pairs.n:
            contrasts.append(
                Contrast(
                    outcomes.simulator,
                    *cell,
                    against,
                    effect,
                    pairs,
                    complete=_complete(outcomes, against) and _complete(outcomes, cell),
                    measure=Measure.ACTION_ERROR,
                    group=("action error", effect is Effect.SYSTEMS),
                )
            )
    return contrasts


def _complete(outcomes: Outcomes, cell: _SystemCondition) -> bool:
    return bool(outcomes.complete[outcomes.cell(*cell)])


def _of(
    outcomes: Outcomes, system: str
) -> Iterator[tuple[Effect, _SystemCondition, _SystemCondition]]:
    """Yield no-history, k0 and the other kind that each condition of a system is compared with."""
    conditions = outcomes.ran(system)
    floor = (system, NO_HISTORY) if NO_HISTORY in conditions else None
    effects = dict[tuple[_SystemCondition, _SystemCondition], Effect]()
    for reference, effect in ((NO_HISTORY, Effect.HISTORY), (LESSON_ONLY, Effect.SESSIONS)):
        for condition in conditions if reference in conditions else ():
            if condition not in (NO_HISTORY, reference):
                effects[(system, reference), (system, condition)] = effect
    for condition, against in comparable(system, conditions, floor):
        effects.setdefault((against, (system, condition)), Effect.INTERFERENCE)
    for (against, cell), effect in effects.items():
        yield effect, against, cell


def _between(outcomes: Outcomes) -> Iterator[tuple[_SystemCondition, _SystemCondition]]:
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


def _cell(outcomes: Outcomes, system: str, condition: str) -> _SystemCondition | None:
    """Return the cell of a system that is compared under a condition, or None."""
    ran = outcomes.ran(system)
    if condition in ran:
        return system, condition
    return (system, NO_HISTORY) if ran == [NO_HISTORY] else None
