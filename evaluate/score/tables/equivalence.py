"""Equivalence: whether a difference is within a margin, by two one-sided tests."""

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
    """Return which differences are within a margin, in points.

    Each k is compared with k0, and a system with retrieval with the one without, under the same
    condition and at k0; if that one has no rows, with its published k0.
    """
    found = [one for one in contrasts if one.table in ("effects", "equivalence")]
    paired = {(one.simulator, one.system) for one in found if one.system != one.against[0]}
    alone = [one for one in cells if (one.simulator, one.system) not in paired]
    compared = [(one, "rows") for one in found if one.pairs.n]
    compared += [(one, "published") for one in _with_published(alone, published)]
    rows = []
    for one, source in compared:
        outcome = verdict(one.pairs, margin) + "†" * (not one.complete)
        more = {"against_rows": source, "margin": margin / 100, "verdict": outcome}
        rows.append(replace(one, table="equivalence", more=more))
    spec = TableSpec(
        f"Equivalence within ±{margin:g} points",
        f"{CELLS} against_rows:text n difference low_90 high_90 margin:points verdict:text "
        "complete",
        f"Two one-sided tests at 5%: {EQUIVALENT} if the 90% interval of the difference is within "
        f"the margin, {BEYOND} if it is outside, {OPEN} otherwise. State the margin before you see "
        "the rows. The intervals are of the same methods as in the other tables, and unpaired for "
        "published rates. Not corrected for multiple tests. †: provisional, because a cell is "
        "incomplete.",
        power=False,
    )
    return comparison_table("equivalence", rows, spec)


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
    """Return whether a difference is within ± a margin, in points, or beyond it."""
    low, high = (100 * bound for bound in pairs.within[1:])
    if -margin < low and high < margin:
        return EQUIVALENT
    return BEYOND if high < -margin or margin < low else OPEN
