"""Tables of comparisons and of tests: their columns, Holm's correction, and how to read them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.evaluate.score import power
from robomme_interference_data.stats.runs import MIN_RUNS
from robomme_interference_data.stats.significance import ALPHA
from robomme_interference_data.stats.signs import simultaneous
from robomme_interference_data.viz.tables import Columns, Table

from .contrast import Contrast
from .correction import corrected

SIDES: Columns = {
    "simulator": "text",
    "system": "text",
    "condition": "text",
    "against_system": "text",
    "against_condition": "text",
}
"""The two sides of a comparison."""

RUNS_NOTE = (
    f"runs: training runs of the side with fewer. scope: with {MIN_RUNS} runs or more, interval "
    "and test hold for other training runs too, otherwise for this checkpoint alone. if failures, "
    "if successes: the value if every error on either side were a failure, or a success; verdict: "
    "p holm is below 0.05 or not, or this depends on errors, because one of the two would change "
    "it."
)

RATES: Columns = {
    "n": "count",
    "runs": "count",
    "scope": "text",
    "rate": "rate",
    "against_rate": "rate",
    "difference": "points",
    "low": "points",
    "high": "points",
    "if_failures": "points",
    "if_successes": "points",
    "gained": "count",
    "lost": "count",
    "flips": "rate",
    "p": "p",
    "p_holm": "p",
    "joint_low": "points",
    "joint_high": "points",
    "verdict": "text",
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
        columns: Its columns: values of `_values`, and of `Contrast.columns`.
        corrected: In words, for the note, with which others a comparison is corrected.
        note: How to read it, before the explanation of intervals and tests.
        explain: Whether the note explains intervals and tests of success rates.
        alpha: One minus the level of the joint intervals.
    """

    name: str
    title: str
    columns: Columns
    corrected: str = "the tests of this table in one simulator"
    note: str = BOTH_SIDES
    explain: bool = True
    alpha: float = ALPHA


def comparison_table(spec: ComparisonTable, contrasts: Iterable[Contrast]) -> Table:
    """Return a row for each comparison, which is corrected already."""
    contrasts = list(contrasts)
    rows = []
    for contrast in contrasts:
        joint = contrast.pairs.at(simultaneous(contrast.tests, spec.alpha))
        values = _values(contrast) | {"joint_low": joint.low, "joint_high": joint.high}
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
    if "verdict" in spec.columns:
        notes.append(RUNS_NOTE)
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
        "runs": contrast.runs,
        "scope": contrast.scope,
        "rate": pairs.second,
        "against_rate": pairs.first,
        "action_l1": pairs.second,  # in place of a rate, offline
        "against_action_l1": pairs.first,
        "difference": pairs.change.value,
        "low": pairs.change.low,
        "high": pairs.change.high,
        "low_90": pairs.within.low,
        "high_90": pairs.within.high,
        "if_failures": contrast.if_failures,
        "if_successes": contrast.if_successes,
        "gained": pairs.gained if pairs.paired else None,
        "lost": pairs.lost if pairs.paired else None,
        "flips": pairs.flips,
        "p": pairs.p,
        "p_holm": contrast.p_holm,
        "primary": contrast.primary,
        "verdict": contrast.verdict or "",
        "retention": contrast.retention.value,
        "retention_low": contrast.retention.low,
        "retention_high": contrast.retention.high,
        "retention_n": contrast.retention_n,
        "complete": contrast.complete,
    }


def detectable(contrasts: Sequence[Contrast], effect: str = "") -> str:
    """Return a sentence on the differences that such comparisons can detect; empty without any."""
    counts = [(c.pairs.pairs, c.pairs.gained, c.pairs.lost) for c in contrasts if not c.family]
    return power.note(counts, max((c.tests for c in contrasts), default=1), effect)


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
    if any(contrast.pairs.spread.variance for contrast in contrasts):
        note += (
            f" With {MIN_RUNS} training runs or more, the interval is widened, and p raised, by "
            "the variance between runs (Student's t)."
        )
    if "unpaired" in methods:
        note += (
            " If histories may differ, nothing is paired, and gained and lost are empty: "
            "Newcombe's hybrid score interval, and the test of two proportions."
        )
    return note
