"""Equivalence: whether a difference is within a margin, by two one-sided tests."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from robomme_interference_data.evaluate.systems import published_base
from robomme_interference_data.viz.tables import Columns, Table

from .cells import SuccessCell
from .comparison import SIDES, ComparisonTable, comparison_table
from .contrast import LESSON_ONLY, Contrast, Effect
from .correction import correct
from .pairs import Pairs, compare_unpaired

EQUIVALENT, BEYOND, OPEN = "equivalent", "beyond", "not shown"


_COLUMNS: Columns = SIDES | {
    "against_rows": "text",
    "n": "count",
    "runs": "count",
    "scope": "text",
    "difference": "points",
    "low_90": "points",
    "high_90": "points",
    "margin": "points",
    "verdict": "text",
    "p": "p",
    "p_holm": "p",
    "complete": "flag",
}


def equivalence_table(
    contrasts: Iterable[Contrast],
    cells: Iterable[SuccessCell],
    published: Sequence[SuccessCell],
    margin: float,
) -> Table:
    """Return which differences are within a margin, in points.

    Each k is compared with k0, and a system with retrieval with the one without, under the same
    condition and at k0; if that one has no rows, with its published k0.
    """
    own = [
        contrast
        for contrast in contrasts
        if contrast.effect in (Effect.SESSIONS, Effect.RETRIEVAL, Effect.RETRIEVAL_FALL)
    ]
    with_base = {(c.simulator, c.system) for c in own if c.system != c.against[0]}
    without_base = [cell for cell in cells if (cell.simulator, cell.system) not in with_base]
    rows = [_compared(contrast, "rows", margin) for contrast in own if contrast.pairs.n]
    for contrast in _with_published(without_base, published):
        rows.append(_compared(contrast, "published", margin))
    spec = ComparisonTable(
        name="equivalence",
        title=f"Equivalence within ±{margin:g} points",
        columns=_COLUMNS,
        note=f"Two one-sided tests at 5%: {EQUIVALENT} if the 90% interval of the difference is "
        f"within the margin, {BEYOND} if it is outside, {OPEN} otherwise. p: of a difference as "
        "large as the margin, the larger of both tests: below 0.05 where the verdict is "
        "equivalent; the verdict is not corrected for many tests. State the margin before you see "
        "the rows. The intervals are of the same methods as in the other tables, and unpaired for "
        "published rates. †: provisional, because a cell is incomplete.",
        explain=False,
    )
    return comparison_table(spec, correct(rows))


def _compared(contrast: Contrast, source: str, margin: float) -> Contrast:
    """Return a comparison with the test of the margin; `source` is that of the second side."""
    outcome = verdict(contrast.pairs, margin)
    columns = {
        "against_rows": source,
        "margin": margin / 100,
        "verdict": outcome if contrast.complete else f"{outcome}†",
    }
    pairs = replace(contrast.pairs, p=tost(contrast.pairs, margin))
    return replace(contrast, pairs=pairs, columns=columns, group="equivalence")


def _with_published(
    cells: Iterable[SuccessCell], published: Sequence[SuccessCell]
) -> Iterator[Contrast]:
    """Yield each cell compared with the published k0 of the same system without retrieval."""
    published_at = {
        (cell.simulator, cell.system): cell for cell in published if cell.condition == LESSON_ONLY
    }
    for cell in cells:
        start = published_at.get((cell.simulator, published_base(cell.system) or ""))
        if start is not None and cell.n and not cell.part:
            yield Contrast(
                cell.simulator,
                cell.system,
                cell.condition,
                (start.system, LESSON_ONLY),
                Effect.RETRIEVAL_FALL,
                compare_unpaired(start.as_rate, cell.as_rate),
                cell.complete,
            )


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
