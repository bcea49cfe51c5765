"""One comparison, and which kinds of conditions are compared with which."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from robomme_interference_data.schema.conditions import KINDS, NO_HISTORY, parse_condition
from robomme_interference_data.stats.bootstrap import Interval

from .pairs import Pairs

START = "k0"
"""The condition that changes and retention are measured from."""


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
    table: str  # the table that lists it, see `tables.SPECS`
    pairs: Pairs
    complete: bool  # whether both cells are
    family: str = ""  # the only family whose episodes are compared; empty for all
    retention: Interval = NO_RETENTION  # of a lift: the share of the lift at k0 that is left
    retention_n: int | None = None  # episodes that count under all three conditions
    more: Mapping[str, Any] = field(default_factory=dict)  # columns of a single table

    @property
    def asks(self) -> str:
        """What a comparison between kinds of conditions measures; empty for any other."""
        kind = parse_condition(self.condition).kind.name
        return COMPARISONS[kind].asks if self.table == "interference" else ""


def comparable(
    system: str, conditions: Iterable[str], floor: tuple[str, str] | None
) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield each condition in `COMPARISONS`, with the system and condition it is compared with.

    `floor` is the system and condition that serve as the system's `no-history`, if there are any.
    """
    parsed = [parse_condition(name) for name in conditions]
    cells = {(one.kind.name, one.k): (system, one.name) for one in parsed}
    cells |= {(NO_HISTORY, 0): floor} if floor else {}
    for one in parsed:
        if comparison := COMPARISONS.get(one.kind.name):
            k = one.k if KINDS[comparison.reference].counted else 0
            if against := cells.get((comparison.reference, k)):
                yield one.name, against
