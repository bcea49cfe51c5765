"""The tables `main` and `parts`: rates, and the primary fall in each family."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Outcomes
from robomme_interference_data.stats.bootstrap import Interval
from robomme_interference_data.stats.runs import MIN_RUNS
from robomme_interference_data.viz.tables import Columns, Table

from .cells import EPISODES, SuccessCell, episodes_record, part_kind
from .comparison import record_table
from .contrast import Contrast
from .correction import primary_falls
from .pairs import compare_cells

NOTE = (
    "Rates with 95% Wilson intervals. scope: they hold for other training runs, if there are "
    f"{MIN_RUNS} runs or more, otherwise for this checkpoint alone. n: episodes that count; an "
    "error is neither success nor failure. †: the cell lacks episodes, or has episodes outside the "
    "grid, and is not ranked; a cell without any rollout is missing."
)
BEST = (
    "Best (bold, in text *): above zero, and no other system is significantly better, by p after "
    "Holm's correction over all pairs of systems."
)
_MAIN_NOTE = (
    "fixed low to fixed high: Wilson's interval for other episodes of the same families in the "
    "same numbers, narrower because the families' rates differ; none with training runs. if errors "
    "fail, if errors succeed: the rate if every error were a failure, or a success: the bounds if "
    "errors depend on the outcome. run spread: standard deviation of the rates of training runs. "
    "rank low to "
    "rank high: the ranks that the system can have, from the significant differences of the table "
    "matrix (p holm below 0.05): 1 + the systems that are better, to the number of systems less "
    "those that are worse; all of a condition hold at once with 95% confidence. difference: the "
    "rate minus that of the best system, the highest (the first of equal ones); its interval, "
    "difference low to difference high, and p holm are corrected over all pairs of systems, since "
    "the best is chosen by its rate."
)
_PARTS_NOTE = (
    "Rows of families list episodes, by split and index. An episode counts if one of its rollouts "
    "is not an error. With "
    "repeats, one that does not count with every model seed of the condition is missing."
)
_FALLS_NOTE = (
    "fall: in a family, the condition of the system's primary fall minus k0, over the fall n "
    "episodes that count under both. fall low to fall high: its 95% confidence interval, by "
    "itself. fall without: the mean fall of all other families, which shows how much the fall "
    "depends on this one; the lowest and the highest are without low and without high of the table "
    "families. No family is tested."
)

_CELL: Columns = {"simulator": "text", "system": "text", "condition": "text"}

_RATE: Columns = {
    "n": "count",
    "runs": "count",
    "scope": "text",
    "rate": "rate",
    "low": "rate",
    "high": "rate",
}

_COUNTS: Columns = {
    "successes": "count",
    "fails": "count",
    "timeouts": "count",
    "errors": "count",
    "complete": "flag",
    "missing": "count",
    "rank": "count",
    "best": "flag",
}

_MAIN: Columns = (
    _CELL
    | _RATE
    | {
        "run_spread": "points",
        "fixed_low": "rate",
        "fixed_high": "rate",
        "if_errors_fail": "rate",
        "if_errors_succeed": "rate",
    }
    | _COUNTS
    | {
        "rank_low": "count",
        "rank_high": "count",
        "best_system": "text",
        "difference": "points",
        "difference_low": "points",
        "difference_high": "points",
        "p_holm": "p",
    }
)

_FALL: Columns = {
    "fall_n": "count",
    "fall": "points",
    "fall_low": "points",
    "fall_high": "points",
    "fall_without": "points",
}
"""The primary fall in one family; empty under other conditions, and over a single family."""

_NO_FALL: dict[str, Any] = {
    "fall_n": None,
    "fall": math.nan,
    "fall_low": math.nan,
    "fall_high": math.nan,
    "fall_without": math.nan,
}

_PARTS: Columns = _CELL | {"by": "text", "part": "text"} | _RATE | _COUNTS | _FALL | EPISODES


def main_table(cells: Sequence[SuccessCell]) -> Table:
    """Return a row for each cell over all episodes."""
    records = [_rate_record(cell) | _ranking(cell) for cell in cells if not cell.part]
    note = f"{NOTE} {BEST} {_MAIN_NOTE}"
    return record_table("main", "Success by system and condition", _MAIN, records, note)


def parts_table(
    cells: Sequence[SuccessCell], all_outcomes: Iterable[Outcomes], contrasts: Sequence[Contrast]
) -> Table:
    """Return a row for each cell over a family, a difficulty or an ability; families come first."""
    fall_of = {
        (fall.simulator, fall.system, fall.condition, family): record
        for outcomes in all_outcomes
        for fall in primary_falls(contrasts, outcomes.simulator)
        for family, record in _in_families(outcomes, fall)
    }
    families, others = list[dict[str, Any]](), list[dict[str, Any]]()
    for cell in cells:
        by = part_kind(cell.part)
        if by in ("difficulty", "ability"):
            record = _rate_record(cell) | _NO_FALL | episodes_record(cell, listed=False)
            others.append(record | {"by": by})
        elif by == "family":
            fall = fall_of.get((cell.simulator, cell.system, cell.condition, cell.part), _NO_FALL)
            record = _rate_record(cell) | fall | episodes_record(cell, listed=True)
            families.append(record | {"by": by})
    notes = [NOTE, BEST, _PARTS_NOTE]
    if fall_of:
        notes.append(_FALLS_NOTE)
    title = "Success by family and by difficulty"
    if any(record["by"] == "ability" for record in others):
        title = "Success by family, by difficulty and by ability"
    return record_table("parts", title, _PARTS, families + others, " ".join(notes))


def _in_families(outcomes: Outcomes, fall: Contrast) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each family with its values of `_FALL`; none for a fall over a single family."""
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
        yield (
            family,
            {
                "fall_n": pairs.n,
                "fall": pairs.change.value,
                "fall_low": pairs.change.low,
                "fall_high": pairs.change.high,
                "fall_without": without,
            },
        )


def _rate_record(cell: SuccessCell) -> dict[str, Any]:
    """Return the values of the columns that both tables share, and more."""
    # The interval from 0 to 1 of a cell without episodes says nothing.
    low, high = cell.interval if cell.n else (math.nan, math.nan)
    successes, fails, timeouts, errors, _ = cell.counts
    return {
        "simulator": cell.simulator,
        "system": cell.system,
        "condition": cell.condition,
        "part": cell.part,
        "n": cell.n,
        "runs": cell.runs if cell.n else None,
        "scope": cell.scope if cell.n else "",
        "rate": cell.rate,
        "low": low,
        "high": high,
        "run_spread": cell.run_spread,
        "fixed_low": cell.fixed[0],
        "fixed_high": cell.fixed[1],
        "if_errors_fail": cell.if_errors_fail,
        "if_errors_succeed": cell.if_errors_succeed,
        "successes": successes,
        "fails": fails,
        "timeouts": timeouts,
        "errors": errors,
        "complete": cell.complete,
        "missing": len(cell.missing),
        "rank": cell.rank,
        "best": cell.best,
    }


def _ranking(cell: SuccessCell) -> dict[str, Any]:
    ranking = cell.ranking
    behind = Interval(math.nan) if ranking is None else ranking.behind
    return {
        "rank_low": None if ranking is None else ranking.rank_low,
        "rank_high": None if ranking is None else ranking.rank_high,
        "best_system": "" if ranking is None else ranking.best_system,
        "difference": behind.value,
        "difference_low": behind.low,
        "difference_high": behind.high,
        "p_holm": math.nan if ranking is None else ranking.p_holm,
    }
