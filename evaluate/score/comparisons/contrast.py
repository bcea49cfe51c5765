"""What is compared with what: one comparison, and which kinds of conditions make one."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from robomme_interference_data.schema.conditions import KINDS, NO_HISTORY, parse_condition
from robomme_interference_data.stats.bootstrap import Interval

from .pairs import Pairs

START = "k0"
"""The condition that retention and contrasts begin at."""


class Comparison(NamedTuple):
    """The kind that another is compared with, the first side, and what that measures."""

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
}
"""Kind to what its conditions are compared for with equally many sessions, as tables order it."""


NO_RETENTION = Interval(math.nan)


@dataclass(frozen=True)
class Contrast:
    """One comparison: what changes from `against` to the condition.

    Attributes:
        simulator, system, condition: Their names.
        against: System and condition that it is compared with: the first side.
        table: Name of the table that it is in (see `tables.SPECS`).
        pairs: The comparison.
        complete: Whether both cells are complete.
        family: The only family whose episodes are compared; empty for all.
        retention: Of a lift: what is left at the condition of the lift at k0.
        retention_n: Episodes that count under all three conditions, of which retention is.
    """

    simulator: str
    system: str
    condition: str
    against: tuple[str, str]
    table: str
    pairs: Pairs
    complete: bool
    family: str = ""
    retention: Interval = NO_RETENTION
    retention_n: int | None = None

    @property
    def asks(self) -> str:
        """What a comparison of two kinds of conditions measures; empty for any other."""
        kind = parse_condition(self.condition).kind.name
        return COMPARISONS[kind].asks if self.table == "interference" else ""


def comparable(
    system: str, conditions: Iterable[str], floor: tuple[str, str] | None
) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield each condition that `COMPARISONS` has, with the system and condition it is against.

    `floor` is the system and condition that are the system's `no-history`, if there is one.
    """
    own = [parse_condition(name) for name in conditions]
    cells = {(one.kind.name, one.k): (system, one.name) for one in own}
    cells |= {(NO_HISTORY, 0): floor} if floor else {}
    for one in own:
        if comparison := COMPARISONS.get(one.kind.name):
            k = one.k if KINDS[comparison.reference].counted else 0
            if against := cells.get((comparison.reference, k)):
                yield one.name, against
