"""Tables of comparisons: one specification each; one function makes rows, Holm's p and notes."""

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from typing import Any, cast

from robomme_interference_data.evaluate.score import power
from robomme_interference_data.stats.intervals import cohens_h
from robomme_interference_data.stats.significance import ALPHA, holm
from robomme_interference_data.stats.signs import simultaneous
from robomme_interference_data.viz.tables import Columns, Format, Table

from .contrast import Contrast


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
    "p": ("p", lambda c: c.pairs.p),
    "p_mid": ("p", lambda c: c.pairs.p_mid),
    "cohens_h": ("ratio", lambda c: cohens_h(c.pairs.second, c.pairs.first)),
    "retention": ("ratio", lambda c: c.retention.value),
    "retention_low": ("ratio", lambda c: c.retention.low),
    "retention_high": ("ratio", lambda c: c.retention.high),
    "retention_n": ("count", lambda c: c.retention_n),
    "complete": ("flag", attrgetter("complete")),
}
"""Column to its kind (see `viz.tables.Column`) and its value for a comparison."""

CELLS = "simulator system condition against_system against_condition"
TEST = (
    "low high interval pairs gained lost flips p p_mid p_holm:p joint_low:points joint_high:points"
)
_BOTH = "Over the n episodes that count on both sides. {how}"


@dataclass(frozen=True)
class TableSpec:
    """A table of comparisons.

    `columns` names entries of `_VALUES`; `name=value` renames one, and `name:kind` shows an entry
    of `Contrast.more`, or `p_holm`, p after Holm's correction, or `joint_low` and `joint_high`, the
    interval that holds with all others of the group. In the note, `{how}` is the explanation of
    intervals and tests. Comparisons with equal `group` are corrected together; `among` describes
    them. With `power` the note ends with what so many episodes can detect.
    """

    title: str
    columns: str
    note: str = _BOTH
    group: Callable[[Contrast], Hashable] = attrgetter("simulator")
    among: str = "the tests of this table in one simulator"
    power: bool = field(default=True, kw_only=True)
    alpha: float = field(default=ALPHA, kw_only=True)  # of the joint intervals


_EFFECT = f"{CELLS} n rate against_rate difference {TEST} cohens_h complete"
_WITHIN: tuple[Callable[[Contrast], Hashable], str] = (
    attrgetter("simulator", "condition"),
    "the tests of a condition in one simulator",
)

ERROR_TEST = (
    "difference:number=difference low:number=low high:number=high gained lost p p_holm:p "
    "joint_low:number joint_high:number"
)
ERROR_NOTE = (
    "gained and lost: episodes whose error is lower, or higher. p: sign-flip test of the episodes' "
    "differences; low to high: the 95% interval of all differences that this test does not reject, "
    "if at least ten episodes differ. {correct}"
)
_ERRORS = (
    f"{CELLS} n action_l1:number=rate against_action_l1:number=against_rate {ERROR_TEST} complete"
)
_ERRORS_NOTE = (
    "difference: action error of the system and condition minus that of those against, over the n "
    f"episodes that count on both; negative is better. {ERROR_NOTE}"
)

SPECS = {
    "lift": TableSpec(
        "Lift over no history",
        "simulator system condition no_history_of=against_system n rate "
        f"no_history_rate=against_rate lift=difference {TEST} retention retention_low "
        "retention_high retention_n complete",
        f"{_BOTH} retention: lift divided by the lift at k0, with Fieller's interval, computed "
        f"only if the lift at k0 is above zero with p < {ALPHA}; over the retention n episodes "
        "that count under no-history, k0 and the condition, which can be fewer than n in "
        "incomplete cells. Without history, a system with retrieval is the system without it.",
    ),
    "effects": TableSpec("Effects between conditions", _EFFECT),
    "interference": TableSpec(
        "Effect of each kind of interference",
        _EFFECT.replace("against_condition", "against_condition asks"),
        "Two kinds of conditions with equally many sessions that differ in one property (asks). "
        + _BOTH,
    ),
    "ceiling": TableSpec(
        "Gap to the ideal observer",
        _EFFECT,
        "The ideal observer has the same memory and uses all of the evidence that the memory kept. "
        + _BOTH,
    ),
    "systems": TableSpec(
        "Difference to the best system",
        _EFFECT,
        "Within each condition, each complete cell against the one with the highest rate (the "
        "first of equal ones). Since that one is chosen by its rate, p holm and all intervals are "
        f"corrected over all pairs of systems; p and p mid are not. {_BOTH}",
        *_WITHIN,
    ),
    "matrix": TableSpec(
        "All pairs of systems", _EFFECT, f"Complete cells within each condition. {_BOTH}", *_WITHIN
    ),
    "interaction": TableSpec(
        "Which system falls faster",
        "simulator system against_system conditions:text n slope:points=rate "
        "against_slope:points=against_rate difference low high gained lost p p_holm:p "
        "joint_low:points joint_high:points p_fit:p p_fit_holm:p complete",
        "slope: change of the success rate per doubling of the sessions (least-squares line over "
        "log2(k + 1) of all conditions listed); difference: between the two slopes, positive if "
        "the system falls more slowly than the other one. Each pair of systems once; those whose "
        "histories may differ are left out. Over the n episodes that count in all cells; gained "
        "and lost: episodes whose own slope is higher or lower than the other system's. p: "
        "sign-flip test of the episodes' differences; low to high: the 95% interval of all "
        "differences that this test does not reject, if at least ten episodes differ. {correct} "
        "p fit: whether the difference between the two rates departs from a line over log2(k + 1), "
        "by sign flips; p fit holm: after the same correction.",
        power=False,
    ),
    "family_effects": TableSpec(
        "Effects by family",
        f"{CELLS} family n rate against_rate difference {TEST} complete",
        "The comparisons of the tables lift, effects and interference within each family, over the "
        "n episodes that count on both sides. {how}",
        power=False,
    ),
    "action_error_changes": TableSpec(
        "Changes of the action error between conditions",
        _ERRORS,
        _ERRORS_NOTE,
        among="the tests of this table",
        power=False,
    ),
    "action_error_systems": TableSpec(
        "Differences of the action error between systems",
        _ERRORS,
        "All pairs of systems under each condition; a system that ran without history only, such "
        f"as a baseline, under all conditions of the others. {_ERRORS_NOTE}",
        among="the tests of this table",
        power=False,
    ),
}
"""Name of a table to its specification."""


