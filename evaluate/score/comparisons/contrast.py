"""What is compared with what: one comparison, and which kinds of conditions make one."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from robomme_interference_data.schema.conditions import KINDS, NO_HISTORY, parse_condition
from robomme_interference_data.stats.bootstrap import Interval

from .pairs import Pairs

START = "k0"
"""The condition that retention and contrasts begin at."""


@dataclass(frozen=True)
class Comparison:
    """Two kinds of conditions that are compared, with equally many sessions.

    Attributes:
        kind: Name of the kind whose conditions are compared.
        reference: Name of the kind that they are compared with: the first side.
        asks: What the comparison measures.
    """

    kind: str
    reference: str
    asks: str


_COMPARISONS = (
    Comparison("k", "held", "content beyond dilution"),
    Comparison("before", "k", "order"),
    Comparison("middle", "k", "position"),
    Comparison("same", "k", "similarity"),
    Comparison("parts", "k", "scattered evidence"),
    Comparison("raw", "k", "full rate"),
    Comparison("absent", NO_HISTORY, "false memory"),
    Comparison("stale", "k", "updating"),
    Comparison("misled", NO_HISTORY, "belief"),
)

COMPARISONS: dict[str, Comparison] = {one.kind: one for one in _COMPARISONS}
"""Kind to what its conditions are compared for, in the order of tables."""


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

    Args:
        system: Name of a system.
        conditions: Those under which it has rows.
        floor: The system and condition that are its `no-history`, if there is one.
    """
    own = [parse_condition(name) for name in conditions]
    cells = {(one.kind.name, one.k): (system, one.name) for one in own}
    cells |= {(NO_HISTORY, 0): floor} if floor else {}
    for one in own:
        if comparison := COMPARISONS.get(one.kind.name):
            k = one.k if KINDS[comparison.reference].counted else 0
            if against := cells.get((comparison.reference, k)):
                yield one.name, against
