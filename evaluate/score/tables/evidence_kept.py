"""Success by whether the memory kept the evidence: failures of access, of use and of execution."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.evaluate.score.outcomes import Outcomes, Statuses, counting, rate_of
from robomme_interference_data.evaluate.score.partners import control_of
from robomme_interference_data.stats.significance import mantel_haenszel
from robomme_interference_data.viz.tables import Columns, Table

from .comparison import record_table, tested_table
from .pairs import pair


@dataclass(frozen=True)
class _KeptCell:
    """A system under a condition, with the rollouts that kept all, some and none of the evidence.

    `levels` has the outcomes of each level that any rollout has, `(E, M) int8`, −1 elsewhere.
    """

    outcomes: Outcomes
    system: str
    condition: str
    levels: Mapping[str, Statuses]

    @property
    def record(self) -> dict[str, Any]:
        """The columns that name the cell."""
        return {
            "simulator": self.outcomes.simulator,
            "system": self.system,
            "condition": self.condition,
        }


def _kept_cells(all_outcomes: Iterable[Outcomes]) -> Iterator[_KeptCell]:
    for outcomes in all_outcomes:
        kept = outcomes.evidence
        of_level = {"all": kept == 1, "some": (kept > 0) & (kept < 1), "none": kept == 0}
        for s, c in np.argwhere(outcomes.has_rows).tolist():
            levels = {
                level: np.where(of[s, c], outcomes.status[s, c], np.int8(-1))
                for level, of in of_level.items()
                if (of[s, c] & (outcomes.status[s, c] >= 0)).any()
            }
            yield _KeptCell(outcomes, outcomes.systems[s], outcomes.conditions[c], levels)


def evidence_tables(all_outcomes: Iterable[Outcomes]) -> list[Table]:
    """Return the two tables of success by the evidence kept, where that is known."""
    cells = list(_kept_cells(all_outcomes))
    return [_effects(cells), _use(cells)]


EFFECTS: Columns = {
    "simulator": "text",
    "system": "text",
    "condition": "text",
    "kept": "text",
    "against_kept": "text",
    "families": "count",
    "n": "count",
    "rate": "rate",
    "rate_low": "rate",
    "rate_high": "rate",
    "against_n": "count",
    "against_rate": "rate",
    "difference": "points",
    "low": "points",
    "high": "points",
    "p": "p",
    "p_holm": "p",
    "complete": "flag",
}


def _effects(cells: Iterable[_KeptCell]) -> Table:
    """Return the rate of each level, and the differences between levels within families."""
    records = []
    for cell in cells:
        complete = bool(cell.outcomes.complete[cell.outcomes.cell(cell.system, cell.condition)])
        for record in (*_rates(cell), *_differences(cell)):
            records.append(cell.record | {"complete": complete} | record)
    return tested_table(
        "evidence_effects",
        "Success by the evidence that the memory kept",
        EFFECTS,
        records,
        "kept: whether all, some or none of the lesson's evidence spans have a frame in the memory "
        "at the first step. Without against kept: the rate over the n episodes for which that is "
        "known, with its 95% Wilson interval; these levels have different episodes, and often "
        "different families. If all evidence was kept, a failure is one of use or, of a rollout, "
        "of execution: see the table evidence_use. If none was, a success is luck or needs no "
        "memory. With against kept: episodes that kept more of the evidence against those that "
        "kept less, under the same condition and within the same family, so that families which "
        "are easier and keep more do not count as an effect. Only families with episodes of both "
        "levels contribute; each weighs n1 n2 / (n1 + n2) (Mantel and Haenszel), in rates and "
        "difference alike. low to high: 95% interval, from Wilson's stratified intervals of both "
        "rates. p: Cochran-Mantel-Haenszel test; p holm: after Holm's correction among the tests "
        "of this table in one simulator. Within a family, episodes that keep less may still be "
        "harder.",
    )


_NO_DIFFERENCE: dict[str, Any] = {
    "against_kept": "",
    "families": None,
    "against_n": None,
    "against_rate": None,
    "difference": None,
    "low": None,
    "high": None,
    "p": math.nan,
}


def _rates(cell: _KeptCell) -> Iterator[dict[str, Any]]:
    """Yield the rate of each level."""
    for level, status in cell.levels.items():
        rate = rate_of(status)
        if rate.n:
            low, high = rate.interval
            yield _NO_DIFFERENCE | {
                "kept": level,
                "n": rate.n,
                "rate": rate.value,
                "rate_low": low,
                "rate_high": high,
            }


def _differences(cell: _KeptCell) -> Iterator[dict[str, Any]]:
    """Yield the difference of each two levels, within families."""
    families = cell.outcomes.family
    by_level = {level: _by_family(status, families) for level, status in cell.levels.items()}
    for more, less in combinations(by_level, 2):
        won, trials = np.stack([by_level[less], by_level[more]], axis=1)
        compared = mantel_haenszel(won, trials)
        if not compared.strata:
            continue
        shared = np.isin(families, np.flatnonzero(trials.all(axis=0)))
        yield {
            "kept": more,
            "against_kept": less,
            "families": compared.strata,
            "n": rate_of(cell.levels[more][shared]).n,
            "rate": compared.second,
            "rate_low": None,
            "rate_high": None,
            "against_n": rate_of(cell.levels[less][shared]).n,
            "against_rate": compared.first,
            "difference": compared.change.value,
            "low": compared.change.low,
            "high": compared.change.high,
            "p": compared.p,
        }


def _by_family(status: Statuses, families: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return successes and effective trials of each family, `(2, F)`."""
    rates = [rate_of(status[families == place]) for place in range(families.max() + 1)]
    won = [rate.value * rate.trials if rate.n else 0.0 for rate in rates]
    return np.array([won, [rate.trials for rate in rates]], float)


