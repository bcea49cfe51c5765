"""What conditions do to a system: lift, decay, retention, and how much is noise.

All comparisons are paired: they use the episodes that count under both conditions, and the
episode is what is drawn in the bootstrap.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.bootstrap import (
    DRAWS,
    Interval,
    Resampler,
    Statistic,
    difference,
    retention,
    slope,
)
from robomme_interference_data.evaluate.rows import NO_HISTORY, condition_rank
from robomme_interference_data.evaluate.score.outcomes import SUCCESS, Expected, Outcomes
from robomme_interference_data.evaluate.score.statistics import mcnemar, slope_weights
from robomme_interference_data.evaluate.systems import SYSTEMS

__all__ = ["Contrast", "Effects", "base_of", "effects_of"]

START = "k0"
_NONE = Interval(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Contrast:
    """One paired comparison: what changes from `against` to the condition.

    Attributes:
        simulator: Name of the simulator.
        system: Name of the system.
        condition: Name of the condition.
        against: System and condition that it is compared with.
        n: Episodes that count under both.
        rate: Mean success over them.
        against_rate: The same of `against`.
        change: `rate` − `against_rate` with its bootstrap interval.
        gained: Episodes that succeed only here; with repeats, in those of the lowest model seeds.
        lost: Episodes that succeed only there, likewise.
        p: Of McNemar's exact test on these.
        complete: Whether both cells are complete.
        retention: Under `against` at `no-history`: what is left of the lift at k0.
    """

    simulator: str
    system: str
    condition: str
    against: tuple[str, str]
    n: int
    rate: float
    against_rate: float
    change: Interval
    gained: int
    lost: int
    p: float
    complete: bool
    retention: Interval = _NONE


@dataclass(frozen=True)
class Effects:
    """All comparisons of one system in one simulator.

    Attributes:
        lift: Each condition with history against `no-history`.
        contrasts: Each k against k0, and under each condition a system with retrieval against the
            one without.
        decay: Change of the rate with each doubling of the sessions in the buffer.
        decay_conditions: The conditions that it is computed from.
        decay_episodes: The number of episodes.
        decay_complete: Whether all these cells are complete.
    """

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


class _Columns:
    """The cells that a system's comparisons need, over the same episodes."""

    def __init__(self, one: Outcomes, base: Outcomes | None, expected: Expected):
        self.one = one
        both = [one.episodes] if base is None else [one.episodes, base.episodes]
        self.episodes: NDArray[np.int64] = np.unique(np.concatenate(both))
        self.cells: list[tuple[str, str]] = []
        self.complete: dict[tuple[str, str], bool] = {}
        self.first: list[NDArray[np.int8]] = []
        columns = []
        for outcomes in [one] if base is None else [one, base]:
            for condition in outcomes.conditions:
                column = outcomes.column(condition, self.episodes)
                cell = (outcomes.system, condition)
                counts = self.episodes[~np.isnan(column)]
                self.complete[cell] = np.array_equal(counts, expected.episodes)
                self.cells.append(cell)
                self.first.append(outcomes.first(condition, self.episodes))
                columns.append(column)
        self.values = np.stack(columns, axis=1)

    def place(self, cell: tuple[str, str]) -> int | None:
        return self.cells.index(cell) if cell in self.cells else None

    def contrast(self, here: tuple[str, str], there: tuple[str, str]) -> Contrast:
        a, b = self.cells.index(here), self.cells.index(there)
        values = self.values[~np.isnan(self.values[:, [a, b]]).any(axis=1)]
        one, other = self.first[a], self.first[b]
        known = (one >= 0) & (other >= 0)
        gained = int((known & (one == SUCCESS) & (other != SUCCESS)).sum())
        lost = int((known & (one != SUCCESS) & (other == SUCCESS)).sum())
        return Contrast(
            self.one.simulator,
            *here,
            there,
            len(values),
            float(values[:, a].mean()) if len(values) else math.nan,
            float(values[:, b].mean()) if len(values) else math.nan,
            _NONE,
            gained,
            lost,
            mcnemar(gained, lost) if known.any() else math.nan,
            self.complete[here] and self.complete[there],
        )


def effects_of(
    one: Outcomes, base: Outcomes | None, expected: Expected, draws: int = DRAWS
) -> Effects:
    """Compare a system's conditions with each other.

    Args:
        one: The system.
        base: For a system with retrieval the one without, in the same simulator: its `no-history`
            is both systems'. None if there are no rows of it.
        expected: Episodes of a complete cell.
        draws: Bootstrap samples.
    """
    columns = _Columns(one, base, expected)
    histories = [c for c in one.conditions if c != NO_HISTORY]
    floors = [(name, NO_HISTORY) for name in (one.system, base.system if base else one.system)]
    floor = next((cell for cell in floors if cell in columns.cells), None)
    lift = [columns.contrast((one.system, c), floor) for c in histories] if floor else []
    pairs = [((one.system, c), (one.system, START)) for c in histories if START in histories]
    contrasts = [columns.contrast(*pair) for pair in pairs if pair[0] != pair[1]]
    if base is not None:
        shared = [c for c in one.conditions if c in base.conditions]
        contrasts += [columns.contrast((one.system, c), (base.system, c)) for c in shared]

    at = columns.cells.index
    statistics: list[Statistic] = []
    for found in (*lift, *contrasts):
        statistics.append(difference(at(found.against), at((found.system, found.condition))))
    kept = [c for c in histories if c != START] if floor and START in histories else []
    for condition in kept:
        cells = (floor, (one.system, START), (one.system, condition))
        statistics.append(retention(*(at(cell) for cell in cells if cell)))
    decaying = [at((one.system, c)) for c in histories] if len(histories) > 1 else []
    if decaying:
        weights = slope_weights([condition_rank(c) for c in histories])
        statistics.append(slope(decaying, weights))

    intervals = iter(Resampler(columns.values, one.simulator, draws).intervals(statistics))
    lift = [replace(found, change=next(intervals)) for found in lift]
    contrasts = [replace(found, change=next(intervals)) for found in contrasts]
    retained = {condition: next(intervals) for condition in kept}
    lift = [replace(f, retention=_defined(f, lift, retained)) for f in lift]
    together = ~np.isnan(columns.values[:, decaying]).any(axis=1)
    return Effects(
        tuple(lift),
        tuple(contrasts),
        next(intervals) if decaying else _NONE,
        tuple(histories) if decaying else (),
        int(together.sum()) if decaying else 0,
        all(columns.complete[columns.cells[place]] for place in decaying),
    )


def _defined(
    found: Contrast, lift: Sequence[Contrast], retained: Mapping[str, Interval]
) -> Interval:
    """Return the retention, none where k0 is not surely above no-history: a ratio to nothing."""
    start = next((other for other in lift if other.condition == START), None)
    if found.condition not in retained or start is None or not start.change.low > 0:
        return _NONE
    return retained[found.condition]
