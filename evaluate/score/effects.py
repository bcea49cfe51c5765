"""What conditions do to a system: lift, decay, retention, and how much is noise.

All comparisons are paired: they use the episodes that count under both conditions, and the
episode is what is drawn in the bootstrap.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robomme_interference_data.conditions import NO_HISTORY, parse_condition
from robomme_interference_data.evaluate.score.cube import Cube, counting, success
from robomme_interference_data.evaluate.score.pairs import Pairs, pair, paired_table
from robomme_interference_data.evaluate.systems import SYSTEMS
from robomme_interference_data.stats import (
    DRAWS,
    LEAST,
    Interval,
    Resampler,
    cohens_h,
    difference,
    enough,
    retention,
    slope,
    slope_weights,
    wilson,
)
from robomme_interference_data.tables import Column, Table

__all__ = [
    "START",
    "SURE",
    "Contrast",
    "Effects",
    "base_of",
    "contrast_table",
    "decay_table",
    "effects_of",
    "lift_table",
    "noise_table",
]

START = "k0"
"""The condition that lift, retention and contrasts begin at."""

SURE = 0.05
"""Below this p of McNemar's exact test, a lift is one that retention can be a share of."""

_CELL = (Column("simulator"), Column("system"), Column("condition"))


@dataclass(frozen=True)
class Contrast:
    """One paired comparison: what changes from `against` to the condition.

    Attributes:
        simulator: Name of the simulator.
        system: Name of the system.
        condition: Name of the condition.
        against: System and condition that it is compared with: the first side.
        pairs: The comparison.
        complete: Whether both cells are complete.
        retention: Under `against` at `no-history`: what is left of the lift at k0.
    """

    simulator: str
    system: str
    condition: str
    against: tuple[str, str]
    pairs: Pairs
    complete: bool
    retention: Interval = Interval(math.nan)


@dataclass(frozen=True)
class Effects:
    """All comparisons of one system in one simulator.

    Attributes:
        simulator: Name of the simulator.
        system: Name of the system.
        lift: Each `k<n>` against `no-history`.
        contrasts: Each k against k0, and under each condition a system with retrieval against the
            one without.
        decay: Change of the rate with each doubling of the sessions in the buffer; its interval is
            given where at least ten episodes add to it (see `stats.enough`).
        decay_conditions: The conditions that it is computed from; empty for fewer than two.
        decay_episodes: The number of episodes.
        decay_complete: Whether all these cells are complete.
    """

    simulator: str
    system: str
    lift: tuple[Contrast, ...]
    contrasts: tuple[Contrast, ...]
    decay: Interval
    decay_conditions: tuple[str, ...]
    decay_episodes: int
    decay_complete: bool


def base_of(system: str) -> str | None:
    """Return the system without the retrieval step, None for one that has none."""
    if system not in SYSTEMS or not SYSTEMS[system].retrieval:
        return None
    plain = system.removeprefix("retrieval-")
    return plain if plain in SYSTEMS else f"perceptual-{plain}"


def effects_of(cube: Cube, system: str, base: str | None, draws: int = DRAWS) -> Effects:
    """Compare a system's conditions with each other.

    Conditions of other kinds than the paper's are in no comparison but that with the base.

    Args:
        cube: What came of the rollouts.
        system: Name of the system.
        base: For a system with retrieval the one without: its `no-history` is both systems'. None
            if the two are not paired.
        draws: Bootstrap samples.
    """
    own = cube.ran(system)
    cells = [(system, c) for c in own] + ([(base, c) for c in cube.ran(base)] if base else [])
    at = {cell: place for place, cell in enumerate(cells)}
    here = np.logical_or.reduce([cube.there[cube.systems.index(name)] for name, _ in cells])
    sides = [cube.status[cube.cell(*cell)][here] for cell in cells]
    values = np.stack([success(side) for side in sides], axis=1)

    histories = [c for c in own if parse_condition(c).kind.name == "k"]
    ks = [parse_condition(c).k for c in histories]
    floor = next((cell for cell in ((system, NO_HISTORY), (base, NO_HISTORY)) if cell in at), None)
    lifts = [(c, floor) for c in histories] if floor else []
    start = (system, START) if START in histories else None
    against = [(c, start) for c in histories if c != START] if start else []
    against += [(c, (base, c)) for c in own if base and (base, c) in at]

    statistics = [difference(at[there], at[system, c]) for c, there in (*lifts, *against)]
    kept = {}
    if floor and start:
        kept = {c: (at[floor], at[start], at[system, c]) for c in histories if c != START}
    statistics += [retention(*places) for places in kept.values()]
    decaying = [at[system, c] for c in histories] if len(histories) > 1 else []
    weights = slope_weights(ks) if decaying else np.zeros(0)
    statistics += [slope(decaying, weights)] if decaying else []
    drawn = iter(Resampler(values, cube.simulator, draws).intervals(statistics))

    def contrast(condition: str, there: tuple[str, str]) -> Contrast:
        cell = (system, condition)
        pairs = pair(sides[at[there]], sides[at[cell]], next(drawn))
        complete = bool(cube.complete[cube.cell(*cell)] and cube.complete[cube.cell(*there)])
        return Contrast(cube.simulator, system, condition, there, pairs, complete)

    def together(places: Sequence[int]) -> Any:
        chosen = values[:, list(places)]
        return chosen[~np.isnan(chosen).any(axis=1)]

    lift = [contrast(*one) for one in lifts]
    contrasts = [contrast(*one) for one in against]
    retained = {c: _retained(together(places), next(drawn)) for c, places in kept.items()}
    sure = any(one.condition == START and _is_sure(one.pairs) for one in lift)
    if sure:
        lift = [replace(f, retention=retained.get(f.condition, f.retention)) for f in lift]
    decay, changing = Interval(math.nan), together(decaying)
    if decaying:
        decay = next(drawn)
        decay = decay if enough(changing @ weights) else Interval(decay.value)
    return Effects(
        cube.simulator,
        system,
        tuple(lift),
        tuple(contrasts),
        decay,
        tuple(histories) if decaying else (),
        len(changing),
        all(cube.complete[cube.cell(*cells[place])] for place in decaying),
    )


