"""The success of each system over k: its slope, and whether its fall is a line."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.evaluate.score.outcomes import (
    ERROR,
    Outcomes,
    Statuses,
    success,
    success_by_run,
)
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.stats.bootstrap import (
    DRAWS,
    MIN_EPISODES,
    Floats,
    Interval,
    bootstrap,
    known_interval,
    residual_weights,
    slope_weights,
)
from robomme_interference_data.stats.intervals import LEVEL
from robomme_interference_data.stats.runs import RunSpread, run_spread
from robomme_interference_data.stats.signs import sign_flips, vector_sign_flips
from robomme_interference_data.viz.tables import Columns, Table

from .comparison import RUNS_NOTE, tested_table
from .contrast import scope_of
from .correction import corrected, verdict_of
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
    intervals = _intervals(outcomes, fall_of, draws)
    records = []
    for (system, conditions), fall, test, p_fit in zip(
        ks_of.items(), falls, tests, p_fits, strict=True
    ):
        interval = intervals[system]
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


def _intervals(
    outcomes: Outcomes, fall_of: Mapping[str, "Falls"], draws: int
) -> dict[str, Interval]:
    """Return the bootstrap interval of each system's slope."""
    # Systems with the same episodes have the same draws, which are made once.
    alike = defaultdict[bytes, list[str]](list)
    for system in fall_of:
        alike[outcomes.has_episode[outcomes.systems.index(system)].tobytes()].append(system)
    intervals: dict[str, Interval] = {}
    for systems in alike.values():
        here = outcomes.has_episode[outcomes.systems.index(systems[0])]
        slopes = np.stack([fall_of[system].slopes[here] for system in systems], axis=1)
        intervals |= zip(systems, bootstrap(slopes, outcomes.simulator, draws), strict=True)
    return intervals


def shared_ks(outcomes: Outcomes, *systems: str) -> list[str]:
    """Return the `k<n>` under which all systems have rows; none if there is only one."""
    shared = [c for c in outcomes.conditions if all(c in outcomes.ran(name) for name in systems)]
    counted = [name for name in shared if parse_condition(name).kind.name == "k"]
    return counted if len(counted) > 1 else []


def statuses_of(outcomes: Outcomes, system: str, conditions: Iterable[str]) -> Statuses:
    """Return the outcomes under each condition, `(K, E, M) int8`."""
    return np.stack([outcomes.status[outcomes.cell(system, c)] for c in conditions])


class Falls(NamedTuple):
    """The success of a system over k, and its slopes."""

    success: Floats  # by episode and condition, the mean over repeats, (E, K)
    slopes: Floats  # by episode, (E,)
    by_run: Floats  # the slopes by training run, (E, R)
    residuals: Floats  # from the line, by training run, along K − 2 directions, (E, R, K − 2)


class _Line(NamedTuple):
    """What takes rates under K conditions to the line over log2(k + 1) that fits them."""

    slope: Floats  # to its slope, (K,)
    residuals: Floats  # to the distances from it, (K, K)
    directions: Floats  # to their K − 2 orthogonal directions, (K, K − 2)


@cache
def _line(conditions: tuple[str, ...]) -> _Line:
    ks = [parse_condition(name).k for name in conditions]
    residuals = residual_weights(ks)
    directions = np.linalg.svd(residuals)[0][:, : len(ks) - 2]
    return _Line(slope_weights(ks), residuals, directions)


def falls_of(status: Statuses, training: NDArray[np.int64], conditions: Sequence[str]) -> Falls:
    """Return the falls of outcomes, `(K, E, M) int8`."""
    line = _line(tuple(conditions))
    by_condition = success(status).T
    by_run = success_by_run(status, training).transpose(1, 2, 0)
    return Falls(
        by_condition, by_condition @ line.slope, by_run @ line.slope, by_run @ line.directions
    )


def spreads_along(residuals: Floats) -> list[RunSpread]:
    """Return the spread over training runs along each direction of `(E, R, D)` values."""
    return [run_spread(along) for along in np.moveaxis(residuals, -1, 0)]


def fit_over_runs(p_fit: float, spreads: Sequence[RunSpread], residuals: Floats, key: str) -> float:
    """Return p of no departure from a line with training runs as a random effect.

    The smallest of the tests along each direction, after Bonferroni's correction, and no less than
    `p_fit`, that for fixed runs.
    """
    if not any(spread.variance for spread in spreads):
        return p_fit
    tests = sign_flips(residuals.mean(axis=1).round(12), key)
    ps = [spread.p(test.at, test.p) for spread, test in zip(spreads, tests, strict=True)]
    return max(p_fit, min(1.0, len(ps) * min(ps)))


def all_complete(outcomes: Outcomes, systems: Iterable[str], conditions: Iterable[str]) -> bool:
    """Whether each of some systems has a complete cell under each condition."""
    return all(
        bool(outcomes.complete[outcomes.cell(*cell)]) for cell in product(systems, conditions)
    )


def fits(
    values: Sequence[Floats], conditions: Sequence[Sequence[str]], key: str, draws: int
) -> list[float]:
    """Return p of no departure of values, `(E, K)`, from a line over k; NaN for two conditions."""
    residuals = [
        by_k @ _line(tuple(names)).residuals for by_k, names in zip(values, conditions, strict=True)
    ]
    ps = vector_sign_flips(residuals, key, draws)
    # Two points are always on a line.
    return [p if len(names) > 2 else math.nan for p, names in zip(ps, conditions, strict=True)]
