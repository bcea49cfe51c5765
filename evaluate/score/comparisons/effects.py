"""Effects of conditions on a system: lift, retention, kinds of interference, and noise.

All comparisons are paired over the episodes that count under both conditions.
"""

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Outcomes, counting, success
from robomme_interference_data.schema.conditions import NO_HISTORY, parse_condition
from robomme_interference_data.stats.bootstrap import Floats, Interval
from robomme_interference_data.stats.intervals import fieller, wilson
from robomme_interference_data.stats.significance import ALPHA
from robomme_interference_data.viz.tables import Table

from .contrast import START, Contrast, comparable
from .pairs import pair


def effects_of(
    outcomes: Outcomes, system: str, base: str | None, ceiling: str | None
) -> list[Contrast]:
    """Compare a system's conditions.

    Each `k<n>` is compared with `no-history` and with k0, kinds of conditions as in `COMPARISONS`,
    and under each condition the system with its `base` (the one without retrieval, whose
    `no-history` serves both) and with its `ceiling` (the ideal observer).
    """
    cells = [(name, c) for name in (system, base, ceiling) if name for c in outcomes.ran(name)]
    at = {cell: place for place, cell in enumerate(cells)}
    ran_in = [outcomes.has_episode[outcomes.systems.index(s)] for s in (system, base) if s]
    here = np.logical_or.reduce(ran_in)
    sides = [outcomes.status[outcomes.cell(*cell)][here] for cell in cells]
    values = np.stack([success(side) for side in sides], axis=1)
    complete = [bool(outcomes.complete[outcomes.cell(*cell)]) for cell in cells]

    ran = outcomes.ran(system)
    ks = [c for c in ran if parse_condition(c).kind.name == "k"]
    later = [c for c in ks if c != START] if START in ks else []
    floors = ((name, NO_HISTORY) for name in (system, base) if name)
    floor = next((one for one in floors if one in at), None)
    compared = {(c, floor): "lift" for c in ks if floor}
    compared |= {(c, (system, START)): "effects" for c in later}
    compared |= {(c, (base, c)): "effects" for c in ran if base and (base, c) in at}
    compared |= {(c, (base, START)): "equivalence" for c in later if base and (base, START) in at}
    compared |= {(c, other): "interference" for c, other in comparable(system, ran, floor)}
    compared |= {(c, (ceiling, c)): "ceiling" for c in ran if ceiling and (ceiling, c) in at}
    found = {}
    for (c, other), table in compared.items():
        both = at[other], at[system, c]
        pairs = pair(*(sides[place] for place in both))
        whole = all(complete[place] for place in both)
        found[c, other] = Contrast(outcomes.simulator, system, c, other, table, pairs, whole)
    # Retention is a share of the lift at k0, so that lift must be significantly above zero.
    lift = found.get((START, floor)) if floor else None
    if floor and lift and lift.pairs.change.value > 0 and lift.pairs.p < ALPHA:
        for c in later:
            three = values[:, [at[floor], at[system, START], at[system, c]]]
            three = three[~np.isnan(three).any(axis=1)]
            none, start = found[c, floor], found[c, (system, START)].pairs
            kept = retained(three, none.pairs.change, start.change)
            found[c, floor] = replace(none, retention=kept, retention_n=len(three))
    return list(found.values())


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
    for exact, other, change in ((0.0, none, lift), (1.0, start, fall)):
        if (end == other).all():
            return Interval(exact, *(exact + bound / float(whole.mean()) for bound in change[1:]))
    if len(values) < 2:
        return Interval(ratio)
    spread = np.cov(share, whole) / len(values)
    bounds = fieller(
        *(float(share.mean()), float(whole.mean())),
        (float(spread[0, 0]), float(spread[1, 1])),
        float(spread[0, 1]),
    )
    return Interval(ratio, *bounds)


# --- tables ------------------------------------------------------------------------------------


def noise_table(every: Iterable[Outcomes]) -> Table:
    """Return how often two repeats of the same rollout disagree."""
    rows = []
    for outcomes in every:
        for s, c in np.argwhere(outcomes.has_rows).tolist():
            status = outcomes.status[s, c]
            counts = counting(status)
            order = counts.cumsum(axis=-1) * counts  # 1 for the lowest model seed that counts, …
            repeated = (order == 2).any(axis=-1)
            if pairs := int(repeated.sum()):
                one, other = (((order == n) & (status == 0)).any(axis=-1) for n in (1, 2))
                flips = int((one != other)[repeated].sum())
                cell = (outcomes.simulator, outcomes.systems[s], outcomes.conditions[c])
                rows.append((*cell, pairs, flips, flips / pairs, *wilson(flips, pairs)))
    return Table(
        "noise",
        "Flips between repeats",
        {
            "simulator": "text",
            "system": "text",
            "condition": "text",
            "pairs": "count",
            "flips": "count",
            "rate": "rate",
            "low": "rate",
            "high": "rate",
        },
        rows,
        "Repeats differ only in the model seed; in each episode the two lowest that count are "
        "compared. Between conditions, a share of flips (flips in the tables of effects) that does "
        "not exceed this rate is noise. A difference is gained minus lost, so one below this rate "
        "can still be significant: see p.",
    )
