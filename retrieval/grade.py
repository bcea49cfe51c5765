"""Grade choices against the true sessions, without a simulator and without IO.

A cell is a family, or an ability, under one condition. It passes if mean purity and mean coverage
are both at least `PASS_MARK` (released reference).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from robomme_interference_data.constants import ABILITIES
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.conditions import in_order
from robomme_interference_data.schema.sampling import evidence_kept
from robomme_interference_data.stats.bootstrap import bootstrap
from robomme_interference_data.stats.intervals import wilson
from robomme_interference_data.viz.tables import Columns, Table, percent, record_columns

from .measure import Similarities
from .select import Rule, choose

PASS_MARK = 0.9
"""Minimum mean purity and mean coverage of a cell that passes (released reference)."""

ALL = "all"
"""Name of all queries together."""


@dataclass(frozen=True)
class Grade:
    """How well one rule chose for one buffer.

    Attributes:
        rule: The rule with its number.
        threshold: Cosine below which it cut; None if it does not cut.
        episode_id: The query episode.
        condition: Name of the condition.
        ability: What a query of a day needs of a memory; None for others.
        history_frames: Frames of the history.
        segments: Number of segments; 0 if it does not cut.
        start: First chosen frame.
        stop: Frame after the last chosen one.
        chosen_frames: Number of chosen frames; there may be gaps.
        hit: Whether any frame of the lesson was chosen.
        purity: Share of the chosen frames that belong to the lesson.
        coverage: Share of the lesson's frames that were chosen; None without a lesson.
        evidence_kept: Share of the lesson's evidence spans of which a frame was chosen; None if
            there are none, or none are known.
        false_sessions: Sessions other than the lesson of which a frame was chosen.
        true_cuts: Borders between true sessions.
        found_cuts: Number of them that are borders of segments.
        false_cuts: Borders of segments inside a true session.
    """

    rule: str
    threshold: float | None
    episode_id: EpisodeId
    condition: str
    ability: str | None
    history_frames: int
    segments: int
    start: int
    stop: int
    chosen_frames: int
    hit: bool
    purity: float
    coverage: float | None
    evidence_kept: float | None
    false_sessions: int
    true_cuts: int
    found_cuts: int
    false_cuts: int


@dataclass(frozen=True)
class Cell:
    """How well one rule chose for some of the queries under one condition.

    Shares and means have 95% intervals, from `…_low` to `…_high`: Wilson's for `hit`, BCa bootstrap
    over episodes for the others, None for a single episode. `evidence_kept` is a mean over the
    queries for which it is known, None if there are none.

    Attributes:
        part: Whose queries they are: a family, an ability, or `ALL`.
        queries: Number of query episodes.
        hit: Share of them with a frame of the lesson chosen.
        purity, coverage, evidence_kept, false_sessions: Means over the grades.
        true_cuts, found_cuts, false_cuts: Sums over the grades.
        passed: Whether mean purity and mean coverage reach the pass mark.
    """

    rule: str
    part: str
    condition: str
    queries: int
    hit: float
    hit_low: float
    hit_high: float
    purity: float
    purity_low: float | None
    purity_high: float | None
    coverage: float
    coverage_low: float | None
    coverage_high: float | None
    evidence_kept: float | None
    evidence_kept_low: float | None
    evidence_kept_high: float | None
    false_sessions: float
    false_sessions_low: float | None
    false_sessions_high: float | None
    true_cuts: int
    found_cuts: int
    false_cuts: int
    passed: bool


def grade(measured: Similarities, rule: Rule) -> Grade:
    """Choose by a rule, and grade the choice against the true sessions."""
    choice = choose(measured, rule)
    frames, sessions = choice.frames, measured.sessions
    lesson = sum(b - a for a, b in measured.lesson)
    inside = sum(int(((frames >= a) & (frames < b)).sum()) for a, b in measured.lesson)
    starts = [session.start for session in sessions]
    borders, cuts = set(starts[1:]), {first for first, _ in choice.segments[1:]}
    touched = set(np.searchsorted(starts, frames, side="right").tolist())
    return Grade(
        rule=str(rule),
        threshold=choice.threshold,
        episode_id=measured.episode_id,
        condition=measured.condition,
        ability=measured.ability,
        history_frames=len(measured.alike),
        segments=len(choice.segments),
        start=int(frames[0]),
        stop=int(frames[-1]) + 1,
        chosen_frames=len(frames),
        hit=inside > 0,
        purity=inside / len(frames),
        coverage=inside / lesson if lesson else None,
        evidence_kept=evidence_kept(measured.evidence or (), set(frames.tolist())),
        false_sessions=sum(sessions[number - 1].role != "lesson" for number in touched),
        true_cuts=len(borders),
        found_cuts=len(borders & cuts),
        false_cuts=len(cuts - borders),
    )


def cells(grades: Sequence[Grade]) -> Iterator[Cell]:
    """Yield cells by rule, part (families, abilities, all) and condition.

    The grades are of buffers that hold frames of the lesson; rules and families keep their order.
    """
    groups: dict[tuple[str, str, str], list[Grade]] = {}
    for graded in grades:
        for part in (graded.episode_id.family, graded.ability, ALL):
            if part is not None:
                groups.setdefault((graded.rule, part, graded.condition), []).append(graded)
    rules = dict.fromkeys(graded.rule for graded in grades)
    families = dict.fromkeys(graded.episode_id.family for graded in grades)
    conditions = [graded.name for graded in in_order({graded.condition for graded in grades})]
    for key in product(rules, [*families, *ABILITIES, ALL], conditions):
        if key in groups:
            yield _cell(*key, groups[key])


def _cell(rule: str, part: str, condition: str, grades: Sequence[Grade]) -> Cell:
    count, hits = len(grades), sum(graded.hit for graded in grades)
    means = [(g.purity, g.coverage, g.evidence_kept, g.false_sessions) for g in grades]
    values = np.array(means, float)  # NaN for None
    # One key for all cells: equal values have equal intervals.
    drawn = bootstrap(values, "retrieval")
    bounds = (None if math.isnan(number) else number for interval in drawn for number in interval)
    cuts = np.sum([(g.true_cuts, g.found_cuts, g.false_cuts) for g in grades], axis=0).tolist()
    passed = min(interval.value for interval in drawn[:2]) >= PASS_MARK
    columns: list[Any] = [hits / count, *wilson(hits, count), *bounds, *cuts, passed]
    return Cell(rule, part, condition, count, *columns)


def is_family(cell: Cell) -> bool:
    """Whether the cell is of the queries of a family."""
    return cell.part != ALL and cell.part not in ABILITIES


# --- in words ----------------------------------------------------------------------------------

_NOTE = (
    "hit: share of queries with a chosen lesson frame, with the 95% Wilson interval. Means over "
    "queries with 95% BCa bootstrap intervals (none for a single query): purity, the share of "
    "chosen frames that belong to the lesson; coverage, the share of the lesson that was chosen; "
    "evidence kept, where evidence is known, the share of its spans with a chosen frame; false "
    "sessions, the number of other sessions with a chosen frame. Sums over queries: cuts found, of "
    "all cuts between true sessions; false cuts, inside a true session. pass: mean purity and mean "
    "coverage are both at "
    f"least {PASS_MARK:.0%}."
)


def verdict(cells: Sequence[Cell]) -> str:
    """Return for each rule how many cells of a family and a condition pass."""
    parts = []
    for rule in dict.fromkeys(cell.rule for cell in cells):
        passed = [cell.passed for cell in cells if cell.rule == rule and is_family(cell)]
        parts.append(f"{rule}: {sum(passed)} of {len(passed)}")
    return "Cells of a family and a condition that pass: " + ", ".join(parts)


def cell_table(cells: Sequence[Cell], title: str) -> Table:
    """Return a table by condition: of one rule by part, or of several rules."""
    several = len({cell.rule for cell in cells}) > 1
    columns: Columns = {
        "rule" if several else "part": "text",
        "condition": "text",
        "queries": "count",
        "hit": "text",
        "purity": "text",
        "coverage": "text",
        "evidence_kept": "text",
        "false_sessions": "ratio",
        "cuts_found": "text",
        "false_cuts": "count",
        "pass": "flag",
    }
    rows = [
        (
            cell.rule if several else cell.part,
            cell.condition,
            cell.queries,
            *(_share(cell, name) for name in ("hit", "purity", "coverage", "evidence_kept")),
            cell.false_sessions,
            f"{cell.found_cuts} of {cell.true_cuts}",
            cell.false_cuts,
            cell.passed,
        )
        for cell in cells
        if not several or cell.part == ALL
    ]
    table = Table("retrieval", title, columns, rows, _NOTE)
    return table.without_empty("evidence_kept")


def _share(cell: Cell, name: str) -> str | None:
    value, low, high = (getattr(cell, name + suffix) for suffix in ("", "_low", "_high"))
    if value is None:
        return None
    return percent(value) + ("" if low is None else f" [{100 * low:.0f}–{100 * high:.0f}]")


def as_csv(record: type, records: Sequence[Any]) -> str:
    """Return records of one type, such as grades, as CSV with the columns of their schema."""
    columns = record_columns(record)
    values = map(to_dict, records)  # in the order of the fields, the columns in that of the schema
    rows = [[named_values.get(name) for name in columns] for named_values in values]
    return Table("records", "", columns, rows).csv()
