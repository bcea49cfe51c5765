"""Tables of comparisons and of tests: their columns, Holm's correction, and how to read them."""

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from robomme_interference_data.evaluate.score import power
from robomme_interference_data.stats.significance import ALPHA, holm
from robomme_interference_data.stats.signs import simultaneous
from robomme_interference_data.viz.tables import Columns, Table

from .contrast import Contrast

SIDES: Columns = {
    "simulator": "text",
    "system": "text",
    "condition": "text",
    "against_system": "text",
    "against_condition": "text",
}
"""The two sides of a comparison."""

RATES: Columns = {
    "n": "count",
    "rate": "rate",
    "against_rate": "rate",
    "difference": "points",
    "low": "points",
    "high": "points",
    "gained": "count",
    "lost": "count",
    "flips": "rate",
    "p": "p",
    "p_holm": "p",
    "joint_low": "points",
    "joint_high": "points",
}
"""The rates of both sides, their difference, and its test."""

ACTION_ERRORS: Columns = {
    "n": "count",
    "action_l1": "number",
    "against_action_l1": "number",
    "difference": "number",
    "low": "number",
    "high": "number",
    "gained": "count",
    "lost": "count",
    "p": "p",
    "p_holm": "p",
    "joint_low": "number",
    "joint_high": "number",
}
"""The same of action errors along recordings."""

ACTION_ERRORS_NOTE = (
    "gained and lost: episodes whose error is lower, or higher. p: sign-flip test of the episodes' "
    "differences; low to high: the 95% interval of all differences that this test does not reject, "
    "if at least ten episodes differ."
)

BOTH_SIDES = "Over the n episodes that count on both sides."

COMPLETE: Columns = {"complete": "flag"}


@dataclass(frozen=True)
class ComparisonTable:
    """How a table of comparisons is made.

    Attributes:
        name: Its name.
        title: Its subject, in a line.
        columns: Its columns: values of `_values`, of `Contrast.columns`, `p_holm`, and `joint_low`
            and `joint_high`, the interval that holds with all others of the group.
        group: Comparisons for which this is equal are corrected together.
        corrected: The group in words, for the note.
        note: How to read it, before the explanation of intervals and tests.
        explain: Whether the note explains intervals and tests of success rates.
        alpha: One minus the level of the joint intervals.
    """

    name: str
    title: str
    columns: Columns
    group: Callable[[Contrast], Hashable] = attrgetter("simulator")
    corrected: str = "the tests of this table in one simulator"
    note: str = BOTH_SIDES
    explain: bool = True
    alpha: float = ALPHA


def comparison_table(spec: ComparisonTable, contrasts: Iterable[Contrast]) -> Table:
    """Return a row for each comparison."""
    contrasts = list(contrasts)
    tests = tests_of(contrasts, spec.group)
    holms = corrected([c.pairs.p for c in contrasts], [spec.group(c) for c in contrasts])
    rows = []
    for contrast, count, p_holm in zip(contrasts, tests, holms, strict=True):
        joint = contrast.pairs.at(simultaneous(count, spec.alpha))
        values = _values(contrast)
        values |= {"p_holm": p_holm, "joint_low": joint.low, "joint_high": joint.high}
        values |= contrast.columns
        rows.append([values[name] for name in spec.columns])
    notes = [spec.note]
    if spec.explain:
        notes.append(_how_to_read(contrasts))
    if "p_holm" in spec.columns:
        notes.append(f"p holm: p after Holm's correction among {spec.corrected}.")
    if "joint_low" in spec.columns:
        notes.append(
            "joint low to joint high: intervals that hold for all of these at once with 95% "
            "(Bonferroni)."
        )
    if spec.explain and not all(contrast.complete for contrast in contrasts):
        notes.append("p†: provisional, because a cell is incomplete; early looks find too much.")
    return Table(spec.name, spec.title, spec.columns, rows, " ".join(notes))


