"""The table `parts`: rates by family and by difficulty, and the primary fall in each family."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from robomme_interference_data.constants import DIFFICULTIES
from robomme_interference_data.evaluate.score.outcomes import Outcomes
from robomme_interference_data.viz.tables import Columns, Table

from .cells import (
    BEST,
    CELL,
    COUNTS,
    EPISODES,
    NOTE,
    RATE,
    SuccessCell,
    episodes_record,
    rate_record,
)
from .comparison import record_table
from .contrast import Contrast
from .correction import primary_falls
from .pairs import compare_cells

_NOTE = (
    "Rows of families list episodes, by split and index. An episode counts if one of its rollouts "
    "is not an error. With "
    "repeats, one that does not count with every model seed of the condition is missing."
)
_FALLS_NOTE = (
    "fall: in a family, the condition of the system's primary fall minus k0, over the fall n "
    "episodes that count under both. fall low to fall high: its 95% confidence interval, by "
    "itself. fall without: the mean fall of all other families, which shows how much the fall "
    "depends on this one; the lowest and the highest are without low and without high of the table "
    "families. No family is tested."
)

_FALL: Columns = {
    "fall_n": "count",
    "fall": "points",
    "fall_low": "points",
    "fall_high": "points",
    "fall_without": "points",
}
"""The primary fall in one family; empty under other conditions, and over a single family."""

_NO_FALL: dict[str, Any] = {
    "fall_n": None,
    "fall": math.nan,
    "fall_low": math.nan,
    "fall_high": math.nan,
    "fall_without": math.nan,
}

_COLUMNS: Columns = CELL | {"by": "text", "part": "text"} | RATE | COUNTS | _FALL | EPISODES


def parts_table(
    cells: Sequence[SuccessCell], all_outcomes: Iterable[Outcomes], contrasts: Sequence[Contrast]
) -> Table:
    """Return a row for each cell over a family, and over a difficulty; families come first."""
    fall_of = {
        (fall.simulator, fall.system, fall.condition, family): record
        for outcomes in all_outcomes
        for fall in primary_falls(contrasts, outcomes.simulator)
        for family, record in _in_families(outcomes, fall)
    }
    families, difficulties = list[dict[str, Any]](), list[dict[str, Any]]()
    for cell in cells:
        if cell.part in DIFFICULTIES:
            record = rate_record(cell) | _NO_FALL | episodes_record(cell, listed=False)
            difficulties.append(record | {"by": "difficulty"})
        elif cell.part:
            fall = fall_of.get((cell.simulator, cell.system, cell.condition, cell.part), _NO_FALL)
            record = rate_record(cell) | fall | episodes_record(cell, listed=True)
            families.append(record | {"by": "family"})
    notes = [NOTE, BEST, _NOTE]
    if fall_of:
        notes.append(_FALLS_NOTE)
    title = "Success by family and by difficulty"
    return record_table("parts", title, _COLUMNS, families + difficulties, " ".join(notes))


def _in_families(outcomes: Outcomes, fall: Contrast) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each family with its values of `_FALL`; none for a fall over a single family."""
    first, second = (
        outcomes.status[outcomes.cell(*cell)]
        for cell in (fall.against, (fall.system, fall.condition))
    )
    own = {}
    for family in outcomes.families:
        here = outcomes.of_family(family)
        pairs = compare_cells(first[here], second[here], outcomes.training, same_weights=True)
        if pairs.n:
            own[family] = pairs
    if len(own) < 2:
        return
    changes = np.array([pairs.change.value for pairs in own.values()])
    others = (changes.sum() - changes) / (len(own) - 1)
    for (family, pairs), without in zip(own.items(), others.tolist(), strict=True):
        yield (
            family,
            {
                "fall_n": pairs.n,
                "fall": pairs.change.value,
                "fall_low": pairs.change.low,
                "fall_high": pairs.change.high,
                "fall_without": without,
            },
        )
