"""Samples of a history's frames, and what they contain of lesson and evidence."""

from bisect import bisect_left
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Annotated, Self

from robomme_interference_data.constants import SAMPLE_FRAMES
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError

from .manifest import Session

if TYPE_CHECKING:
    from .evidence import Evidence


def even_sample(history_frames: int, frames: int = SAMPLE_FRAMES) -> list[int]:
    """Return the ascending frame indices of an even sample at the first step: FrameSamp's rule.

    The sample is of the history and the first live observation, whose index `history_frames` is
    the last one: all frames if they are fewer than `frames`, else the integer
    `linspace(0, history_frames, frames)`.
    """
    if history_frames + 1 < frames:
        return list(range(history_frames + 1))
    # Exact integers: index j of linspace(0, t, n) is floor(j·t / (n − 1)).
    return [j * history_frames // (frames - 1) for j in range(frames)]


MEMORIES: dict[str, Callable[[int, int], Sequence[int]]] = {
    "full": lambda live, frames: range(live),
    "framesamp": lambda live, frames: even_sample(live, frames)[:-1],
    "window": lambda live, frames: range(max(0, live - frames + 1), live),
}
"""By name, functions from the index of the live observation to the earlier frames in memory.

The second argument is the size of the memory, with the live observation. `full` keeps all frames,
`framesamp` those of `even_sample`, `window` the last ones.
"""

MEMORY_FORM = "full, framesamp:N or window:N (N: 32)"
"""The spelling of a memory, for help and messages."""


@dataclass(frozen=True)
class Memory:
    """A memory rule and its size; `str()` is its one spelling: `full`, `framesamp:32`.

    Attributes:
        rule: One of `MEMORIES`.
        frames: Size with the live observation, at least 2; `full` has no limit.
    """

    rule: str
    frames: int = SAMPLE_FRAMES

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `full`, `framesamp:32` or `window:32`; the size is 32 if it is left out.

        Raises:
            UnknownNameError: There is no such rule.
            InvalidOptionError: The size is not a whole number from 2.
        """
        rule, colon, frames = text.partition(":")
        if rule not in MEMORIES:
            raise UnknownNameError.among("memory", rule, "the memory rules", MEMORIES)
        sized = rule != "full" and frames.isascii() and frames.isdigit() and int(frames) > 1
        if colon and not sized:
            raise InvalidOptionError.expected("memory", text, f"{MEMORY_FORM}, N from 2")
        return cls(rule, int(frames)) if colon else cls(rule)

    def earlier(self, live: int) -> Sequence[int]:
        """Return the ascending indices of the frames in memory before the live observation.

        Args:
            live: Index of the live observation: number of frames of history and rollout before it.
        """
        return MEMORIES[self.rule](live, self.frames)

    def kept(self, given: Sequence[int]) -> list[int]:
        """Return which of the frames of a history are in memory at the first live observation."""
        return [given[place] for place in self.earlier(len(given))]

    @property
    def label(self) -> str:
        """The name in labels of rows: the rule, and a size other than 32, as in `window8`."""
        usual = self.rule == "full" or self.frames == SAMPLE_FRAMES
        return self.rule if usual else f"{self.rule}{self.frames}"

    def __str__(self) -> str:
        return self.rule if self.rule == "full" else f"{self.rule}:{self.frames}"


def spread(start: int, stop: int, count: int) -> list[int]:
    """Return up to `count` evenly spread indices from `start` to `stop` (excluded), ends included.

    If `count` is 1, that is `start`.
    """
    last = stop - start - 1
    count = min(count, last + 1)
    return [start + j * last // max(count - 1, 1) for j in range(count)]


def runs(frames: Iterable[int]) -> tuple[tuple[int, int], ...]:
    """Return start and stop (excluded) of each run of consecutive numbers in ascending indices."""
    spans = []
    # Within a run, number and place differ by the same amount.
    for _, run in groupby(enumerate(frames), lambda pair: pair[1] - pair[0]):
        indices = [index for _, index in run]
        spans.append((indices[0], indices[-1] + 1))
    return tuple(spans)


def lesson_frames(sessions: Iterable[Session], frames: Sequence[int]) -> int:
    """Count the lesson frames among ascending indices of a buffer's frames."""
    lessons = (session for session in sessions if session.role == "lesson")
    return sum(
        bisect_left(frames, lesson.stop) - bisect_left(frames, lesson.start) for lesson in lessons
    )


def lesson_share(sessions: Iterable[Session], frames: Sequence[int]) -> float:
    """Return the share of lesson frames, 0 to 1, in an even sample of frames of a buffer.

    The sample ends with the live observation, which is not a lesson frame. `frames` are ascending
    indices in the buffer.
    """
    *sample, _ = even_sample(len(frames))
    return lesson_frames(sessions, [frames[index] for index in sample]) / (len(sample) + 1)


def evidence_kept(evidence: "Iterable[Evidence]", kept: Collection[int]) -> float | None:
    """Return the share of a lesson's evidence spans with a kept frame, 0 to 1; None without any.

    A span in several sessions, such as the halves of a lesson, counts once; spans of contradicting
    lessons do not count. `kept` are indices of frames in the buffer.
    """
    seen: dict[object, bool] = {}
    for entry in evidence:
        if entry.session.role != "contradiction":
            key = entry.session.source, entry.span
            seen[key] = seen.get(key, False) or entry.seen(kept)
    return sum(seen.values()) / len(seen) if seen else None


@dataclass(frozen=True, kw_only=True)
class HistoryColumns:
    """The columns of rows that describe the history that a system got, and what its memory kept."""

    history_frames: Annotated[int, "History frames that the policy received."]
    lesson_frames: Annotated[int, "Lesson frames among them."]
    lesson_share: Annotated[
        float | None,
        "Share of lesson frames in an even 32-frame sample of the received history and the first "
        "live observation; None without history.",
    ]
    evidence_kept: Annotated[
        float | None,
        "Share of the lesson's evidence spans with a frame in the system's memory at the first "
        "step; None if unknown or without a lesson.",
    ] = None
