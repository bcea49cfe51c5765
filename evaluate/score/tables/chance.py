"""Answers to questions against guessing: how much of a rate is above chance, and how surely."""

import math
from collections.abc import Iterable, Mapping

from robomme_interference_data.evaluate.score.comparisons.tables import corrected, provisional
from robomme_interference_data.evaluate.score.outcomes import Outcomes
from robomme_interference_data.stats.intervals import above_chance
from robomme_interference_data.stats.significance import ALPHA, poisson_binomial
from robomme_interference_data.viz.tables import Table

from .cells import Cell

_NOTE = (
    "Where every episode is a question with a known chance, 1 / its options. chance: its mean over "
    "the n episodes; above: (rate − chance) / (1 − chance), 1 where all is right, 0 as guessing, "
    "with the ends of the rate's 95% Wilson interval set against the same mean. p: the exact "
    "chance of as many right answers or more, were each question guessed by itself "
    "(Poisson-binomial, one-sided); p_holm: p corrected by Holm's method among the tests of this "
    "table in one simulator. An answer that names no option is wrong: who often names none lies "
    "below chance. Who sees nothing of the past has to be at chance, such as the controls blank "
    f"and text, and anyone under no-history: p_holm below {ALPHA} there is a leak, by which "
    "questions are answered without memory; a larger one does not prove that there is none."
)
_REPEATS = (
    " With repeats a question is one guess, however often it was asked: right answers are the sum "
    "of the episodes' means, rounded down."
)
_EARLY = " p†: provisional, as a cell is not complete."


def chance_table(outcomes: Mapping[str, Outcomes], cells: Iterable[Cell]) -> Table:
    """Return how far each cell is above chance, of those whose episodes are all questions."""
    found = [one for one in cells if not (one.part or math.isnan(one.chance))]
    ps = [_p(outcomes[one.simulator], one) for one in found]
    tests = zip(found, ps, corrected(ps, [one.simulator for one in found]), strict=True)
    rows = [
        (
            *(cell.simulator, cell.system, cell.condition, cell.n, cell.rate, cell.chance),
            *(above_chance(one, cell.chance) for one in (cell.rate, *cell.interval)),
            *(provisional(one, cell.complete) for one in p),
            cell.complete,
        )
        for cell, *p in tests
    ]
    repeated = any(sum(cell.counts) - cell.errors > cell.n for cell in found)
    early = any(not cell.complete for cell in found)
    return Table.make(
        "chance",
        "Against chance",
        "simulator system condition n:count rate:rate chance:rate above:ratio low:ratio high:ratio "
        "p:p p_holm:p complete:flag",
        rows,
        _NOTE + _REPEATS * repeated + _EARLY * early,
    )


def _p(outcomes: Outcomes, cell: Cell) -> float:
    counted = outcomes.counted[outcomes.cell(cell.system, cell.condition)]
    right = math.floor(round(cell.rate * cell.n, 9))
    return poisson_binomial(right, outcomes.chance[counted].tolist())
