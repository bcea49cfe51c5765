"""The success of systems over k: slopes, residuals from a line, and what both share."""

import math
from collections.abc import Iterable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.evaluate.score.outcomes import (
    Outcomes,
    Statuses,
    success,
    success_by_run,
)
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.stats.bootstrap import Floats, residual_weights, slope_weights
from robomme_interference_data.stats.runs import RunSpread, run_spread
from robomme_interference_data.stats.signs import sign_flips, vector_sign_flips


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


def falls_of(status: Statuses, training: NDArray[np.int64], conditions: Sequence[str]) -> Falls:
    """Return the falls of outcomes, `(K, E, M) int8`."""
    ks = [parse_condition(name).k for name in conditions]
    weights = slope_weights(ks)
    by_condition = success(status).T
    by_run = success_by_run(status, training).transpose(1, 2, 0)
    # The directions in which rates can depart from a line: orthogonal ones.
    directions = np.linalg.svd(residual_weights(ks))[0][:, : len(ks) - 2]
    return Falls(by_condition, by_condition @ weights, by_run @ weights, by_run @ directions)


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
        by_k @ residual_weights([parse_condition(name).k for name in names])
        for by_k, names in zip(values, conditions, strict=True)
    ]
    ps = vector_sign_flips(residuals, key, draws)
    # Two points are always on a line.
    return [p if len(names) > 2 else math.nan for p, names in zip(ps, conditions, strict=True)]
