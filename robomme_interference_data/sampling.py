"""What a sample of a history holds, whatever sessions the history is made of: pure."""

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from functools import partial

from robomme_interference_data.constants import SAMPLE_FRAMES
from robomme_interference_data.records import Session


def even_sample(history_frames: int) -> list[int]:
    """Return the frames that an even sample takes at the first step: FrameSamp's rule.

    The sample is of the history and the first live observation together: all frames while there
    are fewer than 32, else those at the integer `linspace(0, t, 32)`, t being the index of the
    live observation.

    Args:
        history_frames: Frames of the history buffer; also the index of the live observation.

    Returns:
        Indices, ascending; the last one is the live observation's.
    """
    if history_frames + 1 < SAMPLE_FRAMES:
        return list(range(history_frames + 1))
    # Exact integers: index j of linspace(0, t, n) is floor(j·t / (n − 1)).
    return [j * history_frames // (SAMPLE_FRAMES - 1) for j in range(SAMPLE_FRAMES)]


def spread(start: int, stop: int, count: int) -> list[int]:
    """Return at most `count` evenly spread indices from `start` to `stop` (excluded).

    The first and the last frame are among them, unless `count` is 1.
    """
    last = stop - start - 1
    count = min(count, last + 1)
    return [start + j * last // max(count - 1, 1) for j in range(count)]


def lesson_frames(sessions: Iterable[Session], start: int, stop: int) -> int:
    """Count the frames of a span of a buffer that are of the lesson.

    Args:
        sessions: The buffer's sessions.
        start: First frame of the span.
        stop: Frame after its last one.
    """
    lessons = (session for session in sessions if session.role == "lesson")
    return sum(max(0, min(one.stop, stop) - max(one.start, start)) for one in lessons)


def lesson_share(sessions: Sequence[Session], start: int, stop: int) -> float:
    """Return the share of lesson frames, 0 to 1, in an even sample of a span of a buffer.

    The live observation after the span is the sample's last frame, and is no lesson.

    Args:
        sessions: The buffer's sessions.
        start: First frame of the span.
        stop: Frame after its last one.
    """
    sample = even_sample(stop - start)
    before = partial(bisect_left, sample, hi=len(sample) - 1)
    lessons = (one for one in sessions if one.role == "lesson")
    inside = sum(before(one.stop - start) - before(one.start - start) for one in lessons)
    return inside / len(sample)
