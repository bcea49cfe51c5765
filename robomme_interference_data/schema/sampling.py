"""Samples of a history's frames, and what they contain of lesson and evidence."""

import re
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import groupby
from typing import TYPE_CHECKING, Annotated, Self

from robomme_interference_data.constants import FPS, SAMPLE_FRAMES
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


def _window(live: int, frames: int, rate: Fraction) -> list[int]:
    """Return the last frames at `rate` per second, before the live observation."""
    # Exact integers: a kept frame is up / down places older than the next one, rounded up.
    up, down = (FPS / rate).as_integer_ratio()
    most = min(frames - 1, live * down // up)
    return [live - (j * up + down - 1) // down for j in range(most, 0, -1)]


MEMORIES: dict[str, Callable[[int, int, Fraction], Sequence[int]]] = {
    "full": lambda live, frames, rate: range(live),
    "framesamp": lambda live, frames, rate: even_sample(live, frames)[:-1],
    "window": _window,
}
"""By name, functions from the index of the live observation to the earlier frames in memory.

The second argument is the size of the memory, with the live observation; the third one its frames
per second. `full` keeps all frames, `framesamp` those of `even_sample`, `window` the last ones.
"""

MEMORY_FORM = "full, framesamp:N, window:N or window:SECONDS@FPS (N: 32)"
"""The spelling of a memory, for help and messages."""

_DECIMAL = r"[0-9]{1,6}(?:\.[0-9]{1,6})?"
_TIMED = re.compile(f"(?P<seconds>{_DECIMAL})@(?P<rate>{_DECIMAL})", re.ASCII)


@dataclass(frozen=True)
class Memory:
    """A memory rule and its size; `str()` is its one spelling: `full`, `window:32`, `window:60@2`.

    `window:SECONDS@FPS` keeps the live observation and, for j = 1, 2, … while j / FPS is below
    SECONDS, the newest frame that is at least j / FPS seconds older: SECONDS × FPS frames in all,
    or fewer if the history is shorter. `window:2.5@2` keeps frames 0, 0.5, 1, 1.5 and 2 s old.

    A second is ten frames of what the policy received, whatever the time stamps of recordings are.
    Policies receive frames in order, without time stamps, and published windows count frames:
    SimpleMemVLA keeps one of `native_video_fps / history_video_fps`, LeRobot's pi05 one of
    `memory_stride`. So the 32 frames of a distractor unit, recorded 0.8 s apart, take 3.2 s of a
    window, and its 256 frames at full rate (`raw`) 25.6 s. For a policy that counts 20 frames as a
    second, double SECONDS and halve FPS: its last 60 s at 2 frames per second are `window:120@1`.

    Attributes:
        rule: One of `MEMORIES`.
        frames: Size with the live observation, at least 2; `full` has no limit.
        rate: Frames kept per second, above 0 and at most 10, which is all; 10 unless the rule is
            `window`.
    """

    rule: str
    frames: int = SAMPLE_FRAMES
    rate: Fraction = Fraction(FPS)

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `full`, `framesamp:32`, `window:32` or `window:60@2`; the size is 32 by default.

        Seconds and frames per second are exact decimal numbers. At 10 frames per second `window`
        keeps every frame, and its spelling is `window:N`.

        Raises:
            UnknownNameError: There is no such rule.
            InvalidOptionError: The size is not a whole number from 2, or there are more than 10
                frames per second.
        """
        rule, colon, size = text.partition(":")
        if rule not in MEMORIES:
            raise UnknownNameError.among("memory", rule, "the memory rules", MEMORIES)
        if not colon:
            return cls(rule)
        timed = _TIMED.fullmatch(size) if rule == "window" else None
        if timed is not None:
            return cls(rule, *_frames_and_rate(text, *map(Fraction, timed.groups())))
        if rule == "full" or not (size.isascii() and size.isdigit() and int(size) > 1):
            raise InvalidOptionError.expected("memory", text, f"{MEMORY_FORM}, N from 2")
        return cls(rule, int(size))

    def earlier(self, live: int) -> Sequence[int]:
        """Return the ascending indices of the frames in memory before the live observation.

        Args:
            live: Index of the live observation: number of frames of history and rollout before it.
        """
        return MEMORIES[self.rule](live, self.frames, self.rate)

    def kept(self, given: Sequence[int]) -> list[int]:
        """Return which of the frames of a history are in memory at the first live observation."""
        return [given[place] for place in self.earlier(len(given))]

    @property
    def label(self) -> str:
        """The name in labels of rows: `full`, `window`, `window8` or `window60s2fps`.

        A size of 32 frames is left out.
        """
        if self.rate != FPS:
            seconds, rate = self._timed()
            return f"{self.rule}{seconds}s{rate}fps"
        usual = self.rule == "full" or self.frames == SAMPLE_FRAMES
        return self.rule if usual else f"{self.rule}{self.frames}"

    def __str__(self) -> str:
        if self.rule == "full":
            return self.rule
        return f"{self.rule}:{self.frames if self.rate == FPS else '@'.join(self._timed())}"

    def _timed(self) -> tuple[str, str]:
        """Return seconds and frames per second as decimal numbers."""
        return _decimal(self.frames / self.rate), _decimal(self.rate)


def _frames_and_rate(text: str, seconds: Fraction, rate: Fraction) -> tuple[int, Fraction]:
    """Return number and rate of the frames of a window, given its seconds and its rate."""
    frames = seconds * rate
    if rate > FPS:
        expected = f"at most {FPS} frames per second: a buffer has no more"
        raise InvalidOptionError.expected("memory", text, expected)
    if frames < 2 or frames.denominator != 1:
        made = f"{_decimal(seconds)} s with {_decimal(rate)} frames per second"
        expected = f"a whole number of frames from 2: {made} are {_decimal(frames)}"
        raise InvalidOptionError.expected("memory", text, expected)
    return int(frames), rate


def _decimal(number: Fraction) -> str:
    """Return a number with at most twelve decimal places, exactly: `60`, `2.5`."""
    return f"{number:.12f}".rstrip("0").rstrip(".")


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
