"""Slopes over k: each system's own, and the differences between two systems."""

import math
from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Outcomes, success
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.stats.bootstrap import (
    DRAWS,
    MIN_EPISODES,
    Floats,
    bootstrap,
    departures,
    known_interval,
    slope_weights,
)
from robomme_interference_data.stats.significance import holm
from robomme_interference_data.stats.signs import sign_flips, vector_sign_flips
from robomme_interference_data.viz.tables import Table

from .contrast import Contrast
from .pairs import Pairs
from .tables import tested


def _falling(outcomes: Outcomes, *systems: str) -> list[str]:
    """Return the `k<n>` under which all systems have rows; none if there is only one."""
    shared = [c for c in outcomes.conditions if all(c in outcomes.ran(name) for name in systems)]
    found = [c for c in shared if parse_condition(c).kind.name == "k"]
    return found if len(found) > 1 else []


def _values(outcomes: Outcomes, system: str, conditions: Iterable[str]) -> Floats:
    """Return the success of each episode under each condition, `(E, K)`."""
    sides = [success(outcomes.status[outcomes.cell(system, c)]) for c in conditions]
    return np.stack(sides, axis=1)


def _numbers(conditions: Iterable[str]) -> list[int]:
    return [parse_condition(name).k for name in conditions]


def decay_table(every: Iterable[Outcomes], draws: int = DRAWS) -> Table:
    """Return each system's log-linear decay over the sessions in the buffer."""
    rows = [row for outcomes in every for row in _decays(outcomes, draws)]
    return tested(
        "decay",
        "Decay over sessions",
        "simulator system conditions n:count slope:points low:points high:points p:p p_holm:p "
        "p_fit:p p_fit_holm:p complete:flag",
        rows,
        "slope: change of the success rate per doubling of the sessions in the buffer, the lesson "
        "included (least-squares line over log2(k + 1)). 95% BCa bootstrap interval over episodes, "
        f"if at least {MIN_EPISODES} episodes contribute to the slope. p: sign-flip test of no "
        "trend. p fit: whether the rates depart from the line, by sign flips of the episodes' "
        "departures; if they do, the slope describes the fall only on average. p holm and "
        "p fit holm: after Holm's correction among the systems of a simulator.",
    )


def _decays(outcomes: Outcomes, draws: int) -> list[tuple[object, ...]]:
    key = outcomes.simulator
    found = {system: ks for system in outcomes.systems if (ks := _falling(outcomes, system))}
    if not found:
        return []
    values = [_values(outcomes, system, conditions) for system, conditions in found.items()]
    slopes = np.stack(
        [v @ slope_weights(_numbers(c)) for v, c in zip(values, found.values(), strict=True)], 1
    )
    ps = [one.p for one in sign_flips(slopes.round(12), key, draws)]
    fits = _fits(values, list(found.values()), key, draws)
    rows = list[tuple[object, ...]]()
    for (system, conditions), each, *both in zip(found.items(), slopes.T, ps, fits, strict=True):
        here = outcomes.has_episode[outcomes.systems.index(system)]
        [fall] = bootstrap(each[here, None], key, draws)
        changing = each[~np.isnan(each)]
        known = known_interval(fall, changing)
        whole = all(bool(outcomes.complete[outcomes.cell(system, c)]) for c in conditions)
        names = (key, system, " ".join(conditions), len(changing))
        rows.append((*names, *known, *both, whole))
    return rows


def _fits(
    values: Sequence[Floats], conditions: Sequence[Sequence[str]], key: str, draws: int
) -> list[float]:
    """Return p of no departure of values, `(E, K)`, from a line over k; NaN for two conditions."""
    parts = [v @ departures(_numbers(c)) for v, c in zip(values, conditions, strict=True)]
    found = zip(vector_sign_flips(parts, key, draws), conditions, strict=True)
    return [p if len(one) > 2 else math.nan for p, one in found]


def interactions_of(outcomes: Outcomes, draws: int = DRAWS) -> list[Contrast]:
    """Compare how fast each pair of systems falls over all `k<n>` that both have.

    Each pair is tested once. Systems whose histories may differ are left out, and so are
    references.
    """
    systems = [name for name in outcomes.systems if not outcomes.is_reference(name)]
    pairs, slopes, apart = list[tuple[str, str, list[str]]](), [], []
    for one, other in combinations(systems, 2):
        conditions = _falling(outcomes, one, other)
        if not conditions or not outcomes.pairable(one, other):
            continue
        both = [_values(outcomes, name, conditions) for name in (other, one)]
        pairs.append((one, other, conditions))
        slopes.append([values @ slope_weights(_numbers(conditions)) for values in both])
        apart.append(both[1] - both[0])
    if not pairs:
        return []
    changes = np.stack([(after - before).round(12) for before, after in slopes], axis=1)
    tests = sign_flips(changes, outcomes.simulator, draws)
    fits = _fits(apart, [conditions for *_, conditions in pairs], outcomes.simulator, draws)
    both_fits = list(zip(fits, holm(fits), strict=True))
    found = []
    for (one, other, conditions), sides, step, test, fit in zip(
        pairs, slopes, changes.T, tests, both_fits, strict=True
    ):
        known = ~np.isnan(step)
        n = int(known.sum())
        old, new = (float(side[known].mean()) if n else math.nan for side in sides)
        counts = (n, int((step > 0).sum()), int((step < 0).sum()))
        kind = "sign-flip" if n else ""
        every = [outcomes.cell(name, c) for name in (one, other) for c in conditions]
        compared = Pairs(n, old, new, test.at, kind, *counts, test.p, math.nan)
        names = (outcomes.simulator, one, conditions[-1], (other, conditions[-1]), "interaction")
        complete = all(bool(outcomes.complete[cell]) for cell in every)
        more: dict[str, object] = {"conditions": " ".join(conditions)}
        more |= dict(zip(("p_fit", "p_fit_holm"), fit, strict=True))
        found.append(Contrast(*names, compared, complete, more=more))
    return found
