"""Is a difference shown to be small: two one-sided tests, with a margin that the user states."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from robomme_interference_data.evaluate.score.tables.cells import Cell
from robomme_interference_data.evaluate.systems import base_of
from robomme_interference_data.viz.tables import Table

from .contrasts import START, Contrast
from .pairs import Pairs, apart

EQUIVALENT, BEYOND, OPEN = "equivalent", "beyond", "not shown"


def equivalence_table(
    contrasts: Iterable[Contrast], cells: Iterable[Cell], published: Sequence[Cell], margin: float
) -> Table:
    """Return which differences are shown to be within a margin.

    Each k is set against k0, and a system with retrieval against the one without, under the same
    condition and at k0; where that one's rows are not at hand, against its published k0.

    Args:
        contrasts: All comparisons; those of the tables `effects` and `equivalence` count.
        cells: Our cells.
        published: Published ones, if the score is set against them.
        margin: Points.
    """
    found = [one for one in contrasts if one.table in ("effects", "equivalence")]
    paired = {(one.simulator, one.system) for one in found if one.system != one.against[0]}
    tests: list[tuple[Any, ...]] = [
        (one.simulator, one.system, one.condition, *one.against, "rows", one.pairs, one.complete)
        for one in found
    ]
    tests += _with_published([c for c in cells if (c.simulator, c.system) not in paired], published)
    rows = [
        (
            *(*names, pairs.n, *pairs.within, margin / 100),
            verdict(pairs, margin) + "†" * (not complete),
            complete,
        )
        for *names, pairs, complete in tests
        if pairs.n
    ]
    return Table.make(
        "equivalence",
        f"Equivalence within ±{margin:g} points",
        "simulator system condition against_system against_condition against_rows n:count "
        "difference:points low_90:points high_90:points margin:points verdict complete:flag",
        rows,
        f"Two one-sided tests at 5%: {EQUIVALENT} if the 90% interval of the difference lies "
        "within the margin, which is to be stated before the rows are looked at; "
        f"{BEYOND} if it lies outside it; {OPEN} means neither. The intervals are of the kinds "
        "that the other tables have; against published rates nothing is paired. Not corrected for "
        "their number. "
        "†: provisional, as a cell is not complete.",
    )


def _with_published(cells: Iterable[Cell], published: Sequence[Cell]) -> Iterator[tuple[Any, ...]]:
    starts = {(one.simulator, one.system): one for one in published if one.condition == START}
    for cell in cells:
        start = starts.get((cell.simulator, base_of(cell.system) or ""))
        if start is not None and cell.n and not cell.part:
            pairs = apart([(one.rate, one.trials, one.n) for one in (start, cell)])
            names = (cell.simulator, cell.system, cell.condition, start.system, START)
            yield (*names, "published", pairs, cell.complete)


def verdict(pairs: Pairs, margin: float) -> str:
    """Return whether a difference is shown to be within ± a margin, in points, or beyond it."""
    low, high = (100 * bound for bound in pairs.within[1:])
    if -margin < low and high < margin:
        return EQUIVALENT
    return BEYOND if high < -margin or margin < low else OPEN
