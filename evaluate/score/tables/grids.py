"""The tables that are shown first: a row for each system, a column for each condition."""

import math
from collections.abc import Sequence
from itertools import groupby

from robomme_interference_data.evaluate.score.outcomes import Outcomes
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.schema.conditions import in_order
from robomme_interference_data.viz.tables import Columns, Table, percent

from . import action_error
from .cells import SuccessCell, part_kind
from .main import BEST, NOTE

NOT_EXPECTED = "n/a"
"""A cell of a grid that nobody expects, unlike a missing one."""


def main_grids(cells: Sequence[SuccessCell]) -> list[Table]:
    """Return the paper's main table of each simulator: a row per system, a column per condition.

    The best of a condition (see `SuccessCell.best`) are bold, between `**`. If all rates have the
    same n, only the note states it.
    """
    whole = [cell for cell in cells if not cell.part]
    grids: list[Table] = []
    for simulator, group in groupby(whole, lambda cell: cell.simulator):
        own = list(group)
        conditions = [condition.name for condition in in_order({cell.condition for cell in own})]
        at = {(cell.system, cell.condition): cell for cell in own}
        counts = {cell.n for cell in own if cell.n}
        rows = []
        for system in dict.fromkeys(cell.system for cell in own):
            texts = [_success(at.get((system, c)), with_n=len(counts) > 1) for c in conditions]
            rows.append([display_name(system), *texts])
        notes = []
        if len(counts) == 1:
            notes.append(f"n = {counts.pop()} in each cell.")
        if not grids:  # once for all grids
            notes.append(NOTE)
            if any(cell.best for cell in whole):
                notes.append(BEST)
        if any(NOT_EXPECTED in row for row in rows):
            notes.append(
                f"{NOT_EXPECTED}: the condition does not apply to the system, or is not expected."
            )
        references = dict.fromkeys(display_name(cell.system) for cell in own if cell.reference)
        if references:
            notes.append(f"References, not ranked: {', '.join(references)}.")
        chances = [cell.chance for cell in own if not math.isnan(cell.chance)]
        if chances:
            levels = dict.fromkeys([percent(min(chances)), percent(max(chances))])
            notes.append(f"Guessing succeeds in {' to '.join(levels)}: see the table main.")
        errors = sum(cell.errors for cell in own)
        notes.append(f"Errors: {errors}." if errors else "No errors.")
        title = f"Success by system and condition, {simulator}"
        columns: Columns = dict.fromkeys(["system", *conditions], "text")
        grids.append(Table(simulator, title, columns, rows, " ".join(notes)))
    return grids


def _success(cell: SuccessCell | None, *, with_n: bool) -> str:
    if cell is None:
        return NOT_EXPECTED
    errors = f", errors: {cell.errors}" if cell.errors else ""
    if not cell.n:
        return f"no result†{errors}" if any(cell.counts) else "missing†"
    low, high = cell.interval
    rate = f"**{percent(cell.rate)}**" if cell.best else percent(cell.rate)
    n = f" n={cell.n}" if with_n else ""
    return f"{rate}{cell.mark} [{100 * low:.1f}, {100 * high:.1f}]{n}{errors}"


def part_grid(cells: Sequence[SuccessCell], by: str) -> Table:
    """Return rates of one simulator: a row per system and part, a `family` or an `ability`."""
    own = [cell for cell in cells if part_kind(cell.part) == by]
    conditions = [
        condition.name for condition in in_order({cell.condition for cell in own if cell.n})
    ]
    at = {(cell.system, cell.part, cell.condition): cell for cell in own}
    rows = []
    for system, part in dict.fromkeys((cell.system, cell.part) for cell in own):
        row_cells = [at.get((system, part, condition)) for condition in conditions]
        rows.append([display_name(system), part, *map(_of_part, row_cells)])
    return Table(
        "parts",
        f"Success by {by} and condition",
        dict.fromkeys(["system", by, *conditions], "text"),
        rows,
        "Intervals and complete counts are in the table parts. †: the cell is not complete.",
    )


def _of_part(cell: SuccessCell | None) -> str:
    """Return the rate of a part without its interval, n and errors."""
    if cell is None:
        return NOT_EXPECTED
    errors = f", errors: {cell.errors}" if cell.errors else ""
    if not cell.n:
        return f"no result†{errors}" if any(cell.counts) else "missing†"
    return f"{percent(cell.rate)}{cell.mark} n={cell.n}{errors}"


def error_grid(outcomes: Outcomes, cells: Sequence[action_error.ErrorCell]) -> Table:
    """Return a row for each system and a column for each condition."""
    at = {(cell.system, cell.condition): cell for cell in cells if not cell.part}
    rows = []
    for system in outcomes.systems:
        texts = [_error(at.get((system, condition))) for condition in outcomes.conditions]
        rows.append([display_name(system), *texts])
    return Table(
        outcomes.simulator,
        f"Action error by system and condition, {outcomes.simulator}",
        dict.fromkeys(["system", *outcomes.conditions], "text"),
        rows,
        f"{action_error.NOTE} {NOT_EXPECTED}: no rows.",
    )


def _error(cell: action_error.ErrorCell | None) -> str:
    if cell is None:
        return NOT_EXPECTED
    errors = f", errors: {cell.errors}" if cell.errors else ""
    if not cell.n:
        return f"no result†{errors}"
    mean, low, high = cell.error
    bounds = "" if math.isnan(low) else f" [{low:.4f}, {high:.4f}]"
    return f"{mean:.4f}{cell.mark}{bounds} n={cell.n}{errors}"
