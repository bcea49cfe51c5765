"""Grade what was chosen against the true sessions, without a simulator: pure but for look-ups.

A cell is a family under one k; it is good when mean purity and mean coverage are both at least
`PASS_MARK` (released reference).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.buffer import Buffer
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.retrieval.segment import Span, adjacent_cosines, cosines
from robomme_interference_data.retrieval.select import Rule, pick
from robomme_interference_data.retrieval.selector import lot_of, true_lesson
from robomme_interference_data.sessions import Session
from robomme_interference_data.stats import Interval, Resampler, mean, wilson

__all__ = [
    "ALL",
    "PASS_MARK",
    "Cell",
    "Grade",
    "Measured",
    "TrueSession",
    "cells",
    "grade",
    "mean_of",
    "measure",
]

PASS_MARK = 0.9
"""Least mean purity and mean coverage of a good cell (released reference)."""

ALL = "all"
"""Stands for all families together."""


@dataclass(frozen=True)
class TrueSession:
    """A session of a buffer, for grading.

    Attributes:
        span: First frame in the buffer, and the one after the last.
        family: Its family.
        stored: Names the stored frames that it holds, the same in every buffer of a split.
    """

    span: Span
    family: str
    stored: str


@dataclass(frozen=True, eq=False)
class Measured:
    """What grading needs to know of a buffer: all rules and cuts share it.

    Attributes:
        episode_id: The query episode.
        k: Number of distractor sessions.
        sessions: The true sessions in order.
        lesson: The true lesson.
        adjacent: Cosine of each frame with the next, `(T - 1,) float32`.
        query_cosines: Cosine of each frame with the first live observation, `(T,) float32`.
        typical: Median cosine of two frames of different distractor units.
    """

    episode_id: EpisodeId
    k: int
    sessions: tuple[TrueSession, ...]
    lesson: Span
    adjacent: NDArray[np.float32]
    query_cosines: NDArray[np.float32]
    typical: float


@dataclass(frozen=True)
class Grade:
    """How well one rule chose for one buffer.

    Attributes:
        rule: The rule, its cut named.
        threshold: Cosine below which it cut.
        episode_id: The query episode.
        k: Number of distractor sessions.
        history_frames: Frames of the history.
        segments: Segments that it was cut into.
        start: First chosen frame.
        stop: Frame after the last chosen one.
        chosen_frames: How many were chosen; fewer than `stop - start` for single frames.
        purity: Share of the chosen frames that are of the lesson.
        coverage: Share of the lesson's frames that were chosen.
        false_sessions: Sessions other than the lesson of which a frame was chosen.
        true_cuts: Borders between true sessions.
        found_cuts: How many of them are borders of segments.
        false_cuts: Borders of segments inside a true session.
    """

    rule: str
    threshold: float
    episode_id: EpisodeId
    k: int
    history_frames: int
    segments: int
    start: int
    stop: int
    chosen_frames: int
    purity: float
    coverage: float
    false_sessions: int
    true_cuts: int
    found_cuts: int
    false_cuts: int

    @property
    def hit(self) -> bool:
        """Whether any frame of the lesson was chosen."""
        return self.coverage > 0


@dataclass(frozen=True)
class Cell:
    """How well one rule chose for all queries of a family under one k.

    Attributes:
        rule: The rule.
        family: A family, or `ALL`.
        k: Number of distractor sessions.
        episodes: Query episodes.
        hit: Share of them with a frame of the lesson chosen, with its 95% Wilson interval.
        purity: Mean purity, with its 95% BCa bootstrap interval over episodes; bounds are NaN for
            a single episode.
        coverage: Mean coverage, likewise.
        false_sessions: Mean number of false sessions, likewise.
        true_cuts: Borders between true sessions, in all its queries together.
        found_cuts: How many of them are borders of segments.
        false_cuts: Borders of segments inside true sessions.
    """

    rule: str
    family: str
    k: int
    episodes: int
    hit: Interval
    purity: Interval
    coverage: Interval
    false_sessions: Interval
    true_cuts: int
    found_cuts: int
    false_cuts: int

    @property
    def passed(self) -> bool:
        """Whether mean purity and mean coverage reach the pass mark."""
        return self.purity.value >= PASS_MARK and self.coverage.value >= PASS_MARK


def measure(buffer: Buffer, encoder: str, camera: str = "front") -> Measured:
    """Look up the embeddings of a buffer and of its first live observation, and compare them.

    Raises:
        MissingIndexError, StaleIndexError, FormatError: See `Buffer.embeddings`.
        InvalidOptionError: The buffer has no lesson, or has it in several parts.
    """
    embeddings = buffer.embeddings(encoder, camera)
    return Measured(
        buffer.episode_id,
        buffer.k,
        tuple(_true_session(session) for session in buffer.sessions),
        true_lesson(buffer),
        adjacent_cosines(embeddings),
        cosines(embeddings, buffer.query_embedding(encoder, camera)),
        buffer.query_index(encoder, camera).typical_cosine,
    )


def _true_session(session: Session) -> TrueSession:
    entry = session.entry
    stored = f"{entry.dataset}/{entry.episode_index}/{entry.start}-{entry.stop}x{entry.repeat}"
    return TrueSession(session.span, session.family, stored)


def grade(measured: Measured, rule: Rule) -> Grade:
    """Choose by a rule, its cut settled, and compare with the true sessions."""
    threshold = rule.threshold(measured.typical)
    choice = pick(
        measured.adjacent,
        measured.query_cosines,
        threshold=threshold,
        method=rule.method,
        lesson=measured.lesson,
        lot=lot_of(measured.episode_id, measured.k),
    )
    frames = choice.frames
    start, stop = measured.lesson
    of_lesson = int(((frames >= start) & (frames < stop)).sum())
    spans = [session.span for session in measured.sessions]
    starts = [first for first, _ in spans]
    borders, cuts = set(starts[1:]), {first for first, _ in choice.segments[1:]}
    touched = {spans[n] for n in np.searchsorted(starts, frames, side="right") - 1}
    return Grade(
        str(rule),
        threshold,
        measured.episode_id,
        measured.k,
        len(measured.query_cosines),
        len(choice.segments),
        int(frames[0]),
        int(frames[-1]) + 1,
        len(frames),
        of_lesson / len(frames),
        of_lesson / (stop - start),
        len(touched - {measured.lesson}),
        len(borders),
        len(borders & cuts),
        len(cuts - borders),
    )


def cells(grades: Sequence[Grade]) -> Iterator[Cell]:
    """Yield the cells of grades: by rule, then by family and last all together, then by k.

    Rules and families keep the order in which they first occur.
    """
    rules = dict.fromkeys(one.rule for one in grades)
    families = dict.fromkeys(one.episode_id.family for one in grades)
    for rule in rules:
        for family in [*families, ALL]:
            here = [g for g in grades if g.rule == rule and family in (ALL, g.episode_id.family)]
            for k in sorted({one.k for one in here}):
                yield _cell(rule, family, k, [one for one in here if one.k == k])


def _cell(rule: str, family: str, k: int, grades: Sequence[Grade]) -> Cell:
    count, hits = len(grades), sum(one.hit for one in grades)
    values = np.array([(g.purity, g.coverage, g.false_sessions) for g in grades], float)
    # One key: equal values have equal intervals, whatever the rule, family and k.
    drawn = Resampler(values, "retrieval").intervals([mean(column) for column in range(3)])
    hit = Interval(hits / count, *wilson(hits, count))
    purity, coverage, false_sessions = drawn
    return Cell(
        rule,
        family,
        k,
        count,
        hit,
        purity,
        coverage,
        false_sessions,
        sum(one.true_cuts for one in grades),
        sum(one.found_cuts for one in grades),
        sum(one.false_cuts for one in grades),
    )


def mean_of(grades: Iterable[Grade]) -> tuple[float, float]:
    """Return mean purity and mean coverage."""
    pairs = np.array([(one.purity, one.coverage) for one in grades], float)
    purity, coverage = pairs.mean(axis=0)
    return float(purity), float(coverage)
