"""Action errors of offline runs: their means, over all episodes and by family."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Flags, Outcomes, mean_errors
from robomme_interference_data.stats.bootstrap import (
    MIN_EPISODES,
    Interval,
    bootstrap,
    known_interval,
)
from robomme_interference_data.viz.tables import Columns, Table

from .cells import EPISODES, Coverage, coverage_of, episodes_record
from .comparison import record_table

NOTE = (
    "Mean absolute difference of actions to the recorded ones over the n episodes that count, in "
    f"the actions' units, with 95% BCa bootstrap intervals if at least {MIN_EPISODES} episodes "
    "differ; repeats of an episode count with their mean. An error does not count. †: an "
    "episode that another system or condition has does not count, so the means are of different "
    "episodes: compare them in the paired tables."
)


@dataclass(frozen=True)
class ErrorCell(Coverage):
    """The action error of one system under one condition, over all episodes or in a family."""

    error: Interval  # mean over the episodes that count, NaN if n is 0


def error_cells(outcomes: Outcomes, draws: int) -> list[ErrorCell]:
    """Return the cells of every system and condition, each followed by its families."""
    errors = mean_errors(outcomes.action_l1)
    everywhere: Flags = np.ones(len(outcomes.episodes), bool)
    parts = {"": everywhere}
    parts |= {family: outcomes.of_family(family) for family in outcomes.families}
    places = np.argwhere(outcomes.in_tables).tolist()
    intervals = {
        part: bootstrap(
            np.stack([errors[s, c, here] for s, c in places], axis=1), outcomes.simulator, draws
        )
        for part, here in parts.items()
    }
    cells = []
    for number, (s, c) in enumerate(places):
        for part, here in parts.items():
            known = errors[s, c, here]
            known = known[~np.isnan(known)]
            cells.append(
                ErrorCell(
                    outcomes.simulator,
                    outcomes.systems[s],
                    outcomes.conditions[c],
                    part,
                    len(known),
                    known_interval(intervals[part][number], known),
                    **coverage_of(outcomes, s, c, here, here),
                )
            )
    return cells


_COLUMNS: Columns = {
    "system": "text",
    "condition": "text",
    "family": "text",
    "n": "count",
    "action_l1": "number",
    "low": "number",
    "high": "number",
    "errors": "count",
    "missing": "count",
    "complete": "flag",
}
_COLUMNS |= EPISODES


def error_table(cells: Sequence[ErrorCell]) -> Table:
    """Return a row for each cell."""
    records = []
    for cell in cells:
        record = {
            "system": cell.system,
            "condition": cell.condition,
            "family": cell.part or "all",
            "n": cell.n,
            "action_l1": cell.error.value,
            "low": cell.error.low,
            "high": cell.error.high,
            "errors": cell.errors,
            "missing": len(cell.missing),
            "complete": cell.complete,
        }
        records.append(record | episodes_record(cell, listed=bool(cell.part)))
    return record_table("action_error", "Action error offline", _COLUMNS, records, NOTE)
