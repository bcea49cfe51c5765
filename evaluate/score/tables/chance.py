"""Answers to questions compared with guessing."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

from robomme_interference_data.evaluate.score.outcomes import Outcomes
from robomme_interference_data.stats.intervals import above_chance
from robomme_interference_data.stats.significance import ALPHA, poisson_binomial
from robomme_interference_data.viz.tables import Columns, Table

from .cells import SuccessCell
from .correction import corrected

_NOTE = (
    "For cells whose episodes are all questions with a known chance (1 / options), chance: the "
    "mean over the n episodes; above: (rate − chance) / (1 − chance), which is 1 if all answers "
    "are right and 0 for guessing; above low and above high: the same for the rate's 95% Wilson "
    "interval; p chance: exact one-sided probability of at least as many right answers by guessing "
    "(Poisson-binomial); p chance holm: after Holm's correction among these tests in one "
    "simulator. An answer that names no option is wrong, so frequent refusals fall below chance. "
    "Systems that see nothing of the past (the controls blank and text, and any under no-history) "
    f"must be at chance: p chance holm below {ALPHA} there means that questions can be answered "
    "without memory; a larger one does not prove the opposite."
)
_REPEATS = (
    "With repeats, a question counts as one guess: right answers are the sum of the episodes' "
    "means, rounded down."
)


_COLUMNS: Columns = {
    "chance": "rate",
    "above": "ratio",
    "above_low": "ratio",
    "above_high": "ratio",
    "p_chance": "p",
    "p_chance_holm": "p",
}


def with_chance(
    main: Table, outcomes: Mapping[str, Outcomes], cells: Iterable[SuccessCell]
) -> Table:
    """Return the table `main` with how far above chance each cell is.

    The columns are empty for cells that have other episodes than questions.
    """
    shown = [cell for cell in cells if not cell.part]
    asked = [cell for cell in shown if not math.isnan(cell.chance)]
    ps = [_p(outcomes[cell.simulator], cell) for cell in asked]
    holms = corrected(ps, [cell.simulator for cell in asked])
    values_of = {}
    for cell, p, p_holm in zip(asked, ps, holms, strict=True):
        above = [above_chance(rate, cell.chance) for rate in (cell.rate, *cell.interval)]
        values_of[cell.simulator, cell.system, cell.condition] = (cell.chance, *above, p, p_holm)
    none = (math.nan,) * len(_COLUMNS)
    rows = [
        (*row, *values_of.get((cell.simulator, cell.system, cell.condition), none))
        for row, cell in zip(main.rows, shown, strict=True)
    ]
    repeated = any(sum(cell.counts) - cell.errors > cell.n for cell in asked)
    notes = [main.note, _NOTE]
    if repeated:
        notes.append(_REPEATS)
    columns = {**main.columns, **_COLUMNS}
    return replace(main, columns=columns, rows=rows, note=" ".join(notes))


def _p(outcomes: Outcomes, cell: SuccessCell) -> float:
    counted = outcomes.counted[outcomes.cell(cell.system, cell.condition)]
    right = math.floor(round(cell.rate * cell.n, 9))
    return poisson_binomial(right, outcomes.chance[counted].tolist())
