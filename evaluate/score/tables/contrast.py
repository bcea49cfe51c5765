"""One comparison, what it is for, and which kinds of conditions are compared with which."""

import math
from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple

from robomme_interference_data.schema.conditions import KINDS, NO_HISTORY, parse_condition
from robomme_interference_data.stats.bootstrap import Interval
from robomme_interference_data.stats.runs import MIN_RUNS
from robomme_interference_data.stats.signs import simultaneous

from .pairs import Pairs

LESSON_ONLY = "k0"
"""The condition that changes and retention are measured from."""


class Effect(StrEnum):
    """What a comparison measures; in tables, the value of the column `effect`."""

    HISTORY = "history"  # against no history: the lift
    SESSIONS = "sessions"  # `k<n>` against k0 of the same system
    RETRIEVAL = "retrieval"  # with retrieval against without, under the same condition
    INTERFERENCE = "interference"  # two kinds of conditions, see `COMPARISONS`
    CEILING = "ideal observer"  # against the ideal observer with the same memory
    RETRIEVAL_FALL = "retrieval against k0"  # with retrieval against k0 without, for equivalence
    SYSTEMS = "systems"  # two systems under one condition
    SLOPES = "slopes"  # the falls of two systems over k
    RUNS = "runs"  # two runs, or two conditions of a run: the command `compare`


class Measure(StrEnum):
    """What a comparison compares."""

    SUCCESS = "success"
    ACTION_ERROR = "action error"  # along recordings; lower is better


class Verdict(StrEnum):
    """What a comparison shows, after correction."""

    SHOWN = "shown"
    NOT_SHOWN = "not shown"
    DEPENDS = "depends on errors"  # another verdict if all errors were failures, or successes


class Scope(StrEnum):
    """What intervals and tests hold for, beside other episodes."""

    TRAINING = "training runs"  # other runs of the same training
    CHECKPOINT = "checkpoint"  # these weights alone


def scope_of(runs: int) -> Scope:
    """Return what holds with a number of training runs."""
    return Scope.TRAINING if runs >= MIN_RUNS else Scope.CHECKPOINT


class Comparison(NamedTuple):
    """The kind of condition that another kind is compared with, and what that measures."""

    reference: str
    asks: str


COMPARISONS = {
    "k": Comparison("held", "content beyond dilution"),
    "before": Comparison("k", "order"),
    "middle": Comparison("k", "position"),
    "same": Comparison("k", "similarity"),
    "parts": Comparison("k", "scattered evidence"),
    "raw": Comparison("k", "full rate"),
    "absent": Comparison(NO_HISTORY, "false memory"),
    "stale": Comparison("k", "updating"),
    "misled": Comparison(NO_HISTORY, "belief"),
    "day": Comparison("day-cut", "borders"),
    "day-cut": Comparison("day-alone", "the rest of the day"),
}
"""Kind of condition to its comparison, with equally many sessions; in the order of tables."""


NO_RETENTION = Interval(math.nan)


@dataclass(frozen=True)
class Contrast:
    """One comparison: the change from `against` to the system and condition."""

    simulator: str
    system: str
    condition: str
    against: tuple[str, str]  # system and condition of the first side
    effect: Effect
    pairs: Pairs
    complete: bool  # whether both cells are
    measure: Measure = Measure.SUCCESS
    family: str = ""  # the only family whose episodes are compared; empty for all
    retention: Interval = NO_RETENTION  # of a lift: the share of the lift at k0 that is left
    retention_n: int | None = None  # episodes that count under all three conditions
    columns: Mapping[str, Any] = field(default_factory=dict)  # values that a single table adds
    group: Hashable = ""  # comparisons with the same one are corrected together
    primary: bool = False  # whether it is part of the primary analysis
    # Set by `correction.correct`:
    tests: int = 1  # comparisons of the group
    p_holm: float = math.nan  # corrected within the group
    verdict: Verdict | None = None  # None without a p-value

    @property
    def joint(self) -> Interval:
        """The difference, with an interval that holds with all others of the group at once."""
        return self.pairs.at(simultaneous(self.tests))

    @property
    def runs(self) -> int:
        """Training runs of the side with fewer."""
        return self.pairs.spread.runs

    @property
    def scope(self) -> Scope:
        """What interval and test hold for."""
        return scope_of(self.runs)

    @property
    def if_failures(self) -> float:
        """The difference if every error were a failure."""
        return (self.pairs.if_failures or self.pairs).change.value

    @property
    def if_successes(self) -> float:
        """The difference if every error were a success."""
        return (self.pairs.if_successes or self.pairs).change.value

    @property
    def asks(self) -> str:
        """What a comparison between kinds of conditions measures; empty for any other."""
        if self.effect is not Effect.INTERFERENCE:
            return ""
        return COMPARISONS[parse_condition(self.condition).kind.name].asks


def comparable(
    system: str, conditions: Iterable[str], floor: tuple[str, str] | None
) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield each condition in `COMPARISONS`, with the system and condition it is compared with.

    `floor` is the system and condition that serve as the system's `no-history`, if there are any.
    """
    parsed = [parse_condition(name) for name in conditions]
    cells = {(condition.kind.name, condition.k): (system, condition.name) for condition in parsed}
    if floor:
        cells[NO_HISTORY, 0] = floor
    for condition in parsed:
        comparison = COMPARISONS.get(condition.kind.name)
        if comparison is None:
            continue
        k = condition.k if KINDS[comparison.reference].counted else 0
        against = cells.get((comparison.reference, k))
        if against:
            yield condition.name, against
