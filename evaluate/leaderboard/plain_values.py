"""Numbers of a board as plain values, for JSON; NaN is None."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

from robomme_interference_data.evaluate.score.outcomes import STATUSES
from robomme_interference_data.evaluate.score.tables.cells import SuccessCell
from robomme_interference_data.stats.bootstrap import Interval

from .published import Case


def letter(counts: Sequence[int]) -> str:
    """Return the outcome of an episode's rollouts in a letter, given their number by status.

    `s` all succeed, `f` none, `t` none and all time out, `e` all broke, `1` to `9` the tenths that
    succeed, `-` there are none.
    """
    count = dict(zip(map(str, STATUSES), counts, strict=True))
    counted = count["success"] + count["fail"] + count["timeout"]
    if not counted:
        return "e" if count["error"] else "-"
    if count["success"] in (0, counted):
        failed = "t" if count["timeout"] == counted else "f"
        return "s" if count["success"] else failed
    return str(min(max(round(10 * count["success"] / counted), 1), 9))


def stated(case: Case | None) -> dict[str, Any]:
    """Return what a submission states, and where its results are."""
    if case is None:
        return {"remembers": None, "parameters": None, "runs": []}
    return {
        "remembers": case.submission.memory,
        "parameters": case.submission.parameters,
        "runs": [
            {
                "results": each.run.results,
                "checkpoint": each.run.checkpoint,
                "checkpoint_sha256": each.run.checkpoint_sha256,
                "probe": each.header.probed,
                "links": dict(each.links),
            }
            for each in case.results
        ],
    }


def rate_of_cell(cell: SuccessCell) -> dict[str, Any]:
    """Return the rate of a cell with its 95% interval."""
    low, high = cell.interval
    return {
        "n": cell.n,
        "rate": cell.rate,
        "low": low,
        "high": high,
        "training_runs": cell.runs,
        "complete": cell.complete,
    }


def interval_values(interval: Interval) -> dict[str, Any]:
    """Return a difference with its interval."""
    value, low, high = map(known, interval)
    return {"value": value, "low": low, "high": high}


def known(value: float | None) -> float | None:
    """Return a number; None for NaN."""
    return None if value is None or math.isnan(value) else value


def mean(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are known; None if none is."""
    numbers = [value for value in values if value is not None]
    return sum(numbers) / len(numbers) if numbers else None