def _is_sure(lift: Pairs) -> bool:
    """Whether a lift is above zero beyond doubt: else retention is a ratio to nothing."""
    return lift.change.value > 0 and lift.p < SURE


def _retained(values: Any, drawn: Interval) -> Interval:
    """Give a retention its interval, if any two of its three conditions differ enough.

    Where two hardly differ, the ratio sticks to 0 or 1 in most draws, or divides by next to
    nothing.
    """
    pairs = [values[:, i] - values[:, j] for i, j in ((1, 0), (2, 0), (2, 1))]
    if all(map(enough, pairs)) and drawn.low < drawn.high:
        return drawn
    return Interval(drawn.value)


# --- tables ------------------------------------------------------------------------------------


def lift_table(effects: Iterable[Effects]) -> Table:
    """Return each condition's lift over the system's own rate without history."""
    found = [
        (
            (c.simulator, c.system, c.condition, c.against[0]),
            c.pairs,
            (c.retention.value, c.retention.low, c.retention.high, c.complete),
        )
        for one in effects
        for c in one.lift
    ]
    table = paired_table(
        "lift",
        "Lift over no history",
        (*_CELL, Column("no_history_of")),
        found,
        "Over the n episodes that count on both sides.",
        {"rate": "second", "no_history_rate": "first"},
        change="lift",
        more=(
            *(Column("retention", "ratio"), Column("retention_low", "ratio")),
            *(Column("retention_high", "ratio"), Column("complete", "flag")),
        ),
    )
    return replace(
        table,
        note=f"{table.note} retention: lift divided by the lift at k0, where that one is above "
        f"zero with p < {SURE}; its BCa interval, where any two of no-history, k0 and the "
        f"condition differ in at least {LEAST} episodes. A system with retrieval is, without "
        "history, the system without it.",
    )


def contrast_table(effects: Iterable[Effects]) -> Table:
    """Return effect sizes between conditions, and of retrieval."""
    found = [
        (
            (c.simulator, c.system, c.condition, *c.against),
            c.pairs,
            (cohens_h(c.pairs.second, c.pairs.first) if c.pairs.n else math.nan, c.complete),
        )
        for one in effects
        for c in one.contrasts
    ]
    return paired_table(
        "effects",
        "Effects between conditions",
        (*_CELL, Column("against_system"), Column("against_condition")),
        found,
        "Over the n episodes that count on both sides.",
        {"rate": "second", "against_rate": "first"},
        more=(Column("cohens_h", "ratio"), Column("complete", "flag")),
    )


def decay_table(effects: Iterable[Effects]) -> Table:
    """Return each system's log-linear decay over the sessions in the buffer."""
    columns = (
        *(Column("simulator"), Column("system"), Column("conditions"), Column("n", "count")),
        *(Column("slope", "points"), Column("low", "points"), Column("high", "points")),
        Column("complete", "flag"),
    )
    rows = [
        (
            *(one.simulator, one.system, " ".join(one.decay_conditions), one.decay_episodes),
            *(one.decay.value, one.decay.low, one.decay.high, one.decay_complete),
        )
        for one in effects
        if one.decay_conditions
    ]
    note = (
        "slope: change of the success rate with each doubling of the sessions in the buffer, the "
        "lesson included: the least-squares line over log2(k + 1). 95% BCa bootstrap interval, "
        f"clustered by episode, where at least {LEAST} episodes add to the slope."
    )
    return Table("decay", "Decay over sessions", columns, tuple(rows), note)


def noise_table(cubes: Iterable[Cube]) -> Table:
    """Return how often two repeats of the same rollout disagree, where there are repeats."""
    columns = (
        *_CELL,
        *(Column("pairs", "count"), Column("flips", "count")),
        *(Column("rate", "rate"), Column("low", "rate"), Column("high", "rate")),
    )
    rows = []
    for cube in cubes:
        for s, c in np.argwhere(cube.has_rows).tolist():
            status = cube.status[s, c]
            counts = counting(status)
            order = counts.cumsum(axis=-1) * counts  # 1 for the lowest model seed that counts, …
            repeated = (order == 2).any(axis=-1)
            if pairs := int(repeated.sum()):
                one, other = (((order == n) & (status == 0)).any(axis=-1) for n in (1, 2))
                flips = int((one != other)[repeated].sum())
                cell = (cube.simulator, cube.systems[s], cube.conditions[c].name)
                rows.append((*cell, pairs, flips, flips / pairs, *wilson(flips, pairs)))
    note = (
        "Repeats differ in the model seed alone; in each episode the two lowest that count are "
        "compared. A share of flips between conditions (flips in the tables of effects) that is "
        "not above this rate is noise. A flip rate is gross, a difference is net, gained less "
        "lost: one that is smaller than this rate can still be real, and p tells."
    )
    return Table("noise", "Flips between repeats", columns, tuple(rows), note)
