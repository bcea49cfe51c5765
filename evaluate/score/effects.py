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
    enough,
    retention,
    slope,
)
from robomme_interference_data.evaluate.rows import NO_HISTORY, condition_rank
from robomme_interference_data.evaluate.score.outcomes import Expected, Outcomes
from robomme_interference_data.evaluate.score.paired import (
    Side,
    Tested,
    interval_of,
    pairs_of,
    tested,
)
from robomme_interference_data.evaluate.score.statistics import slope_weights
from robomme_interference_data.evaluate.systems import SYSTEMS

__all__ = ["Contrast", "Effects", "base_of", "effects_of"]

START = "k0"
SURE = 0.05
"""Below this p of McNemar's exact test, a lift is one that retention can be a share of."""
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
        test: McNemar's exact test: gained are pairs that succeed only here.
        complete: Whether both cells are complete.
        change: `rate` − `against_rate` with its interval.
        interval: Kind of that interval (see `paired.interval_of`).
        retention: Under `against` at `no-history`: what is left of the lift at k0.
    """

    simulator: str
    system: str
    condition: str
    against: tuple[str, str]
    n: int
    rate: float
    against_rate: float
    test: Tested
    complete: bool
    change: Interval = _NONE
    interval: str = ""
    retention: Interval = _NONE


@dataclass(frozen=True)
class Effects:
    """All comparisons of one system in one simulator.

    Attributes:
        lift: Each condition with history against `no-history`.
        contrasts: Each k against k0, and under each condition a system with retrieval against the
            one without.
        decay: Change of the rate with each doubling of the sessions in the buffer; its interval is
            given where at least ten episodes add to it (see `bootstrap.enough`).
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
        self.once: list[NDArray[np.bool_]] = []
        self.sides: list[Side] = []
        columns = []
        for outcomes in [one] if base is None else [one, base]:
            for condition in outcomes.conditions:
                column = outcomes.column(condition, self.episodes)
                cell = (outcomes.system, condition)
                self.complete[cell] = outcomes.complete(condition, expected)
                self.cells.append(cell)
                self.once.append(outcomes.once(condition, self.episodes))
                self.sides.append(Side(outcomes, condition))
                columns.append(column)
        self.values = np.stack(columns, axis=1)

    def together(self, places: Sequence[int]) -> NDArray[np.bool_]:
        """Whether each episode counts in all of these cells."""
        return np.asarray(~np.isnan(self.values[:, list(places)]).any(axis=1))

    def contrast(self, here: tuple[str, str], there: tuple[str, str]) -> Contrast:
        a, b = self.cells.index(here), self.cells.index(there)
        values = self.values[self.together([a, b])]
        return Contrast(
            self.one.simulator,
            *here,
            there,
            len(values),
            float(values[:, a].mean()) if len(values) else math.nan,
            float(values[:, b].mean()) if len(values) else math.nan,
            tested(pairs_of(self.sides[b], self.sides[a])),
            self.complete[here] and self.complete[there],
        )

    def bounded(self, found: Contrast, drawn: Interval) -> Contrast:
        """Give a comparison the interval that its data bear."""
        places = [self.cells.index(c) for c in (found.against, (found.system, found.condition))]
        known = self.together(places)
        once = np.logical_and(*(self.once[place] for place in places))
        values = self.values[known][:, places]
        change, kind = interval_of(values, bool(once[known].all()), drawn)
        return replace(found, change=change, interval=kind)

    def retained(self, places: Sequence[int], drawn: Interval) -> Interval:
        """Give a retention its interval, if any two of its three conditions differ enough.

        Where two hardly differ, the ratio sticks to 0 or 1 in most draws, or divides by next to
        nothing.
        """
        values = self.values[self.together(places)][:, list(places)]
        pairs = [values[:, i] - values[:, j] for i, j in ((1, 0), (2, 0), (2, 1))]
        if all(map(enough, pairs)) and drawn.low < drawn.high:
            return drawn
        return Interval(drawn.value, math.nan, math.nan)


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
    kept: dict[str, tuple[int, int, int]] = {}
    if floor and START in histories:
        ends = (at(floor), at((one.system, START)))
        kept = {c: (*ends, at((one.system, c))) for c in histories if c != START}
    statistics += [retention(*places) for places in kept.values()]
    decaying = [at((one.system, c)) for c in histories] if len(histories) > 1 else []
    weights = slope_weights([condition_rank(c) for c in histories]) if decaying else np.zeros(0)
    if decaying:
        statistics.append(slope(decaying, weights))

    intervals = iter(Resampler(columns.values, one.simulator, draws).intervals(statistics))
    lift = [columns.bounded(found, next(intervals)) for found in lift]
    contrasts = [columns.bounded(found, next(intervals)) for found in contrasts]
    retained = {c: columns.retained(places, next(intervals)) for c, places in kept.items()}
    lift = [replace(f, retention=_defined(f, lift, retained)) for f in lift]
    together = columns.together(decaying)
    decay = next(intervals) if decaying else _NONE
    if not enough(columns.values[together][:, decaying] @ weights):
        decay = Interval(decay.value, math.nan, math.nan)
    return Effects(
        tuple(lift),
        tuple(contrasts),
        decay,
        tuple(histories) if decaying else (),
        int(together.sum()) if decaying else 0,
        all(columns.complete[columns.cells[place]] for place in decaying),
    )


def _defined(
    found: Contrast, lift: Sequence[Contrast], retained: Mapping[str, Interval]
) -> Interval:
    """Return the retention, none where k0 is not surely above no-history: a ratio to nothing.

    Surely means a lift above zero with p < 0.05 in McNemar's exact test.
    """
    start = next((other for other in lift if other.condition == START), None)
    if found.condition not in retained or start is None:
        return _NONE
    if not (start.change.value > 0 and start.test.p < SURE):
        return _NONE
    return retained[found.condition]
