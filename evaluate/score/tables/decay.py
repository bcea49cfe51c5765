"""How fast each system falls over k, and whether the fall is a line."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import ERROR, Outcomes
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.stats.bootstrap import DRAWS, MIN_EPISODES, bootstrap, known_interval
from robomme_interference_data.stats.intervals import LEVEL
from robomme_interference_data.stats.runs import run_spread
from robomme_interference_data.stats.signs import sign_flips
from robomme_interference_data.viz.tables import Columns, Table

from .comparison import RUNS_NOTE, tested_table
from .contrast import scope_of
from .correction import corrected, verdict_of
from .over_k import (
    all_complete,
    falls_of,
    fit_over_runs,
    fits,
    shared_ks,
    spreads_along,
    statuses_of,
)
from .pairs import shared_runs

_UNLIMITED = (-math.inf, math.inf)

DECAY: Columns = {
    "simulator": "text",
    "system": "text",
    "conditions": "text",
    "n": "count",
    "runs": "count",
    "scope": "text",
    "slope": "points",
    "low": "points",
    "high": "points",
    "if_failures": "points",
    "if_successes": "points",
    "p": "p",
    "p_holm": "p",
    "verdict": "text",
    "p_fit": "p",
    "complete": "flag",
}


def decay_table(all_outcomes: Iterable[Outcomes], draws: int = DRAWS) -> Table:
    """Return each system's log-linear decay over the sessions in the buffer."""
    records = []
    for outcomes in all_outcomes:
        own = _decays(outcomes, draws)
        columns = ("p", "p_if_failures", "p_if_successes")
        # Corrected among the systems of the simulator.
        ps = [corrected([record[name] for record in own], [0] * len(own)) for name in columns]
        for record, p, *possible in zip(own, *ps, strict=True):
            record["verdict"] = verdict_of(p, possible) or ""
        records += own
    return tested_table(
        "decay",
        "Decay over sessions",
        DECAY,
        records,
        "slope: change of the success rate per doubling of the sessions in the buffer, the lesson "
        "included (least-squares line over log2(k + 1)). 95% BCa bootstrap interval over episodes, "
        f"if at least {MIN_EPISODES} episodes contribute to the slope. p: sign-flip test of no "
        "trend; p holm: after Holm's correction among the systems of a simulator. p fit: whether "
        "the rates depart from the line, by sign flips of the episodes' departures, not corrected; "
        f"if they do, the slope describes the fall only on average. {RUNS_NOTE}",
    )


def _decays(outcomes: Outcomes, draws: int) -> list[dict[str, Any]]:
    """Return a record for each system; `possible` holds p if errors were failures, or successes."""
    records = _fitted(outcomes, draws)
    if not (outcomes.status == ERROR).any():
        return records
    for column, status in (("if_failures", Status.FAIL), ("if_successes", Status.SUCCESS)):
        # With more that counts, there can be further systems.
        others = {
            other["system"]: other for other in _fitted(outcomes.with_errors_as(status), draws)
        }
        for record in records:
            other = others[record["system"]]
            record[column] = other["slope"]
            record[f"p_{column}"] = other["p"]
    return records


def _fitted(outcomes: Outcomes, draws: int) -> list[dict[str, Any]]:
    key = outcomes.simulator
    ks_of = {system: shared_ks(outcomes, system) for system in outcomes.systems}
    fall_of = {}
    for system, conditions in ks_of.items():
        if not conditions:
            continue
        status = statuses_of(outcomes, system, conditions)
        shared = shared_runs([*status], outcomes.training)
        if shared.any():
            training = outcomes.training[shared]
            fall_of[system] = falls_of(status[..., shared], training, conditions)
    if not fall_of:
        return []
    ks_of = {system: ks_of[system] for system in fall_of}
    falls = list(fall_of.values())
    tests = sign_flips(np.stack([fall.slopes for fall in falls], axis=1).round(12), key, draws)
    p_fits = fits([fall.success for fall in falls], list(ks_of.values()), key, draws)
    records = []
    for (system, conditions), fall, test, p_fit in zip(
        ks_of.items(), falls, tests, p_fits, strict=True
    ):
        here = outcomes.has_episode[outcomes.systems.index(system)]
        [interval] = bootstrap(fall.slopes[here, None], key, draws)
        contributing = fall.slopes[~np.isnan(fall.slopes)]
        spread = run_spread(fall.by_run)
        slope = spread.widen(known_interval(interval, contributing), LEVEL, _UNLIMITED)
        p = spread.p(test.at, test.p)
        records.append(
            {
                "simulator": key,
                "system": system,
                "conditions": " ".join(conditions),
                "n": len(contributing),
                "runs": spread.runs,
                "scope": scope_of(spread.runs),
                "slope": slope.value,
                "low": slope.low,
                "high": slope.high,
                "if_failures": slope.value,
                "if_successes": slope.value,
                "p": p,
                "p_if_failures": p,
                "p_if_successes": p,
                "p_fit": fit_over_runs(p_fit, spreads_along(fall.residuals), fall.residuals, key),
                "complete": all_complete(outcomes, [system], conditions),
            }
        )
    return records