USE: Columns = {
    "simulator": "text",
    "system": "text",
    "condition": "text",
    "control": "text",
    "control_condition": "text",
    "n": "count",
    "failures": "rate",
    "execution": "rate",
    "execution_low": "rate",
    "execution_high": "rate",
    "use": "points",
    "use_low": "points",
    "use_high": "points",
}


def _use(cells: Iterable[_KeptCell]) -> Table:
    """Return the failures although all evidence was kept, split by a control's own."""
    records, lacks_control = list[dict[str, Any]](), False
    for cell in cells:
        if (cell.outcomes.chance >= 0).any():
            continue  # answers to questions are not executed
        if cell.outcomes.is_reference(cell.system):
            continue
        kept = cell.levels.get("all")
        if kept is None or not rate_of(kept).n:
            continue
        control = control_of(cell.outcomes, cell.system)
        if control is None:
            lacks_control = True
            records.append(cell.record | _failures(kept))
        elif record := _beside_control(cell, kept, control):
            records.append(cell.record | record)
    note = f"{_USE_NOTE} {_ADVICE}" if lacks_control else _USE_NOTE
    return record_table(
        "evidence_use", "Failures although all evidence was kept", USE, records, note
    )


def _failures(kept: Statuses) -> dict[str, Any]:
    """Return the failures of a system that no control is known for."""
    rate = rate_of(kept)
    unknown = ("execution", "execution_low", "execution_high", "use", "use_low", "use_high")
    return {
        "control": "",
        "control_condition": "",
        "n": rate.n,
        "failures": 1 - rate.value,
        **dict.fromkeys(unknown),
    }


def _beside_control(cell: _KeptCell, kept: Statuses, control: str) -> dict[str, Any]:
    """Return the failures of a system and of its control; empty without a shared episode."""
    ran = cell.outcomes.ran(control)
    # It knows the answer, so that its failures depend little on the condition.
    condition = cell.condition if cell.condition in ran else ran[0]
    own = cell.outcomes.status[cell.outcomes.cell(control, condition)]
    both = counting(kept).any(-1) & counting(own).any(-1)
    pairs, reached = pair(kept[both], own[both]), rate_of(own[both])
    if not pairs.n:
        return {}
    low, high = reached.interval
    return {
        "control": control,
        "control_condition": condition,
        "n": pairs.n,
        "failures": 1 - pairs.first,
        "execution": 1 - reached.value,
        "execution_low": 1 - high,
        "execution_high": 1 - low,
        "use": pairs.change.value,
        "use_low": pairs.change.low,
        "use_high": pairs.change.high,
    }


_USE_NOTE = (
    "Over the n episodes whose evidence was all kept and that count on both sides. failures: of "
    "the system. control: a system that knows the answer, so that its failures on the same "
    "episodes are of execution (Wilson's interval); the rest, use, is the paired difference to the "
    "control (intervals as in the table effects). The control is the system itself with the "
    "simulator's subgoals, else follow-subgoals with them, else oracle, under the same condition "
    "if it has rows there. The last two have the simulator's own controller: with them, use "
    "includes what the system executes worse."
)
_ADVICE = (
    "Without a control: evaluate the same episodes with --policy oracle (tabletop), or with the "
    "system's own policy and --subgoals oracle, and score both runs "
    "together."
)
