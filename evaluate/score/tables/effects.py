"""Effects of conditions on a system: of history, sessions, retrieval and kinds of interference.

All comparisons are paired over the episodes that count under both conditions.
"""

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Outcomes, success
from robomme_interference_data.schema.conditions import NO_HISTORY, parse_condition
from robomme_interference_data.stats.bootstrap import Floats, Interval
from robomme_interference_data.stats.intervals import fieller
from robomme_interference_data.stats.significance import ALPHA
from robomme_interference_data.viz.tables import Table

from .comparison import (
    BOTH_SIDES,
    COMPLETE,
    RATES,
    SIDES,
    ComparisonTable,
    comparison_table,
    detectable,
)
from .contrast import START, Contrast, Effect, comparable
from .pairs import pair

TESTED_TOGETHER = {
    Effect.HISTORY: "history",
    Effect.SESSIONS: "sessions and retrieval",
    Effect.RETRIEVAL: "sessions and retrieval",
    Effect.INTERFERENCE: "interference",
    Effect.CEILING: "the ideal observer",
}
"""The comparisons of the table `effects`, and the effects that each is corrected with."""


def _group(contrast: Contrast) -> tuple[str, str]:
    return contrast.simulator, TESTED_TOGETHER[contrast.effect]


EFFECTS = ComparisonTable(
    name="effects",
    title="Effects on a system",
    columns=SIDES
    | {"effect": "text", "asks": "text"}
    | RATES
    | {
        "retention": "ratio",
        "retention_low": "ratio",
        "retention_high": "ratio",
        "retention_n": "count",
    }
    | COMPLETE,
    group=_group,
    corrected=(
        "the tests of the same effect in one simulator, with those of sessions and of retrieval as "
        "one effect"
    ),
    note=(
        f"effect: history, against no history (without history, a system with retrieval is the "
        f"system without it); sessions, against {START}; retrieval, against the system without it "
        "under the same condition; interference, two kinds of conditions with equally many "
        "sessions that differ in one property (asks); ideal observer, against the one that has the "
        "same memory and uses all of the evidence that the memory kept. retention: the difference "
        f"to no history divided by that at {START}, with Fieller's interval, computed only if that "
        f"at {START} is above zero with p < {ALPHA}; over the retention n episodes that count "
        f"under no-history, {START} and the condition, which can be fewer than n in incomplete "
        f"cells. {BOTH_SIDES}"
    ),
)


def effects_table(contrasts: Iterable[Contrast]) -> Table:
    """Return the effects among some comparisons, one kind of effect after the other."""
    groups: dict[str, list[Contrast]] = {name: [] for name in TESTED_TOGETHER.values()}
    for contrast in contrasts:
        if contrast.effect in TESTED_TOGETHER:
            groups[TESTED_TOGETHER[contrast.effect]].append(contrast)
    table = comparison_table(EFFECTS, [contrast for group in groups.values() for contrast in group])
    notes = [detectable(group, _group, effect) for effect, group in groups.items()]
    return replace(table, note=" ".join([table.note, *filter(None, notes)]))


def effects_of(
    outcomes: Outcomes, system: str, base: str | None, ceiling: str | None
) -> list[Contrast]:
    """Compare a system's conditions.

    Each `k<n>` is compared with `no-history` and with k0, kinds of conditions as in `COMPARISONS`,
    and under each condition the system with its `base` (the one without retrieval, whose
    `no-history` serves both) and with its `ceiling` (the ideal observer).
    """
    cells = [
        (name, condition)
        for name in (system, base, ceiling)
        if name
        for condition in outcomes.ran(name)
    ]
    at = {cell: place for place, cell in enumerate(cells)}
    ran_in = [outcomes.has_episode[outcomes.systems.index(name)] for name in (system, base) if name]
    here = np.logical_or.reduce(ran_in)
    sides = [outcomes.status[outcomes.cell(*cell)][here] for cell in cells]
    values = np.stack([success(side) for side in sides], axis=1)
    complete = [bool(outcomes.complete[outcomes.cell(*cell)]) for cell in cells]

    ran = outcomes.ran(system)
    ks = [name for name in ran if parse_condition(name).kind.name == "k"]
    later = [name for name in ks if name != START] if START in ks else []
    floors = [(name, NO_HISTORY) for name in (system, base) if name]
    floor = next((cell for cell in floors if cell in at), None)
    effects: dict[tuple[str, tuple[str, str]], Effect] = {}
    if floor:
        effects |= {(name, floor): Effect.HISTORY for name in ks}
    for name in later:
        effects[name, (system, START)] = Effect.SESSIONS
    if base:
        effects |= {(name, (base, name)): Effect.RETRIEVAL for name in ran if (base, name) in at}
        if (base, START) in at:
            effects |= {(name, (base, START)): Effect.RETRIEVAL_FALL for name in later}
    for name, against in comparable(system, ran, floor):
        effects[name, against] = Effect.INTERFERENCE
    if ceiling:
        effects |= {
            (name, (ceiling, name)): Effect.CEILING for name in ran if (ceiling, name) in at
        }

    contrasts = {}
    for (name, against), effect in effects.items():
        first, second = at[against], at[system, name]
        contrasts[name, against] = Contrast(
            outcomes.simulator,
            system,
            name,
            against,
            effect,
            pair(sides[first], sides[second]),
            complete[first] and complete[second],
        )
    # Retention is a share of the lift at k0, so that lift must be significantly above zero.
    lift = contrasts.get((START, floor)) if floor else None
    if floor and lift and lift.pairs.change.value > 0 and lift.pairs.p < ALPHA:
        for name in later:
            three = values[:, [at[floor], at[system, START], at[system, name]]]
            three = three[~np.isnan(three).any(axis=1)]
            history, fall = contrasts[name, floor], contrasts[name, (system, START)]
            kept = retained(three, history.pairs.change, fall.pairs.change)
            contrasts[name, floor] = replace(history, retention=kept, retention_n=len(three))
    return list(contrasts.values())


def retained(values: Floats, lift: Interval, fall: Interval) -> Interval:
    """Return the share of the lift at k0 that is left, with Fieller's interval.

    `values` are success under no-history, k0 and the condition, `(E, 3)`; `lift` is the change from
    no-history, `fall` that from k0. If the condition equals no-history (or k0) in every episode,
    the ratio is 0 (or 1) without variance, and the interval is that of the lift (or the fall)
    divided by the lift at k0.
    """
    none, start, end = values.T
    whole, share = (start - none), (end - none)
    if not len(values) or whole.mean() <= 0:
        return Interval(math.nan)
    ratio = float(share.mean() / whole.mean())
    for exact, reference, change in ((0.0, none, lift), (1.0, start, fall)):
        if (end == reference).all():
            return Interval(exact, *(exact + bound / float(whole.mean()) for bound in change[1:]))
    if len(values) < 2:
        return Interval(ratio)
    spread = np.cov(share, whole) / len(values)
    bounds = fieller(
        float(share.mean()),
        float(whole.mean()),
        (float(spread[0, 0]), float(spread[1, 1])),
        float(spread[0, 1]),
    )
    return Interval(ratio, *bounds)
