"""Answers to questions compared with guessing."""

import math
from collections.abc import Iterable, Mapping

from robomme_interference_data.evaluate.score.outcomes import Outcomes
from robomme_interference_data.stats.intervals import above_chance
from robomme_interference_data.stats.significance import ALPHA, poisson_binomial
from robomme_interference_data.viz.tables import Columns, Table

from .cells import SuccessCell
from .comparison import tested_table

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
    "With repeats, a question counts as one guess: right answers are the sum of the episodes' "
    "means, rounded down."
)


_COLUMNS: Columns = {
    "simulator": "text",
    "system": "text",
    "condition": "text",
    "n": "count",
    "rate": "rate",
    "chance": "rate",
    "above": "ratio",
    "low": "ratio",
    "high": "ratio",
    "p": "p",
    "p_holm": "p",
    "complete": "flag",
}


def chance_table(outcomes: Mapping[str, Outcomes], cells: Iterable[SuccessCell]) -> Table:
    """Return how far above chance each cell is whose episodes are all questions."""
    asked = [cell for cell in cells if not cell.part and not math.isnan(cell.chance)]
    records = []
    for cell in asked:
        low, high = cell.interval
        records.append(
            {
                "simulator": cell.simulator,
                "system": cell.system,
                "condition": cell.condition,
                "n": cell.n,
                "rate": cell.rate,
                "chance": cell.chance,
                "above": above_chance(cell.rate, cell.chance),
                "low": above_chance(low, cell.chance),
                "high": above_chance(high, cell.chance),
                "p": _p(outcomes[cell.simulator], cell),
                "complete": cell.complete,
            }
        )
    repeated = any(sum(cell.counts) - cell.errors > cell.n for cell in asked)
    note = f"{_NOTE} {_REPEATS}" if repeated else _NOTE
    return tested_table("chance", "Against chance", _COLUMNS, records, note)


def _p(outcomes: Outcomes, cell: SuccessCell) -> float:
    counted = outcomes.counted[outcomes.cell(cell.system, cell.condition)]
    right = math.floor(round(cell.rate * cell.n, 9))
    return poisson_binomial(right, outcomes.chance[counted].tolist())
