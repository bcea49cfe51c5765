"""What retrieval found, in words and tables: for the terminal, and as data."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robomme_interference_data.buffer import Buffer
from robomme_interference_data.retrieval.calibrate import Calibration
from robomme_interference_data.retrieval.grade import ALL, PASS_MARK, Cell, Grade
from robomme_interference_data.retrieval.segment import Span
from robomme_interference_data.retrieval.select import Choice
from robomme_interference_data.stats import Interval
from robomme_interference_data.tables import Column, Table, percent

__all__ = [
    "Reasons",
    "calibration_text",
    "cell_table",
    "grade_table",
    "reasons",
    "shown_table",
    "verdict",
]

NOTE = (
    "hit: queries for which any lesson frame was chosen, with the 95% Wilson interval. Means over "
    "queries with 95% BCa bootstrap intervals (none for a single query): purity, the share of the "
    "chosen frames that are lesson; coverage, the share of the lesson that was chosen; false "
    "sessions, how many others were touched. cuts found: of all cuts between true sessions, in all "
    "queries together; false cuts: those inside one. pass: mean purity and mean coverage are both "
    f"at least {PASS_MARK:.0%}."
)


def verdict(cells: Sequence[Cell]) -> str:
    """Say for each rule how many cells of a family and a k pass."""
    parts = []
    for rule in dict.fromkeys(cell.rule for cell in cells):
        here = [cell for cell in cells if cell.rule == rule and cell.family != ALL]
        parts.append(f"{rule}: {sum(cell.passed for cell in here)} of {len(here)}")
    return "Cells of a family and a k that pass: " + ", ".join(parts)


def shown_table(cells: Sequence[Cell], title: str) -> Table:
    """Return the table for the terminal: one rule by family and k, or several rules by k."""
    several = len({cell.rule for cell in cells}) > 1
    rows = [
        (
            cell.rule if several else cell.family,
            f"k{cell.k}",
            cell.episodes,
            *(_rate(value) for value in (cell.hit, cell.purity, cell.coverage)),
            cell.false_sessions.value,
            f"{cell.found_cuts} of {cell.true_cuts}",
            cell.false_cuts,
            cell.passed,
        )
        for cell in cells
        if not several or cell.family == ALL
    ]
    columns = (
        Column("rule" if several else "family"),
        Column("k"),
        Column("queries", "count"),
        Column("hit"),
        Column("purity"),
        Column("coverage"),
        Column("false_sessions", "ratio"),
        Column("cuts_found"),
        Column("false_cuts", "count"),
        Column("pass", "flag"),
    )
    return Table("retrieval", title, columns, tuple(rows), NOTE)


def cell_table(cells: Sequence[Cell], title: str) -> Table:
    """Return all cells as data."""
    columns = [Column("rule"), Column("family"), Column("k", "count"), Column("queries", "count")]
    for name in ("hit", "purity", "coverage", "false_sessions"):
        columns += [Column(name + suffix, "ratio") for suffix in ("", "_low", "_high")]
    columns += [Column(name, "count") for name in ("true_cuts", "found_cuts", "false_cuts")]
    columns.append(Column("pass", "flag"))
    rows = [
        (
            cell.rule,
            cell.family,
            cell.k,
            cell.episodes,
            *_bounds(cell.hit),
            *_bounds(cell.purity),
            *_bounds(cell.coverage),
            *_bounds(cell.false_sessions),
            cell.true_cuts,
            cell.found_cuts,
            cell.false_cuts,
            cell.passed,
        )
        for cell in cells
    ]
    return Table("cells", title, tuple(columns), tuple(rows))


def grade_table(grades: Sequence[Grade], title: str) -> Table:
    """Return one row per buffer and rule as data."""
    columns = (
        *(Column(name) for name in ("rule", "episode_id", "family")),
        Column("k", "count"),
        Column("threshold", "ratio"),
        *(
            Column(name, "count")
            for name in ("history_frames", "segments", "start", "stop", "chosen_frames")
        ),
        Column("hit", "flag"),
        Column("purity", "ratio"),
        Column("coverage", "ratio"),
        Column("false_sessions", "count"),
        *(Column(name, "count") for name in ("true_cuts", "found_cuts", "false_cuts")),
    )
    rows = [
        (
            one.rule,
            str(one.episode_id),
            one.episode_id.family,
            one.k,
            one.threshold,
            one.history_frames,
            one.segments,
            one.start,
            one.stop,
            one.chosen_frames,
            one.hit,
            one.purity,
            one.coverage,
            one.false_sessions,
            one.true_cuts,
            one.found_cuts,
            one.false_cuts,
        )
        for one in grades
    ]
    return Table("rows", title, columns, tuple(rows))


_WHY = {
    "max": "no segment long enough has a frame of a higher cosine with what the robot sees now",
    "mean": "no segment long enough has a higher mean cosine with what the robot sees now",
    "last": "it is the last segment that is long enough",
    "random": "it was drawn by lot among the segments that are long enough",
    "oracle": "it is the true lesson, which this rule is told",
}
"""Method to the reason for its choice; followed by the score, if it has one."""


@dataclass(frozen=True)
class Reasons:
    """Why a part of a history was chosen.

    Attributes:
        grade: The choice, compared with the true lesson.
        camera: Camera whose frames were compared.
        method: The method, one of `select.METHODS`.
        score: What it scored the chosen segment by, or None if it scores none.
        lesson: The true lesson.
        closest: Chosen frame closest to what the robot sees.
        cosine: Its cosine.
        other: Frame closest to it outside the chosen part, or None if all was chosen.
        other_cosine: Its cosine, or None.
        other_source: Episode that this frame is of, or None.
        sessions: Source of each session that the chosen part touches, in order.
    """

    grade: Grade
    camera: str
    method: str
    score: float | None
    lesson: Span
    closest: int
    cosine: float
    other: int | None
    other_cosine: float | None
    other_source: str | None
    sessions: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain values."""
        return {
            "episode_id": str(self.grade.episode_id),
            "k": self.grade.k,
            "camera": self.camera,
            "score": self.score,
            "rule": self.grade.rule,
            "threshold": self.grade.threshold,
            "history_frames": self.grade.history_frames,
            "segments": self.grade.segments,
            "start": self.grade.start,
            "stop": self.grade.stop,
            "sessions": list(self.sessions),
            "closest": self.closest,
            "cosine": self.cosine,
            "other": self.other,
            "other_cosine": self.other_cosine,
            "other_source": self.other_source,
            "lesson": list(self.lesson),
            "hit": self.grade.hit,
            "purity": self.grade.purity,
            "coverage": self.grade.coverage,
            "false_sessions": self.grade.false_sessions,
        }

    def text(self) -> str:
        """Say it in a few lines."""
        one = self.grade
        parts = f"{one.segments} segment{'s' if one.segments > 1 else ''}"
        lines = [
            f"{one.episode_id} at k={one.k}, {self.camera} camera, rule {one.rule}: "
            f"{one.history_frames} history frames, cut into {parts} where the cosine of "
            f"adjacent frames is below {one.threshold:.3f}",
            f"Chosen: frames {one.start} to {one.stop - 1}, of {', '.join(self.sessions)}",
            f"Why: {_WHY[self.method]}" + ("" if self.score is None else f", {self.score:.3f}"),
            f"What the robot sees now is closest to frame {self.closest} of these, with cosine "
            f"{self.cosine:.3f}"
            + (
                f"; the closest one outside is frame {self.other} of {self.other_source}, "
                f"{self.other_cosine:.3f}"
                if self.other is not None
                else "; nothing lies outside"
            ),
            f"The lesson is frames {self.lesson[0]} to {self.lesson[1] - 1}: purity "
            f"{percent(one.purity)}, coverage {percent(one.coverage)}, "
            f"{one.false_sessions} false session{'' if one.false_sessions == 1 else 's'}",
        ]
        return "\n".join(lines)