def comparison_table(
    name: str, contrasts: Iterable[Contrast], spec: TableSpec | None = None
) -> Table:
    """Return the table of the comparisons that name it, by default with its entry in `SPECS`."""
    spec = spec or SPECS[name]
    found = [one for one in contrasts if one.table == name]
    columns = [_column(text) for text in spec.columns.split()]
    holms = corrected([one.pairs.p for one in found], [spec.group(one) for one in found])
    groups = Counter(spec.group(one) for one in found)
    rows = []
    for one, p_holm in zip(found, holms, strict=True):
        tests = one.more.get("tests", groups[spec.group(one)])
        joint = one.pairs.at(simultaneous(tests, spec.alpha))
        more = {"p_holm": p_holm, **one.more}
        more |= {"joint_low": joint.low, "joint_high": joint.high}
        rows.append(tuple(more[key] if key in more else _VALUES[key][1](one) for _, key in columns))
    correct = _CORRECT.format(among=spec.among)
    note = spec.note.format(how=_how_to_read(found, correct), correct=correct)
    if spec.power:
        pairs = [one.pairs for one in found if not one.family]
        tests = max((one.more.get("tests", groups[spec.group(one)]) for one in found), default=1)
        note += power.note(((one.pairs, one.gained, one.lost) for one in pairs), tests)
    return Table(
        name, spec.title, columns_of(" ".join(column for column, _ in columns)), rows, note
    )


def columns_of(text: str) -> Columns:
    """Return columns such as `system n:count rate:rate`."""
    named = (column.partition(":") for column in text.split())
    return {name: cast(Format, format_ or "text") for name, _, format_ in named}


def _column(text: str) -> tuple[str, str]:
    """Return a column in the notation of `Table.make`, and the name of its value."""
    shown, _, value = text.partition("=")
    name, _, kind = shown.partition(":")
    value = value or name
    return f"{name}:{kind or _VALUES[value][0]}", value


def tested(name: str, title: str, columns: str, rows: Iterable[Sequence[Any]], note: str) -> Table:
    """Return a table of tests of one simulator each, the first column; the last is `complete`.

    Rows lack the columns `…_holm`: p of the column before, after Holm's correction within the
    simulator. The note explains marks of rows that are not complete.
    """
    found = [list(row) for row in rows]
    for place, column in enumerate(columns.split()):
        if column.endswith("_holm:p"):
            ps = corrected([row[place - 1] for row in found], [row[0] for row in found])
            for row, p in zip(found, ps, strict=True):
                row.insert(place, p)
    if not all(row[-1] for row in found):
        note += " p†: provisional, because a cell is incomplete."
    return Table(name, title, columns_of(columns), list(map(tuple, found)), note)


def corrected(p_values: Sequence[float], groups: Sequence[Hashable]) -> list[float]:
    """Return p-values after Holm's correction within each group."""
    adjusted = [math.nan] * len(p_values)
    for group in dict.fromkeys(groups):
        places = [place for place, one in enumerate(groups) if one == group]
        for place, p in zip(places, holm([p_values[at] for at in places]), strict=True):
            adjusted[place] = p
    return adjusted


_CORRECT = (
    "p holm: p after Holm's correction among {among}; joint low to joint high: intervals that hold "
    "for all of these at once with 95% (Bonferroni)."
)


def _how_to_read(found: Sequence[Contrast], correct: str) -> str:
    """Explain the intervals and tests of some comparisons."""
    kinds = {one.pairs.interval for one in found}
    note = (
        "95% confidence intervals; interval names the method: newcombe is Newcombe's paired score "
        "interval. p: McNemar's exact test, which is conservative: where an interval excludes 0 "
        f"and p is not below 0.05, see p mid, its mid-p. {correct} pairs: one per episode; gained "
        "and lost: pairs whose outcome changes; flips: their share."
    )
    if "clusters" in kinds:
        note += (
            " With repeats (clusters), interval and p use the episodes' means: the score interval "
            "from cluster-adjusted Wilson intervals of both sides, and the exact sign-flip test; "
            "pairs are of the lowest model seed that counts on both sides."
        )
    if "unpaired" in kinds:
        note += (
            " If histories may differ (unpaired), nothing is paired: Newcombe's hybrid score "
            "interval, and the test of two proportions."
        )
    if not all(one.complete for one in found):
        note += " p†: provisional, because a cell is incomplete; early looks find too much."
    return note
