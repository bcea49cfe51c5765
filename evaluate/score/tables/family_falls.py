"""The fall of a system in each family, and over all other families."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Outcomes
from robomme_interference_data.viz.tables import Table

from .comparison import COMPLETE, SIDES, ComparisonTable, comparison_table
from .contrast import Contrast, Effect
from .pairs import compare_cells

FAMILY_FALLS = ComparisonTable(
    name="family_falls",
    title="Falls by family",
    columns=SIDES
    | {
        "family": "text",
        "n": "count",
        "rate": "rate",
        "against_rate": "rate",
        "difference": "points",
        "low": "points",
        "high": "points",
        "without": "points",
    }
    | COMPLETE,
    note=(
        "Over the n episodes of a family that count on both sides. low to high: 95% confidence "
        "interval, by itself. without: the mean difference of all other families, which shows how "
        "much the fall depends on this one; the lowest and the highest are without low and without "
        "high of the table families. No family is tested."
    ),
    explain=False,
)


def family_falls_table(all_outcomes: Iterable[Outcomes], contrasts: Iterable[Contrast]) -> Table:
    """Return the primary falls in each family; a fall over a single family has no rows."""
    falls = [c for c in contrasts if c.primary and c.effect is Effect.SESSIONS]
    rows = [
        row
        for outcomes in all_outcomes
        for fall in falls
        if fall.simulator == outcomes.simulator
        for row in _in_families(outcomes, fall)
    ]
    return comparison_table(FAMILY_FALLS, rows)


def _in_families(outcomes: Outcomes, fall: Contrast) -> Iterator[Contrast]:
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
        yield replace(fall, family=family, pairs=pairs, columns={"without": without})