def reasons(buffer: Buffer, choice: Choice, grade: Grade, camera: str) -> Reasons:
    """Collect why a span was chosen."""
    start, stop = choice.span
    alike = choice.query_cosines
    closest = start + int(np.argmax(alike[start:stop]))
    outside = np.concatenate([np.arange(start), np.arange(stop, len(alike))])
    other = int(outside[np.argmax(alike[outside])]) if len(outside) else None
    session = buffer.session_index
    touched = range(int(session[start]), int(session[stop - 1]) + 1)
    lesson = next(one.span for one in buffer.sessions if one.role == "lesson")
    return Reasons(
        grade,
        camera,
        choice.method,
        dict(zip(choice.segments, choice.scores, strict=True)).get((start, stop)),
        lesson,
        closest,
        float(alike[closest]),
        other,
        None if other is None else float(alike[other]),
        None if other is None else str(buffer.sessions[session[other]].source),
        tuple(f"{buffer.sessions[n].role} {buffer.sessions[n].source}" for n in touched),
    )


def calibration_text(found: Calibration, rule: str, own: float, title: str) -> str:
    """Return the calibration for a terminal."""
    apart = found.lowest_percentile - found.cut_percentile
    gap = (
        f"{apart:.3f} lie between them"
        if apart >= 0
        else f"they overlap by {-apart:.3f}: no threshold parts them"
    )
    lines = [
        title,
        "",
        f"Fitted by the released rule: {found.threshold:.3f}; in use ({rule}): {own:.3f}",
        f"99th percentile of {len(found.cuts)} true cuts: {found.cut_percentile:.3f}; 1st "
        f"percentile of the lowest cosine inside {len(found.lowest)} sessions: "
        f"{found.lowest_percentile:.3f}; {gap}",
        "Each stored span counts once, and each cut between the same two. Fitted and tried on the "
        "same split; only the families left out below are unseen.",
    ]
    parts = ["\n".join(lines)]
    if found.held_out:
        values = [one.threshold for one in found.held_out]
        columns: tuple[Column, ...] = (
            Column("left_out"),
            Column("threshold", "ratio"),
            Column("purity", "rate"),
            Column("coverage", "rate"),
        )
        rows = tuple((o.family, o.threshold, o.purity, o.coverage) for o in found.held_out)
        left_out = Table(
            "held_out",
            f"Fitted without any frame of one family, tried on it: thresholds from "
            f"{min(values):.3f} "
            f"to {max(values):.3f}",
            columns,
            rows,
        )
        parts.append(left_out.text())
    ks = sorted({point.k for point in found.sweep})
    columns = (
        Column("threshold"),
        *(Column(f"{share}_k{k}", "rate") for share in ("purity", "coverage") for k in ks),
    )
    by_cut: dict[float, list[Any]] = {}
    for point in found.sweep:
        by_cut.setdefault(point.threshold, []).append(point)
    rows = tuple(
        (f"{cut:.2f}", *(p.purity for p in points), *(p.coverage for p in points))
        for cut, points in by_cut.items()
    )
    parts.append(Table("sweep", "Other thresholds, all families", columns, rows).text())
    return "\n\n".join(parts)


def _rate(interval: Interval) -> str:
    text = percent(interval.value)
    if math.isnan(interval.low):  # a single query
        return text
    return f"{text} ({100 * interval.low:.1f} to {100 * interval.high:.1f})"


def _bounds(interval: Interval) -> tuple[float, float, float]:
    return interval.value, interval.low, interval.high
