"""What a rollout costs beside how often it succeeds."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from statistics import fmean

from robomme_interference_data.evaluate.score.rows.reading import CheckedRows
from robomme_interference_data.evaluate.score.rows.values import Row
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.viz.tables import Columns, Table

from .cells import SuccessCell
from .comparison import record_table

_NOTE = (
    "Means over the rollouts that count and have times. history s: to decode the history, to "
    "retrieve from it and to deliver it; policy s: in the policy while the robot acts; model s: in "
    "the vision-language model. seconds: their sum, without the simulator; seconds per success: "
    "seconds / rate of the same rollouts. model tokens: of prompts and answers, where they are "
    "reported. Empty: not recorded. A rollout that fails often takes more steps, and "
    "so more policy s; times depend on the machine and its load."
)

_COLUMNS: Columns = {
    "simulator": "text",
    "system": "text",
    "condition": "text",
    "n": "count",
    "rate": "rate",
    "low": "rate",
    "high": "rate",
    "rollouts": "count",
    "history_s": "ratio",
    "policy_s": "ratio",
    "model_s": "ratio",
    "seconds": "ratio",
    "seconds_per_success": "ratio",
    "model_tokens": "count",
    "complete": "flag",
}

_PARTS = ("history_s", "policy_s", "model_s")
"""The seconds of a rollout that depend on the system; no two overlap."""


def cost_table(rows: CheckedRows, cells: Iterable[SuccessCell]) -> Table:
    """Return a row for each cell over all episodes that has rows with times."""
    timed = defaultdict[tuple[str, str, str], list[Row]](list)
    for row in rows:
        if row.status != Status.ERROR and any(getattr(row, name) is not None for name in _PARTS):
            timed[row.simulator, row.system, row.condition].append(row)
    records = []
    for cell in cells:
        key = (cell.simulator, cell.system, cell.condition)
        if not cell.part and key in timed:
            low, high = cell.interval
            records.append(
                {
                    "simulator": cell.simulator,
                    "system": cell.system,
                    "condition": cell.condition,
                    "n": cell.n,
                    "rate": cell.rate,
                    "low": low,
                    "high": high,
                    **_costs(timed[key]),
                    "complete": cell.complete,
                }
            )
    return record_table("cost", "Cost of a rollout beside success", _COLUMNS, records, _NOTE)


def _costs(rows: Sequence[Row]) -> dict[str, float | int | None]:
    """Return the columns of mean costs."""
    seconds = fmean(sum(getattr(row, name) or 0.0 for name in _PARTS) for row in rows)
    successes = sum(row.status == Status.SUCCESS for row in rows)
    tokens = _mean(row.model_tokens for row in rows)
    return {
        "rollouts": len(rows),
        "history_s": _mean(row.history_s for row in rows),
        "policy_s": _mean(row.policy_s for row in rows),
        "model_s": _mean(row.model_s for row in rows),
        "seconds": seconds,
        "seconds_per_success": seconds * len(rows) / successes if successes else None,
        "model_tokens": None if tokens is None else round(tokens),
    }


def _mean(values: Iterable[float | None]) -> float | None:
    """Return the mean of the known values; None if there are none."""
    known = [value for value in values if value is not None]
    return fmean(known) if known else None
