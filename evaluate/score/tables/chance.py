"""Answers to questions compared with guessing."""

import math
from collections.abc import Iterable, Mapping

from robomme_interference_data.evaluate.score.comparisons.tables import tested
from robomme_interference_data.evaluate.score.outcomes import Outcomes
from robomme_interference_data.stats.intervals import above_chance
from robomme_interference_data.stats.significance import ALPHA, poisson_binomial
from robomme_interference_data.viz.tables import Table

from .cells import Cell

_NOTE = (
    "For cells whose episodes are all questions with a known chance (1 / options). chance: the "
    "mean over the n episodes; above: (rate − chance) / (1 − chance), which is 1 if all answers "
    "are right and 0 for guessing; low and high: the same for the rate's 95% Wilson interval. p: "
    "exact one-sided probability of at least as many right answers by guessing "
    "(Poisson-binomial); p holm: after Holm's correction among the tests of this table in one "
    "simulator. An answer that names no option is wrong, so frequent refusals fall below chance. "
    "Systems that see nothing of the past (the controls blank and text, and any under no-history) "
    f"must be at chance: p holm below {ALPHA} there means that questions can be answered without "
    "memory; a larger one does not prove the opposite."
)
_REPEATS = (
    " With repeats, a question counts as one guess: right answers are the sum of the episodes' "
    "means, rounded down."
)


def chance_table(outcomes: Mapping[str, Outcomes], cells: Iterable[Cell]) -> Table:
    """Return how far above chance each cell is whose episodes are all questions."""
    found = [one for one in cells if not (one.part or math.isnan(one.chance))]
    rows = [
        (
            *(cell.simulator, cell.system, cell.condition, cell.n, cell.rate, cell.chance),
            *(above_chance(one, cell.chance) for one in (cell.rate, *cell.interval)),
            *(_p(outcomes[cell.simulator], cell), cell.complete),
        )
        for cell in found
    ]
    repeated = any(sum(cell.counts) - cell.errors > cell.n for cell in found)
    return tested(
        "chance",
        "Against chance",
        "simulator system condition n:count rate:rate chance:rate above:ratio low:ratio high:ratio "
        "p:p p_holm:p complete:flag",
        rows,
        _NOTE + _REPEATS * repeated,
    )


def _p(outcomes: Outcomes, cell: Cell) -> float:
    counted = outcomes.counted[outcomes.cell(cell.system, cell.condition)]
    right = math.floor(round(cell.rate * cell.n, 9))
    return poisson_binomial(right, outcomes.chance[counted].tolist())
