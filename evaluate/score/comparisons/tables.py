"""Tables of comparisons: each is one specification; one function makes rows, Holm's p and notes."""

import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from typing import Any

from robomme_interference_data.evaluate.score import power
from robomme_interference_data.stats.intervals import cohens_h
from robomme_interference_data.stats.significance import ALPHA, holm
from robomme_interference_data.viz.tables import Provisional, Table

from .contrast import START, Contrast


def _count(name: str, one: Contrast) -> Any:
    return getattr(one.pairs, name) if one.pairs.paired else None


_VALUES: dict[str, tuple[str, Callable[[Contrast], Any]]] = {
    **{name: ("text", attrgetter(name)) for name in ("simulator", "system", "condition", "asks")},
    "against_system": ("text", lambda c: c.against[0]),
    "against_condition": ("text", lambda c: c.against[1]),
    "family": ("text", lambda c: c.family or "all"),
    "n": ("count", lambda c: c.pairs.n),
    "rate": ("rate", lambda c: c.pairs.second),
    "against_rate": ("rate", lambda c: c.pairs.first),
    "difference": ("points", lambda c: c.pairs.change.value),
    "low": ("points", lambda c: c.pairs.change.low),
    "high": ("points", lambda c: c.pairs.change.high),
    "low_90": ("points", lambda c: c.pairs.within.low),
    "high_90": ("points", lambda c: c.pairs.within.high),
    "interval": ("text", lambda c: c.pairs.interval),
    **{name: ("count", partial(_count, name)) for name in ("pairs", "gained", "lost")},
    "flips": ("rate", lambda c: c.pairs.flips),
    "p": ("p", lambda c: provisional(c.pairs.p, c.complete)),
    "p_mid": ("p", lambda c: provisional(c.pairs.p_mid, c.complete)),
    "cohens_h": ("ratio", lambda c: cohens_h(c.pairs.second, c.pairs.first)),
    "retention": ("ratio", lambda c: c.retention.value),
    "retention_low": ("ratio", lambda c: c.retention.low),
    "retention_high": ("ratio", lambda c: c.retention.high),
    "retention_n": ("count", lambda c: c.retention_n),
    "complete": ("flag", attrgetter("complete")),
}
"""Column to its kind (see `viz.tables.Column`), and to its value in the row of a comparison."""

CELLS = "simulator system condition against_system against_condition"
TEST = "low high interval pairs gained lost flips p p_mid p_holm:p"
_BOTH = "Over the n episodes that count on both sides. {how}"


@dataclass(frozen=True)
class TableSpec:
    """A table of comparisons.

    Attributes:
        title: Its title.
        columns: Names of `_VALUES`; `name=value` renames one, `name:kind` adds one whose values
            are given to `comparison_table`, and `p_holm` is p after Holm's correction.
        note: How to read it; `{how}` is the explanation of intervals and tests.
        group: The comparisons that Holm's correction counts together have the same of this.
        among: The same in words.
        power: Whether the note ends with what so many episodes can show.
    """

    title: str
    columns: str
    note: str = _BOTH
    group: Callable[[Contrast], Hashable] = attrgetter("simulator")
    among: str = "the tests of this table in one simulator"
    power: bool = field(default=True, kw_only=True)


_EFFECT = f"{CELLS} n rate against_rate difference {TEST} cohens_h complete"
_WITHIN: tuple[Callable[[Contrast], Hashable], str] = (
    attrgetter("simulator", "condition"),
    "the tests of a condition in one simulator",
)

