"""Evidence: which frames of a lesson show a part of the hidden answer, and where in a buffer: pure.

A span is recorded with its episode; where no source says what a frame shows, evidence is unknown
(None), never guessed.
"""

from bisect import bisect_left
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

from .manifest import Session, SessionEntry
from .records import EvidenceSpan

_TEACHING = ("lesson", "contradiction")
"""Roles of sessions that are a lesson: of such a one evidence is known, or it is not."""


@dataclass(frozen=True)
class Evidence:
    """An evidence span, or as much of it as a session holds, in its place in a buffer.

    Attributes:
        start: First frame in the buffer.
        stop: Frame after its last one.
        session: The session that it is in: it may be a contradicting lesson.
        span: The whole span as it is stored.
    """

    start: int
    stop: int
    session: Session
    span: EvidenceSpan

    def to_dict(self) -> dict[str, Any]:
        """Return plain values: part, text, session and frames in the buffer."""
        told = {"part": self.span.part, "text": self.span.text, "role": self.session.role}
        return told | {"start": self.start, "stop": self.stop}

    def seen(self, frames: Iterable[int]) -> bool:
        """Whether any of some frames of the buffer shows it."""
        return any(self.start <= frame < self.stop for frame in frames)


def spans_of_parts(
    shown: Iterable[Iterable[int]], parts: Sequence[str]
) -> tuple[EvidenceSpan, ...]:
    """Return the spans of a lesson, by part and then by place.

    Args:
        shown: Of each frame, in order, the numbers of the parts that it shows.
        parts: The parts in words.
    """
    frames = [frozenset(one) for one in shown]
    return tuple(
        EvidenceSpan(part, text, start, stop)
        for part, text in enumerate(parts)
        for seen, start, stop in _runs(part in one for one in frames)
        if seen
    )


def spans_of_texts(texts: Iterable[str]) -> tuple[EvidenceSpan, ...] | None:
    """Return the spans of a lesson of which each frame has a text: a run of equal ones is a part.

    Empty texts are none, and so is `static`, which RoboMME writes where the robot does nothing.

    Returns:
        The spans, parts numbered in their order; None where no text says anything: then what
        the frames show is unknown.
    """
    runs = [run for run in _runs(one.strip() for one in texts) if run[0] not in ("", "static")]
    spans = (EvidenceSpan(part, *run) for part, run in enumerate(runs))
    return tuple(spans) or None


def map_evidence(
    sessions: Iterable[Session], recorded: Callable[[SessionEntry], Sequence[EvidenceSpan] | None]
) -> tuple[Evidence, ...] | None:
    """Return the evidence of a buffer, session by session; None if that of a lesson is unknown.

    Args:
        sessions: The buffer's sessions; any may hold a part of a lesson, or repeat its frames.
        recorded: From a session to the evidence of its stored episode, None where unknown.
    """
    placed: list[Evidence] = []
    for session in sessions:
        entry, spans = session.entry, recorded(session.entry)
        if spans is None and session.role in _TEACHING:
            return None
        for span in spans or ():
            start, stop = max(span.start, entry.start), min(span.stop, entry.stop)
            if start < stop:
                first, last = (
                    session.start + (at - entry.start) * entry.repeat for at in (start, stop)
                )
                placed.append(Evidence(first, last, session, span))
    return tuple(placed)


def among(evidence: Iterable[Evidence], frames: Sequence[int]) -> tuple[Evidence, ...]:
    """Return the evidence that some frames of a buffer show, in its places among these frames.

    Args:
        evidence: The buffer's evidence, in order.
        frames: Indices in the buffer, ascending.
    """
    places = ((bisect_left(frames, one.start), bisect_left(frames, one.stop)) for one in evidence)
    shown = zip(evidence, places, strict=True)
    return tuple(replace(one, start=a, stop=b) for one, (a, b) in shown if a < b)


def known_parts(evidence: Sequence[Evidence], kept: Collection[int]) -> dict[int, str]:
    """Return the parts of the answer that some frames show, in words, what is newer first.

    Of two sessions that show the same part the later one counts, whatever its role.

    Args:
        evidence: A buffer's evidence, in order.
        kept: Frames of the buffer.
    """
    found: dict[int, str] = {}
    for one in reversed(evidence):
        if one.seen(kept):
            found.setdefault(one.span.part, one.span.text)
    return found


def _runs[T](values: Iterable[T]) -> Iterator[tuple[T, int, int]]:
    """Yield each run of equal values: the value, its first place, and the one after its last."""
    stop = 0
    for value, run in groupby(values):
        start, stop = stop, stop + len(list(run))
        yield value, start, stop
