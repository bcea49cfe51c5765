"""Evidence: which frames of a lesson show parts of the hidden answer, and where in a buffer.

Spans are recorded with their episode. If the source does not label frames, evidence is None.
"""

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

from .manifest import TEACHING, Session, SessionEntry
from .records import EvidenceSpan


@dataclass(frozen=True)
class Evidence:
    """An evidence span, or the part of it in a session, with its frame range in a buffer.

    Attributes:
        start: Index of its first frame in the buffer.
        stop: Index after its last frame.
        session: Its session, which may be a contradicting lesson.
        span: The whole stored span.
    """

    start: int
    stop: int
    session: Session
    span: EvidenceSpan

    def to_dict(self) -> dict[str, Any]:
        """Return plain values: part, text, role and frames in the buffer."""
        span = {"part": self.span.part, "text": self.span.text, "role": self.session.role}
        return span | {"start": self.start, "stop": self.stop}

    def seen(self, frames: Iterable[int]) -> bool:
        """Return whether one of these frames of the buffer shows it."""
        return any(self.start <= frame < self.stop for frame in frames)


def spans_of_parts(
    shown: Iterable[Iterable[int]], parts: Sequence[str]
) -> tuple[EvidenceSpan, ...]:
    """Return the spans of a lesson from the parts that each frame shows, by part and then frame.

    `parts` has the texts of the parts.
    """
    frames = [frozenset(parts) for parts in shown]
    return tuple(
        EvidenceSpan(part, text, start, stop)
        for part, text in enumerate(parts)
        for seen, start, stop in _runs(part in parts for parts in frames)
        if seen
    )


def spans_of_texts(texts: Iterable[str]) -> tuple[EvidenceSpan, ...] | None:
    """Return the spans of a lesson from a text per frame: each run of equal texts is a part.

    Empty texts and `static`, which RoboMME writes while the robot rests, are ignored. Returns None
    if no text is left.
    """
    runs = [run for run in _runs(text.strip() for text in texts) if run[0] not in ("", "static")]
    spans = (EvidenceSpan(part, *run) for part, run in enumerate(runs))
    return tuple(spans) or None


def map_evidence(
    sessions: Iterable[Session], recorded: Callable[[SessionEntry], Sequence[EvidenceSpan] | None]
) -> tuple[Evidence, ...] | None:
    """Return the evidence of a buffer, session by session; None if that of a lesson is unknown.

    `recorded` returns the evidence of the stored episode of a session.
    """
    mapped: list[Evidence] = []
    for session in sessions:
        entry, spans = session.entry, recorded(session.entry)
        # A unit's frames show nothing of the answer, whether its source labels frames or not.
        if spans is None and session.role in TEACHING:
            return None
        for span in spans or ():
            start, stop = max(span.start, entry.start), min(span.stop, entry.stop)
            if start < stop:
                first, last = (
                    session.start + (at - entry.start) * entry.repeat for at in (start, stop)
                )
                mapped.append(Evidence(first, last, session, span))
    return tuple(mapped)


def evidence_among(evidence: Iterable[Evidence], frames: Sequence[int]) -> tuple[Evidence, ...]:
    """Return the evidence in a selection of frames, with frame ranges in that selection.

    `frames` are indices in the buffer, ascending.
    """
    ranges = (
        (bisect_left(frames, entry.start), bisect_left(frames, entry.stop)) for entry in evidence
    )
    shown = zip(evidence, ranges, strict=True)
    return tuple(replace(entry, start=a, stop=b) for entry, (a, b) in shown if a < b)


def known_parts(
    evidence: Sequence[Evidence],
    kept: Collection[int],
    frames: int = 1,
    *,
    first_counts: bool = False,
) -> dict[int, str]:
    """Return the texts of the parts of the answer that frames of the buffer show, newest first.

    If two sessions show the same part, the later one counts, regardless of its role; the earlier
    one if `first_counts`, because the goal says so. A part is known if at least `frames` of the
    kept frames show it.
    """
    counts = Counter[tuple[int, str]]()
    for entry in evidence:
        counts[entry.span.part, entry.span.text] += sum(
            entry.start <= frame < entry.stop for frame in kept
        )
    texts: dict[int, str] = {}
    # What shows a part and is set first stays.
    for entry in evidence if first_counts else reversed(evidence):
        if counts[entry.span.part, entry.span.text] >= frames and entry.seen(kept):
            texts.setdefault(entry.span.part, entry.span.text)
    return texts


def _runs[T](values: Iterable[T]) -> Iterator[tuple[T, int, int]]:
    """Yield each run of equal values: the value, its first index, and the index after its last."""
    stop = 0
    for value, run in groupby(values):
        start, stop = stop, stop + len(list(run))
        yield value, start, stop
