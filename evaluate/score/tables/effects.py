"""Effects of conditions on a system: of history, sessions, retrieval and kinds of interference.

All comparisons are paired over the episodes that count under both conditions.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Flags, Outcomes, counting, success
from robomme_interference_data.evaluate.score.partners import share_weights
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
from .contrast import LESSON_ONLY, Contrast, Effect, Scope, comparable
from .pairs import compare_cells, shared_runs

TESTED_TOGETHER = {
    Effect.HISTORY: "history",
    Effect.SESSIONS: "sessions and retrieval",
    Effect.RETRIEVAL: "sessions and retrieval",
    Effect.INTERFERENCE: "interference",
    Effect.CEILING: "the ideal observer",
}
"""The comparisons of the table `effects`, and the effects that each is corrected with."""


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
    | {"primary": "flag"}
    | COMPLETE,
    corrected=(
        "the tests of the primary analysis in one simulator (primary: k7 against k0 of each "
        "system, and the table interaction), and for the others, which are exploratory, among "
        "those of the same effect, with sessions and retrieval as one effect"
    ),
    note=(
        "effect: history, against no history (without history, a system with retrieval is the "
        f"system without it); sessions, against {LESSON_ONLY}; retrieval, against the system "
        "without it "
        "under the same condition; interference, two kinds of conditions with equally many "
        "sessions that differ in one property (asks); ideal observer, against the one that has the "
        "same memory and uses all of the evidence that the memory kept. retention: the difference "
        f"to no history divided by that at {LESSON_ONLY}, with Fieller's interval, computed only "
        "if that "
        f"at {LESSON_ONLY} is above zero with p < {ALPHA}; over the retention n episodes that "
        "count "
        f"under no-history, {LESSON_ONLY} and the condition, which can be fewer than n in "
        "incomplete "
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
    notes = []
    for effect, group in groups.items():
        exploratory = [contrast for contrast in group if not contrast.primary]
        notes.append(detectable(exploratory or group, effect))
    return replace(table, note=" ".join([table.note, *filter(None, notes)]))


class _Compared(NamedTuple):
    """Two cells, each a system and a condition, and what their comparison measures."""

    against: tuple[str, str]
    cell: tuple[str, str]
    effect: Effect


def effects_of(
    outcomes: Outcomes, system: str, base: str | None, ceiling: str | None
) -> list[Contrast]:
    """Compare a system's conditions.

    Each `k<n>` is compared with `no-history` and with k0, kinds of conditions as in `COMPARISONS`,
    and under each condition the system with its `base` (the one without retrieval, whose
    `no-history` serves both) and with its `ceiling` (the ideal observer).
    """
    floor = _floor(outcomes, system, base)
    # A comparison that is listed twice is that of the last effect.
    compared = {(pair.cell, pair.against): pair for pair in _compared(outcomes, system, floor)}
    for pair in _partners(outcomes, system, base, ceiling):
        compared[pair.cell, pair.against] = pair
    here = outcomes.has_episode[outcomes.systems.index(system)]
    if base:
        here = here | outcomes.has_episode[outcomes.systems.index(base)]
    contrasts = {key: _contrast(outcomes, pair, here) for key, pair in compared.items()}
    if floor:
        _add_retention(outcomes, system, floor, here, contrasts)
    return list(contrasts.values())


def _floor(outcomes: Outcomes, system: str, base: str | None) -> tuple[str, str] | None:
    """Return the cell without history: of the system, or else of its base."""
    for name in (system, base):
        if name and NO_HISTORY in outcomes.ran(name):
            return name, NO_HISTORY
    return None


def _counted(outcomes: Outcomes, system: str) -> list[str]:
    """Return the `k<n>` under which a system has rows."""
    return [name for name in outcomes.ran(system) if parse_condition(name).kind.name == "k"]


def _compared(
    outcomes: Outcomes, system: str, floor: tuple[str, str] | None
) -> Iterator[_Compared]:
    """Yield the comparisons between conditions of a system."""
    ks = _counted(outcomes, system)
    if floor:
        for condition in ks:
            yield _Compared(floor, (system, condition), Effect.HISTORY)
    if LESSON_ONLY in ks:
        for condition in ks:
            if condition != LESSON_ONLY:
                yield _Compared((system, LESSON_ONLY), (system, condition), Effect.SESSIONS)
    for condition, against in comparable(system, outcomes.ran(system), floor):
        yield _Compared(against, (system, condition), Effect.INTERFERENCE)


def _partners(
    outcomes: Outcomes, system: str, base: str | None, ceiling: str | None
) -> Iterator[_Compared]:
    """Yield the comparisons of a system with the one without retrieval, and the ideal observer."""
    ran = outcomes.ran(system)
    for partner, effect in ((base, Effect.RETRIEVAL), (ceiling, Effect.CEILING)):
        for condition in ran:
            if partner and condition in outcomes.ran(partner):
                yield _Compared((partner, condition), (system, condition), effect)
    if base and LESSON_ONLY in ran and LESSON_ONLY in outcomes.ran(base):
        for condition in _counted(outcomes, system):
            if condition != LESSON_ONLY:
                yield _Compared((base, LESSON_ONLY), (system, condition), Effect.RETRIEVAL_FALL)


def _contrast(outcomes: Outcomes, compared: _Compared, here: Flags) -> Contrast:
    """Compare two cells over the episodes `here`."""
    against, cell = outcomes.cell(*compared.against), outcomes.cell(*compared.cell)
    system, condition = compared.cell
    complete = bool(outcomes.complete[against] and outcomes.complete[cell])
    if system == compared.against[0]:  # a run of one condition alone is left out
        ran = [counting(outcomes.status[at]).any(axis=0) for at in (against, cell)]
        runs, others = (set(outcomes.training[side].tolist()) for side in ran)
        complete = complete and runs == others
    return Contrast(
        outcomes.simulator,
        system,
        condition,
        compared.against,
        compared.effect,
        compare_cells(
            outcomes.status[against][here],
            outcomes.status[cell][here],
            outcomes.training,
            same_weights=share_weights(outcomes, system, compared.against[0]),
        ),
        complete,
        group=TESTED_TOGETHER.get(compared.effect, compared.effect),
    )


def _add_retention(
    outcomes: Outcomes,
    system: str,
    floor: tuple[str, str],
    here: Flags,
    contrasts: dict[tuple[tuple[str, str], tuple[str, str]], Contrast],
) -> None:
    """Add the share of the lift at k0 that is left, which must be significantly above zero."""
    start = (system, LESSON_ONLY)
    lift = contrasts.get((start, floor))
    if lift is None or not (lift.pairs.change.value > 0 and lift.pairs.p < ALPHA):
        return
    for (cell, against), fall in list(contrasts.items()):
        if fall.effect is not Effect.SESSIONS or against != start:
            continue
        sides = [outcomes.status[outcomes.cell(*at)][here] for at in (floor, start, cell)]
        shared = shared_runs(sides, outcomes.training)
        values = np.stack([success(side[:, shared]) for side in sides], axis=1)
        values = values[~np.isnan(values).any(axis=1)]
        history = contrasts[cell, floor]
        kept = retained(values, history.pairs.change, fall.pairs.change)
        if history.scope is Scope.TRAINING:  # Fieller's interval is one for fixed training runs
            kept = Interval(kept.value)
        contrasts[cell, floor] = replace(history, retention=kept, retention_n=len(values))


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
