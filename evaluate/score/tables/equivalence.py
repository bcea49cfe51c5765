"""Is a difference shown to be small: two one-sided tests, with a margin that the user states."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from robomme_interference_data.evaluate.score.comparisons.contrast import START, Contrast
from robomme_interference_data.evaluate.score.comparisons.pairs import Pairs, compare_unpaired
from robomme_interference_data.evaluate.score.comparisons.tables import (
    CELLS,
    TableSpec,
    comparison_table,
)
from robomme_interference_data.evaluate.systems import base_of
from robomme_interference_data.viz.tables import Table

from .cells import Cell

EQUIVALENT, BEYOND, OPEN = "equivalent", "beyond", "not shown"


def equivalence_table(
    contrasts: Iterable[Contrast], cells: Iterable[Cell], published: Sequence[Cell], margin: float
) -> Table:
    """Return which differences are shown to be within a margin.

    Each k is compared with k0, and a system with retrieval with the one without, under the same
    condition and at k0; where that one has no rows, with its published k0. The margin is in points.
    """
    found = [one for one in contrasts if one.table in ("effects", "equivalence")]
    paired = {(one.simulator, one.system) for one in found if one.system != one.against[0]}
    alone = [one for one in cells if (one.simulator, one.system) not in paired]
    shown = [(one, "rows") for one in found if one.pairs.n]
    shown += [(one, "published") for one in _with_published(alone, published)]
    more = [
        {
            "against_rows": rows,
            "margin": margin / 100,
            "verdict": verdict(one.pairs, margin) + "†" * (not one.complete),
        }
        for one, rows in shown
    ]
    spec = TableSpec(
        f"Equivalence within ±{margin:g} points",
        f"{CELLS} against_rows:text n difference low_90 high_90 margin:points verdict:text "
        "complete",
        f"Two one-sided tests at 5%: {EQUIVALENT} if the 90% interval of the difference lies "
        "within the margin, which is to be stated before the rows are looked at; "
        f"{BEYOND} if it lies outside it; {OPEN} means neither. The intervals are of the kinds "
        "that the other tables have; against published rates nothing is paired. Not corrected for "
        "their number. "
        "†: provisional, as a cell is not complete.",
        power=False,
    )
    named = [replace(one, table="equivalence") for one, _ in shown]
    return comparison_table("equivalence", named, spec, more)


def _with_published(cells: Iterable[Cell], published: Sequence[Cell]) -> Iterator[Contrast]:
    starts = {(one.simulator, one.system): one for one in published if one.condition == START}
    for cell in cells:
        start = starts.get((cell.simulator, base_of(cell.system) or ""))
        if start is not None and cell.n and not cell.part:
            pairs = compare_unpaired(start.as_rate, cell.as_rate)
            against = (start.system, START)
            names = (cell.simulator, cell.system, cell.condition, against)
            yield Contrast(*names, "equivalence", pairs, cell.complete)


def verdict(pairs: Pairs, margin: float) -> str:
    """Return whether a difference is shown to be within ± a margin, in points, or beyond it."""
    low, high = (100 * bound for bound in pairs.within[1:])
    if -margin < low and high < margin:
        return EQUIVALENT
    return BEYOND if high < -margin or margin < low else OPEN
