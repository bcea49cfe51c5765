"""Slopes over k: each system's own, and the differences between two systems."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations, product
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
from robomme_interference_data.evaluate.score.partners import share_weights
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.stats.bootstrap import (
    DRAWS,
    MIN_EPISODES,
    Floats,
    bootstrap,
    departure_weights,
    known_interval,
    slope_weights,
)
from robomme_interference_data.stats.intervals import LEVEL
from robomme_interference_data.stats.runs import RunSpread, independent, run_spread
from robomme_interference_data.stats.signs import sign_flips, vector_sign_flips
from robomme_interference_data.viz.tables import Columns, Table

from .comparison import RUNS_NOTE, ComparisonTable, comparison_table, tested_table
from .contrast import Contrast, Effect, scope_of
from .correction import corrected, verdict_of
from .pairs import Pairs, add_runs, shared_runs

_UNLIMITED = (-math.inf, math.inf)


def _shared_ks(outcomes: Outcomes, *systems: str) -> list[str]:
    """Return the `k<n>` under which all systems have rows; none if there is only one."""
    shared = [c for c in outcomes.conditions if all(c in outcomes.ran(name) for name in systems)]
    counted = [name for name in shared if parse_condition(name).kind.name == "k"]
    return counted if len(counted) > 1 else []


def _statuses(outcomes: Outcomes, system: str, conditions: Iterable[str]) -> Statuses:
    """Return the outcomes under each condition, `(K, E, M) int8`."""
    return np.stack([outcomes.status[outcomes.cell(system, c)] for c in conditions])


class _Falls(NamedTuple):
    """The success of a system over k, and its slopes."""

    success: Floats  # by episode and condition, the mean over repeats, (E, K)
    slopes: Floats  # by episode, (E,)
    by_run: Floats  # the slopes by training run, (E, R)
    departures: Floats  # from the line, by training run, along K − 2 directions, (E, R, K − 2)


def _falls(status: Statuses, training: NDArray[np.int64], conditions: Sequence[str]) -> _Falls:
    """Return the falls of outcomes, `(K, E, M) int8`."""
    ks = [parse_condition(name).k for name in conditions]
    weights = slope_weights(ks)
    by_condition = success(status).T
    by_run = success_by_run(status, training).transpose(1, 2, 0)
    # The directions in which rates can depart from a line: orthogonal ones.
    directions = np.linalg.svd(departure_weights(ks))[0][:, : len(ks) - 2]
    return _Falls(by_condition, by_condition @ weights, by_run @ weights, by_run @ directions)


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
    ks_of = {system: _shared_ks(outcomes, system) for system in outcomes.systems}
    fall_of = {}
    for system, conditions in ks_of.items():
        if not conditions:
            continue
        status = _statuses(outcomes, system, conditions)
        shared = shared_runs([*status], outcomes.training)
        if shared.any():
            training = outcomes.training[shared]
            fall_of[system] = _falls(status[..., shared], training, conditions)
    if not fall_of:
        return []
    ks_of = {system: ks_of[system] for system in fall_of}
    falls = list(fall_of.values())
    tests = sign_flips(np.stack([fall.slopes for fall in falls], axis=1).round(12), key, draws)
    fits = _fits([fall.success for fall in falls], list(ks_of.values()), key, draws)
    records = []
    for (system, conditions), fall, test, p_fit in zip(
        ks_of.items(), falls, tests, fits, strict=True
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
                "p_fit": _fit_over_runs(p_fit, _spreads(fall.departures), fall.departures, key),
                "complete": _all_complete(outcomes, [system], conditions),
            }
        )
    return records


def _spreads(departures: Floats) -> list[RunSpread]:
    """Return the spread over training runs along each direction of `(E, R, D)` values."""
    return [run_spread(along) for along in np.moveaxis(departures, -1, 0)]


def _fit_over_runs(
    p_fit: float, spreads: Sequence[RunSpread], departures: Floats, key: str
) -> float:
    """Return p of no departure from a line with training runs as a random effect.

    The smallest of the tests along each direction, after Bonferroni's correction, and no less than
    `p_fit`, that for fixed runs.
    """
    if not any(spread.variance for spread in spreads):
        return p_fit
    tests = sign_flips(departures.mean(axis=1).round(12), key)
    ps = [spread.p(test.at, test.p) for spread, test in zip(spreads, tests, strict=True)]
    return max(p_fit, min(1.0, len(ps) * min(ps)))


def _all_complete(outcomes: Outcomes, systems: Iterable[str], conditions: Iterable[str]) -> bool:
    return all(
        bool(outcomes.complete[outcomes.cell(*cell)]) for cell in product(systems, conditions)
    )


def _fits(
    values: Sequence[Floats], conditions: Sequence[Sequence[str]], key: str, draws: int
) -> list[float]:
    """Return p of no departure of values, `(E, K)`, from a line over k; NaN for two conditions."""
    departures = [
        by_k @ departure_weights([parse_condition(name).k for name in names])
        for by_k, names in zip(values, conditions, strict=True)
    ]
    ps = vector_sign_flips(departures, key, draws)
    # Two points are always on a line.
    return [p if len(names) > 2 else math.nan for p, names in zip(ps, conditions, strict=True)]


INTERACTION = ComparisonTable(
    name="interaction",
    title="Which system falls faster",
    columns={
        "simulator": "text",
        "system": "text",
        "against_system": "text",
        "conditions": "text",
        "n": "count",
        "runs": "count",
        "scope": "text",
        "slope": "points",
        "against_slope": "points",
        "difference": "points",
        "low": "points",
        "high": "points",
        "if_failures": "points",
        "if_successes": "points",
        "gained": "count",
        "lost": "count",
        "p": "p",
        "p_holm": "p",
        "joint_low": "points",
        "joint_high": "points",
        "verdict": "text",
        "p_fit": "p",
        "primary": "flag",
        "complete": "flag",
    },
    note=(
        "slope: change of the success rate per doubling of the sessions (least-squares line over "
        "log2(k + 1) of all conditions listed); difference: between the two slopes, positive if "
        "the system falls more slowly than the other one. Each pair of systems once; those whose "
        "histories may differ are left out. Over the n episodes that count in all cells; gained "
        "and lost: episodes whose own slope is higher or lower than the other system's. p: "
        "sign-flip test of the episodes' differences; low to high: the 95% interval of all "
        "differences that this test does not reject, if at least ten episodes differ. p fit: "
        "whether the difference between the two rates departs from a line over log2(k + 1), by "
        "sign flips, not corrected."
    ),
    corrected=(
        "the tests of the primary analysis: these, and k7 against k0 of each system, in effects"
    ),
    explain=False,
)


def interaction_table(contrasts: Iterable[Contrast]) -> Table:
    """Return the falls of two systems compared, among some comparisons."""
    return comparison_table(INTERACTION, [c for c in contrasts if c.effect is Effect.SLOPES])


def interactions_of(outcomes: Outcomes, draws: int = DRAWS) -> list[Contrast]:
    """Compare how fast each pair of systems falls over all `k<n>` that both have.

    Each pair is tested once. Systems whose histories may differ are left out, and so are
    references.
    """
    contrasts = _interactions(outcomes, draws)
    if not (outcomes.status == ERROR).any():
        return contrasts
    failures, successes = (
        # With more that counts, there can be further pairs of systems.
        {(other.system, other.against): other.pairs for other in _interactions(changed, draws)}
        for changed in map(outcomes.with_errors_as, (Status.FAIL, Status.SUCCESS))
    )
    for place, contrast in enumerate(contrasts):
        key = contrast.system, contrast.against
        pairs = replace(contrast.pairs, if_failures=failures[key], if_successes=successes[key])
        contrasts[place] = replace(contrast, pairs=pairs)
    return contrasts


class _Apart(NamedTuple):
    """The falls of two systems under shared conditions."""

    system: str
    other: str
    conditions: list[str]
    first: _Falls  # of the other one
    second: _Falls
    related: bool  # whether equal training runs of both are the same weights

    @property
    def change(self) -> Floats:
        """The differences of slopes by episode, `(E,)`."""
        return (self.second.slopes - self.first.slopes).round(12)

    @property
    def spread(self) -> RunSpread:
        """The spread of the difference over training runs."""
        first, second = self.first.by_run, self.second.by_run
        if self.related and first.shape == second.shape:
            return run_spread(second - first)
        return independent(run_spread(first), run_spread(second))

    @property
    def departure_spreads(self) -> list[RunSpread]:
        """The same along each direction in which the difference can depart from a line."""
        first, second = self.first.departures, self.second.departures
        if self.related and first.shape == second.shape:
            return _spreads(second - first)
        return [independent(*both) for both in zip(_spreads(first), _spreads(second), strict=True)]


def _apart(outcomes: Outcomes, system: str, other: str) -> _Apart | None:
    """Return the falls of two systems; None if they are not compared."""
    conditions = _shared_ks(outcomes, system, other)
    if not conditions or not outcomes.pairable(system, other):
        return None
    first, second = (_statuses(outcomes, name, conditions) for name in (other, system))
    related = share_weights(outcomes, system, other)
    training = outcomes.training
    if related:
        both = [shared_runs([*first, *second], training)] * 2
    else:
        both = [shared_runs([*side], training) for side in (first, second)]
    if not all(runs.any() for runs in both):
        return None
    falls = [
        _falls(side[..., runs], training[runs], conditions)
        for side, runs in zip((first, second), both, strict=True)
    ]
    return _Apart(system, other, conditions, falls[0], falls[1], related)


def _interactions(outcomes: Outcomes, draws: int) -> list[Contrast]:
    systems = [name for name in outcomes.systems if not outcomes.is_reference(name)]
    every = [_apart(outcomes, *both) for both in combinations(systems, 2)]
    compared = [apart for apart in every if apart is not None]
    if not compared:
        return []
    key = outcomes.simulator
    tests = sign_flips(np.stack([apart.change for apart in compared], axis=1), key, draws)
    differences = [apart.second.success - apart.first.success for apart in compared]
    fits = _fits(differences, [apart.conditions for apart in compared], key, draws)
    contrasts = []
    for apart, test, p_fit in zip(compared, tests, fits, strict=True):
        known = ~np.isnan(apart.change)
        n = int(known.sum())
        pairs = Pairs(
            n=n,
            first=float(apart.first.slopes[known].mean()) if n else math.nan,
            second=float(apart.second.slopes[known].mean()) if n else math.nan,
            at=test.at,
            method="sign-flip" if n else "",
            pairs=n,
            gained=int((apart.change > 0).sum()),
            lost=int((apart.change < 0).sum()),
            p=test.p,
        )
        departures = (apart.second.departures.mean(axis=1) - apart.first.departures.mean(axis=1))[
            :, None
        ]
        contrasts.append(
            Contrast(
                key,
                apart.system,
                apart.conditions[-1],
                (apart.other, apart.conditions[-1]),
                Effect.SLOPES,
                add_runs(pairs, apart.spread),
                _all_complete(outcomes, [apart.system, apart.other], apart.conditions),
                columns={
                    "conditions": " ".join(apart.conditions),
                    "slope": pairs.second,
                    "against_slope": pairs.first,
                    "p_fit": _fit_over_runs(p_fit, apart.departure_spreads, departures, key),
                },
            )
        )
    return contrasts
