"""Success by whether the memory kept the evidence: failures of access, of use and of execution."""

from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.evaluate.score.comparisons.pairs import pair
from robomme_interference_data.evaluate.score.comparisons.tables import tested
from robomme_interference_data.evaluate.score.outcomes import Outcomes, Statuses, counting, rate_of
from robomme_interference_data.evaluate.score.partners import control_of
from robomme_interference_data.stats.strata import mantel_haenszel
from robomme_interference_data.viz.tables import Table

_Cell = tuple[str, str, str]


def _levels(every: Iterable[Outcomes]) -> Iterator[tuple[Outcomes, _Cell, Mapping[str, Statuses]]]:
    """Yield each cell with the rollouts that kept all, some and none of the evidence."""
    for outcomes in every:
        kept = outcomes.evidence
        levels = {"all": kept == 1, "some": (kept > 0) & (kept < 1), "none": kept == 0}
        for s, c in np.argwhere(outcomes.has_rows).tolist():
            cell = (outcomes.simulator, outcomes.systems[s], outcomes.conditions[c])
            found = {
                name: np.where(chosen[s, c], outcomes.status[s, c], np.int8(-1))
                for name, chosen in levels.items()
            }
            yield outcomes, cell, {name: one for name, one in found.items() if (one >= 0).any()}


def evidence_tables(every: Iterable[Outcomes]) -> list[Table]:
    """Return the three tables of success by the evidence kept, where that is known."""
    cells = list(_levels(every))
    return [_rates(cells), _effects(cells), _use(cells)]


_Cells = list[tuple[Outcomes, _Cell, Mapping[str, Statuses]]]


def _rates(cells: _Cells) -> Table:
    rows = [
        (*cell, name, rate.n, rate.value, *rate.interval)
        for _, cell, levels in cells
        for name, status in levels.items()
        if (rate := rate_of(status)).n
    ]
    return Table(
        "by_evidence_kept",
        "Success by the evidence that the memory kept",
        {
            "simulator": "text",
            "system": "text",
            "condition": "text",
            "kept": "text",
            "n": "count",
            "rate": "rate",
            "low": "rate",
            "high": "rate",
        },
        rows,
        "kept: whether all, some or none of the lesson's evidence spans have a frame in the memory "
        "at the first step. Rates over the n episodes for which that is known, with 95% Wilson "
        "intervals. The levels have different episodes, and often different families: the table "
        "evidence_effects compares them within families. If all evidence was kept, a failure is "
        "one of use or, of a rollout, of execution: see the table evidence_use. If none was, a "
        "success is luck or needs no memory.",
    )


def _effects(cells: _Cells) -> Table:
    """Return the differences between the levels, within families."""
    rows = []
    for outcomes, cell, levels in cells:
        families = outcomes.family
        parts = {name: _by_family(status, families) for name, status in levels.items()}
        complete = bool(outcomes.complete[outcomes.cell(*cell[1:])])
        for one, other in combinations(parts, 2):
            won, of = np.stack([parts[other], parts[one]], axis=1)
            compared = mantel_haenszel(won, of)
            if compared.strata:
                n = [
                    sum(rate_of(levels[name][families == f]).n for f in np.flatnonzero(of.all(0)))
                    for name in (one, other)
                ]
                both = (compared.second, compared.first, *compared.change)
                levels_of = (*cell, one, other, compared.strata, *n)
                rows.append((*levels_of, *both, compared.p, complete))
    return tested(
        "evidence_effects",
        "Effect of the evidence kept, within families",
        "simulator system condition kept against_kept families:count n:count against_n:count "
        "rate:rate against_rate:rate difference:points low:points high:points p:p p_holm:p "
        "complete:flag",
        rows,
        "Episodes that kept more of the evidence against those that kept less, under the same "
        "condition and within the same family, so that families which are easier and keep more do "
        "not count as an effect. Only families with episodes of both levels contribute; each "
        "weighs n1 n2 / (n1 + n2) (Mantel and Haenszel), in rates and difference alike. low to "
        "high: 95% interval, from Wilson's stratified intervals of both rates. p: Cochran-Mantel-"
        "Haenszel test; p holm: after Holm's correction among the tests of this table in one "
        "simulator. Within a family, episodes that keep less may still be harder.",
    )


def _by_family(status: Statuses, families: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return successes and effective trials of each family, `(2, F)`."""
    rates = [rate_of(status[families == place]) for place in range(families.max() + 1)]
    won = [rate.value * rate.trials if rate.n else 0.0 for rate in rates]
    return np.array([won, [rate.trials for rate in rates]], float)


def _use(cells: _Cells) -> Table:
    """Return the failures although all evidence was kept, split by a control's own."""
    rows, alone = list[tuple[object, ...]](), False
    for outcomes, cell, levels in cells:
        kept = levels.get("all")
        system, condition = cell[1:]
        if (outcomes.chance >= 0).any():
            continue  # answers to questions are not executed
        if kept is None or outcomes.is_reference(system) or not rate_of(kept).n:
            continue
        control = control_of(outcomes, system)
        if control is None:
            rate, alone = rate_of(kept), True
            rows.append((*cell, "", "", rate.n, 1 - rate.value, *[None] * 6))
            continue
        ran = outcomes.ran(control)
        same = condition if condition in ran else ran[0]
        own = outcomes.status[outcomes.cell(control, same)]
        both = counting(kept).any(-1) & counting(own).any(-1)
        pairs, reached = pair(kept[both], own[both]), rate_of(own[both])
        if pairs.n:
            execution = (1 - bound for bound in (reached.value, *reversed(reached.interval)))
            rows.append((*cell, control, same, pairs.n, 1 - pairs.first, *execution, *pairs.change))
    return Table(
        "evidence_use",
        "Failures although all evidence was kept",
        {
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
        },
        rows,
        "Over the n episodes whose evidence was all kept and that count on both sides. failures: "
        "of the system. control: a system that knows the answer, so that its failures on the same "
        "episodes are of execution (Wilson's interval); the rest, use, is the paired difference "
        "to the control (intervals as in the table effects). The control is the system itself "
        "with the simulator's subgoals, else follow-subgoals with them, else oracle, "
        "under the same condition if it has rows there. The last two have the "
        "simulator's own controller: with them, use includes what the system executes worse."
        + (_ADVICE if alone else ""),
    )


_ADVICE = (
    " Without a control: evaluate the same episodes with --policy oracle (tabletop), or with the "
    "system's own policy and --subgoals oracle, and score both runs "
    "together."
)
