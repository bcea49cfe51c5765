"""Equivalence: whether a difference is within a margin, by two one-sided tests."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from robomme_interference_data.evaluate.score.comparisons.contrast import START, Contrast
from robomme_interference_data.evaluate.score.comparisons.pairs import Pairs, compare_unpaired
from robomme_interference_data.evaluate.score.comparisons.tables import (
    CELLS,
    TableSpec,
    comparison_table,
)
from robomme_interference_data.evaluate.systems import published_base
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
        pairs = replace(one.pairs, p=tost(one.pairs, margin))
        rows.append(replace(one, table="equivalence", pairs=pairs, more=more))
    spec = TableSpec(
        f"Equivalence within ±{margin:g} points",
        f"{CELLS} against_rows:text n difference low_90 high_90 margin:points verdict:text p "
        "p_holm:p complete",
        f"Two one-sided tests at 5%: {EQUIVALENT} if the 90% interval of the difference is within "
        f"the margin, {BEYOND} if it is outside, {OPEN} otherwise. p: of a difference as large as "
        "the margin, the larger of both tests: below 0.05 where the verdict is equivalent; p holm: "
        "after Holm's correction among the tests of this table in one simulator, which the verdict "
        "is not corrected for. State the margin before you see the rows. The intervals are of the "
        "same methods as in the other tables, and unpaired for published rates. †: provisional, "
        "because a cell is incomplete.",
        power=False,
    )
    return comparison_table("equivalence", rows, spec)


def _with_published(cells: Iterable[Cell], published: Sequence[Cell]) -> Iterator[Contrast]:
    starts = {(one.simulator, one.system): one for one in published if one.condition == START}
    for cell in cells:
        start = starts.get((cell.simulator, published_base(cell.system) or ""))
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


def tost(pairs: Pairs, margin: float) -> float:
    """Return the p-value of a difference of at least ± a margin, in points; NaN without pairs.

    It is the larger one of two one-sided tests, those that the intervals define: the α at which the
    bound of the interval of level 1 − 2α reaches the margin nearer to the difference. If the
    difference is beyond the margin, p is 1 − α.

    Source: Schuirmann (1987), J. Pharmacokinetics and Biopharmaceutics 15, 657–680.
    """
    value, limit = pairs.change.value, margin / 100
    if math.isnan(pairs.change.low):
        return math.nan
    inside = abs(value) < limit

    def reaches(alpha: float) -> bool:
        _, low, high = pairs.at(1 - 2 * alpha)
        far = max(-low, high) if inside else max(low, -high)
        return far >= limit if inside else far <= limit

    low, high = 0.0, 0.5
    while high - low > 1e-9:
        middle = (low + high) / 2
        low, high = (middle, high) if reaches(middle) else (low, middle)
    return high if inside else 1 - high