def _values(contrast: Contrast) -> dict[str, Any]:
    """Return the values of a comparison that several tables show, by column."""
    pairs = contrast.pairs
    against_system, against_condition = contrast.against
    return {
        "simulator": contrast.simulator,
        "system": contrast.system,
        "condition": contrast.condition,
        "against_system": against_system,
        "against_condition": against_condition,
        "effect": contrast.effect,
        "asks": contrast.asks,
        "family": contrast.family or "all",
        "n": pairs.n,
        "rate": pairs.second,
        "against_rate": pairs.first,
        "action_l1": pairs.second,  # in place of a rate, offline
        "against_action_l1": pairs.first,
        "difference": pairs.change.value,
        "low": pairs.change.low,
        "high": pairs.change.high,
        "low_90": pairs.within.low,
        "high_90": pairs.within.high,
        "gained": pairs.gained if pairs.paired else None,
        "lost": pairs.lost if pairs.paired else None,
        "flips": pairs.flips,
        "p": pairs.p,
        "retention": contrast.retention.value,
        "retention_low": contrast.retention.low,
        "retention_high": contrast.retention.high,
        "retention_n": contrast.retention_n,
        "complete": contrast.complete,
    }


def tests_of(contrasts: Sequence[Contrast], group: Callable[[Contrast], Hashable]) -> list[int]:
    """Return the number of comparisons that each one is corrected with."""
    sizes = Counter(group(contrast) for contrast in contrasts)
    return [sizes[group(contrast)] for contrast in contrasts]


def detectable(
    contrasts: Sequence[Contrast], group: Callable[[Contrast], Hashable], effect: str = ""
) -> str:
    """Return a sentence on the differences that such comparisons can detect; empty without any."""
    counts = [(c.pairs.pairs, c.pairs.gained, c.pairs.lost) for c in contrasts if not c.family]
    return power.note(counts, max(tests_of(contrasts, group), default=1), effect)


def tested_table(
    name: str, title: str, columns: Columns, records: Iterable[Mapping[str, Any]], note: str
) -> Table:
    """Return a table of tests from records by column, which lack the columns `…_holm`.

    Those are p of the column without `_holm`, after Holm's correction within a simulator. The note
    explains marks of rows that are not `complete`.
    """
    rows = [dict(record) for record in records]
    simulators = [row["simulator"] for row in rows]
    for column in columns:
        if column.endswith("_holm"):
            ps = corrected([row[column.removesuffix("_holm")] for row in rows], simulators)
            for row, p in zip(rows, ps, strict=True):
                row[column] = p
    if not all(row["complete"] for row in rows):
        note += " p†: provisional, because a cell is incomplete."
    return record_table(name, title, columns, rows, note)


def record_table(
    name: str, title: str, columns: Columns, records: Iterable[Mapping[str, Any]], note: str
) -> Table:
    """Return a table from records that hold a value for each column."""
    rows = [[record[column] for column in columns] for record in records]
    return Table(name, title, columns, rows, note)


def corrected(p_values: Sequence[float], groups: Sequence[Hashable]) -> list[float]:
    """Return p-values after Holm's correction within each group."""
    adjusted = [math.nan] * len(p_values)
    for group in dict.fromkeys(groups):
        places = [place for place, of in enumerate(groups) if of == group]
        for place, p in zip(places, holm([p_values[at] for at in places]), strict=True):
            adjusted[place] = p
    return adjusted


def _how_to_read(contrasts: Sequence[Contrast]) -> str:
    """Explain the intervals and tests of some comparisons of success rates."""
    methods = {contrast.pairs.method for contrast in contrasts}
    note = (
        "low to high: 95% confidence interval, Newcombe's paired score interval. p: McNemar's "
        "exact test, which is conservative: where the interval excludes 0, p can still be 0.05 or "
        "more. gained and lost: episodes whose outcome changes; flips: their share."
    )
    if "clusters" in methods:
        note += (
            " With repeats, interval and p use the episodes' means: the score interval from "
            "cluster-adjusted Wilson intervals of both sides, and the exact sign-flip test; gained "
            "and lost are of the lowest model seed that counts on both sides."
        )
    if "unpaired" in methods:
        note += (
            " If histories may differ, nothing is paired, and gained and lost are empty: "
            "Newcombe's hybrid score interval, and the test of two proportions."
        )
    return note
