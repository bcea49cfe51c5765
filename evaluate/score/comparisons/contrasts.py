"""What is compared with what, episode by episode, and the tables of it."""

import math
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.evaluate.score import power
from robomme_interference_data.schema.conditions import KINDS, NO_HISTORY, parse_condition
from robomme_interference_data.stats.bootstrap import Interval
from robomme_interference_data.stats.intervals import cohens_h
from robomme_interference_data.stats.significance import SURE
from robomme_interference_data.viz.tables import Table

from .pairs import COLUMNS, Pairs, how_to_read, tested

START = "k0"
"""The condition that retention and contrasts begin at."""


WITHIN = ("systems", "matrix")
"""Tables whose tests are corrected within each condition."""


@dataclass(frozen=True)
class Question:
    """What two kinds of conditions, with equally many sessions, are compared for.

    Attributes:
        kind: Name of the kind whose conditions are compared.
        against: Name of the kind that they are compared with: the first side.
        asks: What is asked by it.
    """

    kind: str
    against: str
    asks: str


_QUESTIONS = (
    Question("k", "held", "content beyond dilution"),
    Question("before", "k", "order"),
    Question("middle", "k", "position"),
    Question("same", "k", "similarity"),
    Question("parts", "k", "scattered evidence"),
    Question("raw", "k", "full rate"),
    Question("absent", NO_HISTORY, "false memory"),
    Question("stale", "k", "updating"),
    Question("misled", NO_HISTORY, "belief"),
)

QUESTIONS: dict[str, Question] = {one.kind: one for one in _QUESTIONS}
"""Kind to what its conditions are compared for, in the order of tables."""


NO_RETENTION = Interval(math.nan)


@dataclass(frozen=True)
class Contrast:
    """One paired comparison: what changes from `against` to the condition.

    Attributes:
        simulator, system, condition: Their names.
        against: System and condition that it is compared with: the first side.
        table: Name of the table that it stands in: `lift`, or one of `contrast_table`.
        pairs: The comparison.
        complete: Whether both cells are complete.
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
    retention: Interval = NO_RETENTION
    retention_n: int | None = None

    @property
    def tested(self) -> tuple[Pairs, Hashable, bool]:
        """The comparison, what it is corrected together with, and whether it is complete."""
        within = self.condition if self.table in WITHIN else ""
        return self.pairs, (self.simulator, within), self.complete

    @property
    def asks(self) -> str:
        """What is asked by a comparison of two kinds of conditions; empty for any other."""
        kind = parse_condition(self.condition).kind.name
        return QUESTIONS[kind].asks if self.table == "interference" else ""


def asked(
    system: str, conditions: Iterable[str], floor: tuple[str, str] | None
) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield each condition that a question is about, with the system and condition it is against.

    Args:
        system: Name of a system.
        conditions: Those under which it has rows.
        floor: The system and condition that are its `no-history`, if there is one.
    """
    own = [parse_condition(name) for name in conditions]
    cells = {(one.kind.name, one.k): (system, one.name) for one in own}
    cells |= {(NO_HISTORY, 0): floor} if floor else {}
    for one in own:
        if question := QUESTIONS.get(one.kind.name):
            k = one.k if KINDS[question.against].counted else 0
            if there := cells.get((question.against, k)):
                yield one.name, there


_TOGETHER = "the tests of this table in one simulator"
_WITHIN = "the tests of a condition in one simulator"


# --- tables ------------------------------------------------------------------------------------


def _of_table(
    contrasts: Iterable[Contrast], name: str
) -> tuple[list[Contrast], list[tuple[Any, ...]], str]:
    """Return a table's comparisons, values of each row, and how these are to be read.

    The values are n, both sides, the difference and those of `COLUMNS` (see `tested`).
    """
    found = [one for one in contrasts if one.table == name]
    tests = [one.tested for one in found]
    sides = [(one.pairs.n, one.pairs.second, one.pairs.first) for one in found]
    values = [(*side, *test) for side, test in zip(sides, tested(tests), strict=True)]
    return found, values, how_to_read(tests, _WITHIN if name in WITHIN else _TOGETHER)


