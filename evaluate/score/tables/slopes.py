"""Slopes over k: each system's own, and the differences between two systems."""

import math
from collections.abc import Iterable, Sequence
from itertools import combinations, product
from typing import Any

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Outcomes, success
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.stats.bootstrap import (
    DRAWS,
    MIN_EPISODES,
    Floats,
    bootstrap,
    departure_weights,
    known_interval,
    slope_weights,
)
from robomme_interference_data.stats.signs import sign_flips, vector_sign_flips
from robomme_interference_data.viz.tables import Columns, Table

from .comparison import ComparisonTable, comparison_table, tested_table
from .contrast import Contrast, Effect
from .pairs import Pairs


def _shared_ks(outcomes: Outcomes, *systems: str) -> list[str]:
    """Return the `k<n>` under which all systems have rows; none if there is only one."""
    shared = [c for c in outcomes.conditions if all(c in outcomes.ran(name) for name in systems)]
    counted = [name for name in shared if parse_condition(name).kind.name == "k"]
    return counted if len(counted) > 1 else []


def _values(outcomes: Outcomes, system: str, conditions: Iterable[str]) -> Floats:
    """Return the success of each episode under each condition, `(E, K)`."""
    sides = [success(outcomes.status[outcomes.cell(system, c)]) for c in conditions]
    return np.stack(sides, axis=1)


def _numbers(conditions: Iterable[str]) -> list[int]:
    return [parse_condition(name).k for name in conditions]


DECAY: Columns = {
    "simulator": "text",
    "system": "text",
    "conditions": "text",
    "n": "count",
    "slope": "points",
    "low": "points",
    "high": "points",
    "p": "p",
    "p_holm": "p",
    "p_fit": "p",
    "complete": "flag",
}


def decay_table(all_outcomes: Iterable[Outcomes], draws: int = DRAWS) -> Table:
    """Return each system's log-linear decay over the sessions in the buffer."""
    return tested_table(
        "decay",
        "Decay over sessions",
        DECAY,
        [record for outcomes in all_outcomes for record in _decays(outcomes, draws)],
        "slope: change of the success rate per doubling of the sessions in the buffer, the lesson "
        "included (least-squares line over log2(k + 1)). 95% BCa bootstrap interval over episodes, "
        f"if at least {MIN_EPISODES} episodes contribute to the slope. p: sign-flip test of no "
        "trend; p holm: after Holm's correction among the systems of a simulator. p fit: whether "
        "the rates depart from the line, by sign flips of the episodes' departures, not corrected; "
        "if they do, the slope describes the fall only on average.",
    )


def _decays(outcomes: Outcomes, draws: int) -> list[dict[str, Any]]:
    key = outcomes.simulator
    ks_of = {system: _shared_ks(outcomes, system) for system in outcomes.systems}
    ks_of = {system: conditions for system, conditions in ks_of.items() if conditions}
    if not ks_of:
        return []
    values = [_values(outcomes, system, conditions) for system, conditions in ks_of.items()]
    slopes = [
        success_by_k @ slope_weights(_numbers(conditions))
        for success_by_k, conditions in zip(values, ks_of.values(), strict=True)
    ]
    tests = sign_flips(np.stack(slopes, axis=1).round(12), key, draws)
    fits = _fits(values, list(ks_of.values()), key, draws)
    records = []
    for (system, conditions), slope, test, p_fit in zip(
        ks_of.items(), slopes, tests, fits, strict=True
    ):
        here = outcomes.has_episode[outcomes.systems.index(system)]
        [interval] = bootstrap(slope[here, None], key, draws)
        contributing = slope[~np.isnan(slope)]
        fall = known_interval(interval, contributing)
        records.append(
            {
                "simulator": key,
                "system": system,
                "conditions": " ".join(conditions),
                "n": len(contributing),
                "slope": fall.value,
                "low": fall.low,
                "high": fall.high,
                "p": test.p,
                "p_fit": p_fit,
                "complete": _all_complete(outcomes, [system], conditions),
            }
        )
    return records


def _all_complete(outcomes: Outcomes, systems: Iterable[str], conditions: Iterable[str]) -> bool:
    return all(
        bool(outcomes.complete[outcomes.cell(*cell)]) for cell in product(systems, conditions)
    )


def _fits(
    values: Sequence[Floats], conditions: Sequence[Sequence[str]], key: str, draws: int
) -> list[float]:
    """Return p of no departure of values, `(E, K)`, from a line over k; NaN for two conditions."""
    departures = [
        by_k @ departure_weights(_numbers(names))
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
        "slope": "points",
        "against_slope": "points",
        "difference": "points",
        "low": "points",
        "high": "points",
        "gained": "count",
        "lost": "count",
        "p": "p",
        "p_holm": "p",
        "joint_low": "points",
        "joint_high": "points",
        "p_fit": "p",
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
    systems = [name for name in outcomes.systems if not outcomes.is_reference(name)]
    pairs, slopes, apart = list[tuple[str, str, list[str]]](), [], []
    for system, other in combinations(systems, 2):
        conditions = _shared_ks(outcomes, system, other)
        if not conditions or not outcomes.pairable(system, other):
            continue
        first, second = (_values(outcomes, name, conditions) for name in (other, system))
        weights = slope_weights(_numbers(conditions))
        pairs.append((system, other, conditions))
        slopes.append((first @ weights, second @ weights))
        apart.append(second - first)
    if not pairs:
        return []
    changes = np.stack([(after - before).round(12) for before, after in slopes], axis=1)
    tests = sign_flips(changes, outcomes.simulator, draws)
    fits = _fits(apart, [conditions for *_, conditions in pairs], outcomes.simulator, draws)
    contrasts = []
    for (system, other, conditions), (first, second), change, test, p_fit in zip(
        pairs, slopes, changes.T, tests, fits, strict=True
    ):
        known = ~np.isnan(change)
        n = int(known.sum())
        compared = Pairs(
            n=n,
            first=float(first[known].mean()) if n else math.nan,
            second=float(second[known].mean()) if n else math.nan,
            at=test.at,
            method="sign-flip" if n else "",
            pairs=n,
            gained=int((change > 0).sum()),
            lost=int((change < 0).sum()),
            p=test.p,
        )
        contrasts.append(
            Contrast(
                outcomes.simulator,
                system,
                conditions[-1],
                (other, conditions[-1]),
                Effect.SLOPES,
                compared,
                _all_complete(outcomes, [system, other], conditions),
                columns={
                    "conditions": " ".join(conditions),
                    "slope": compared.second,
                    "against_slope": compared.first,
                    "p_fit": p_fit,
                },
            )
        )
    return contrasts