SPECS = {
    "lift": TableSpec(
        "Lift over no history",
        "simulator system condition no_history_of=against_system n rate "
        f"no_history_rate=against_rate lift=difference {TEST} retention retention_low "
        "retention_high retention_n complete",
        f"{_BOTH} retention: lift divided by the lift "
        f"at k0, where that one is above zero with p < {ALPHA}, with Fieller's interval; of the "
        "retention_n episodes that count under no-history, k0 and the condition, which of cells "
        "that are not complete can be fewer than n. A system with retrieval is, without history, "
        "the system without it.",
    ),
    "effects": TableSpec("Effects between conditions", _EFFECT),
    "interference": TableSpec(
        "Which interference hurts",
        _EFFECT.replace("against_condition", "against_condition asks"),
        "Two kinds of conditions with equally many sessions, which differ in what is asked. "
        + _BOTH,
    ),
    "ceiling": TableSpec(
        "Gap to the ceiling",
        _EFFECT,
        "The ceiling is the ideal observer with the same memory: it uses all of the evidence that "
        f"the memory kept. {_BOTH}",
    ),
    "systems": TableSpec(
        "Difference to the best system",
        _EFFECT,
        "Within each condition, complete cells against that of the highest rate, of equal ones the "
        f"first. {_BOTH}",
        *_WITHIN,
    ),
    "matrix": TableSpec(
        "All pairs of systems",
        _EFFECT,
        f"Within each condition, of complete cells. {_BOTH}",
        *_WITHIN,
    ),
    "interaction": TableSpec(
        "Which system falls more",
        "simulator system condition against_system n change:points=rate "
        f"against_change:points=against_rate difference {TEST} complete",
        f"change: rate under the condition − rate at {START}; difference: of the changes, positive "
        "where the system falls less than the other one, which is the best at k0, or the one "
        "without retrieval. The best at k0 is chosen by that rate, which overstates its fall where "
        "others are about as good. Systems whose histories may differ are left out. Over the n "
        "episodes that count in all four cells; pairs are episodes, gained and lost "
        "those whose change is higher, or lower, than the other's. 95% "
        "intervals: from those of both changes and their correlation. p: the exact sign-flip test "
        "of the episodes' differences, p_mid its mid-p, p_holm corrected by Holm's method among "
        "the tests of this table in one simulator.",
        power=False,
    ),
    "family_effects": TableSpec(
        "Effects by family",
        f"{CELLS} family n rate against_rate difference {TEST} complete",
        "The lifts, effects and kinds of interference of the tables of those names, in each family "
        "alone, over the n episodes that count on both sides. {how}",
        power=False,
    ),
}
"""Name of a table to its specification."""


def comparison_table(
    name: str,
    contrasts: Iterable[Contrast],
    spec: TableSpec | None = None,
    more: Sequence[Mapping[str, Any]] | None = None,
) -> Table:
    """Return the table of the comparisons that name it.

    Without a specification it is one of `SPECS`; `more` has for each row the values of the columns
    that the specification adds.
    """
    spec = spec or SPECS[name]
    found = [one for one in contrasts if one.table == name]
    columns = [_column(text) for text in spec.columns.split()]
    holms = corrected([one.pairs.p for one in found], [spec.group(one) for one in found])
    rows = []
    for place, one in enumerate(found):
        added = {"p_holm": provisional(holms[place], one.complete), **(more[place] if more else {})}
        rows.append(
            tuple(added[key] if key in added else _VALUES[key][1](one) for _, key in columns)
        )
    note = spec.note.format(how=_how_to_read(found, spec.among))
    if spec.power:
        pairs = [one.pairs for one in found if not one.family]
        note += power.note((one.pairs, one.gained, one.lost) for one in pairs)
    return Table.make(name, spec.title, " ".join(column for column, _ in columns), rows, note)


def _column(text: str) -> tuple[str, str]:
    """Return a column of a table, as `Table.make` reads it, and the name of its value."""
    shown, _, value = text.partition("=")
    name, _, kind = shown.partition(":")
    value = value or name
    return f"{name}:{kind or _VALUES[value][0]}", value


def provisional(p: float, complete: bool) -> float:
    """Return a p-value as tables show it: one of cells that are not complete is provisional."""
    return p if complete else Provisional(p)


def corrected(p_values: Sequence[float], groups: Sequence[Hashable]) -> list[float]:
    """Return p-values by Holm's method, those of one group corrected among themselves."""
    adjusted = [math.nan] * len(p_values)
    for group in dict.fromkeys(groups):
        places = [place for place, one in enumerate(groups) if one == group]
        for place, p in zip(places, holm([p_values[at] for at in places]), strict=True):
            adjusted[place] = p
    return adjusted


def _how_to_read(found: Sequence[Contrast], among: str) -> str:
    """Explain the intervals and tests of some comparisons."""
    kinds = {one.pairs.interval for one in found}
    note = (
        "95% intervals (interval): newcombe, Newcombe's paired score interval. p: McNemar's exact "
        "test; p_mid: its mid-p, which is less cautious; p_holm: p corrected by Holm's method "
        f"among {among}. pairs: one an episode; gained and lost: those whose outcome differs; "
        "flips: their share."
    )
    if "clusters" in kinds:
        note += (
            " With repeats (clusters) interval and p are of the episodes' means: the score "
            "interval from Wilson's of each side by clusters, and the exact sign-flip test; pairs "
            "are of the lowest model seed that counts on both sides."
        )
    if "unpaired" in kinds:
        note += (
            " Where histories may differ (unpaired) nothing is paired: Newcombe's hybrid score "
            "interval, and the test of two proportions."
        )
    if not all(one.complete for one in found):
        note += " p†: provisional, as a cell is not complete: looking early finds too much."
    return note