def lift_table(contrasts: Iterable[Contrast]) -> Table:
    """Return each condition's lift over the system's own rate without history."""
    found, tests, read = _of_table(contrasts, "lift")
    rows = [
        (
            *(c.simulator, c.system, c.condition, c.against[0]),
            *(*test, *c.retention, c.retention_n, c.complete),
        )
        for c, test in zip(found, tests, strict=True)
    ]
    return Table.make(
        "lift",
        "Lift over no history",
        "simulator system condition no_history_of n:count rate:rate no_history_rate:rate "
        f"lift:points {COLUMNS} retention:ratio retention_low:ratio retention_high:ratio "
        "retention_n:count complete:flag",
        rows,
        f"Over the n episodes that count on both sides. {read} retention: lift divided by the lift "
        f"at k0, where that one is above zero with p < {SURE}, with Fieller's interval; of the "
        "retention_n episodes that count under no-history, k0 and the condition, which of cells "
        "that are not complete can be fewer than n. A system with retrieval is, without history, "
        f"the system without it.{power.note(one.pairs for one in found)}",
    )


_CONTRASTS = {
    "effects": ("Effects between conditions", ""),
    "interference": (
        "Which interference hurts",
        "Two kinds of conditions with equally many sessions, which differ in what is asked. ",
    ),
    "ceiling": (
        "Gap to the ceiling",
        "The ceiling is the ideal observer with the same memory: it uses all of the evidence that "
        "the memory kept. ",
    ),
    "systems": (
        "Difference to the best system",
        "Within each condition, complete cells against that of the highest rate, of equal ones the "
        "first. ",
    ),
    "matrix": ("All pairs of systems", "Within each condition, of complete cells. "),
}


def contrast_table(contrasts: Iterable[Contrast], name: str) -> Table:
    """Return effect sizes as a table of `_CONTRASTS`."""
    title, note = _CONTRASTS[name]
    found, tests, read = _of_table(contrasts, name)
    asks = any(one.asks for one in found)
    rows = [
        (
            *(c.simulator, c.system, c.condition, *c.against),
            *([c.asks] if asks else []),
            *test,
            *(cohens_h(c.pairs.second, c.pairs.first) if c.pairs.n else math.nan, c.complete),
        )
        for c, test in zip(found, tests, strict=True)
    ]
    return Table.make(
        name,
        title,
        f"simulator system condition against_system against_condition {'asks' if asks else ''} "
        f"n:count rate:rate against_rate:rate difference:points {COLUMNS} cohens_h:ratio "
        "complete:flag",
        rows,
        f"{note}Over the n episodes that count on both sides. {read}"
        f"{power.note(one.pairs for one in found)}",
    )


def interaction_table(contrasts: Iterable[Contrast]) -> Table:
    """Return how the change from k0 differs between systems (see `interaction`)."""
    found, tests, _ = _of_table(contrasts, "interaction")
    rows = [
        (c.simulator, c.system, c.condition, c.against[0], *test, c.complete)
        for c, test in zip(found, tests, strict=True)
    ]
    return Table.make(
        "interaction",
        "Which system falls more",
        "simulator system condition against_system n:count change:points against_change:points "
        f"difference:points {COLUMNS} complete:flag",
        rows,
        f"change: rate under the condition − rate at {START}; difference: of the changes, positive "
        "where the system falls less than the other one, which is the best at k0, or the one "
        "without retrieval. The best at k0 is chosen by that rate, which overstates its fall where "
        "others are about as good. Systems whose histories may differ are left out. Over the n "
        "episodes that count in all four cells; pairs are episodes, gained and lost "
        "those whose change is higher, or lower, than the other's. 95% "
        "intervals: from those of both changes and their correlation. p: the exact sign-flip test "
        "of the episodes' differences, p_mid its mid-p, p_holm corrected by Holm's method among "
        f"{_TOGETHER}.",
    )
