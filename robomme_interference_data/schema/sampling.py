"""What a sample of a history holds, whatever sessions the history is made of: pure."""

from bisect import bisect_left
from collections.abc import Callable, Collection, Iterable, Sequence
from itertools import groupby

from robomme_interference_data.constants import SAMPLE_FRAMES
from robomme_interference_data.errors import UnknownNameError

from .evidence import Evidence
from .manifest import Session


def even_sample(history_frames: int, frames: int = SAMPLE_FRAMES) -> list[int]:
    """Return the frames that an even sample takes at the first step: FrameSamp's rule.

    The sample is of the history and the first live observation together: all frames while there
    are fewer than 32, else those at the integer `linspace(0, t, 32)`, t being the index of the
    live observation.

    Args:
        history_frames: Frames of the history buffer; also the index of the live observation.
        frames: Frames of the sample, the live one among them, 2 or more; FrameSamp has 32.

    Returns:
        Indices, ascending; the last one is the live observation's.
    """
    if history_frames + 1 < frames:
        return list(range(history_frames + 1))
    # Exact integers: index j of linspace(0, t, n) is floor(j·t / (n − 1)).
    return [j * history_frames // (frames - 1) for j in range(frames)]


MEMORIES: dict[str, Callable[..., Sequence[int]]] = {
    "full": lambda live, frames=SAMPLE_FRAMES: range(live),
    "framesamp": lambda live, frames=SAMPLE_FRAMES: even_sample(live, frames)[:-1],
    "window": lambda live, frames=SAMPLE_FRAMES: range(max(0, live - frames + 1), live),
}
"""Memory rule: which frames it keeps when the live observation has index `live`, itself apart.

Also given how many it may keep, the live one among them, 32 unless told. `full` keeps all;
`framesamp` all while they are fewer than that with the live one, else those of the integer
`linspace(0, live, 32)` (the released FrameSamp's rule); `window` the last ones.
"""


def check_memory(name: str, of: str) -> None:
    """Check that there is a memory rule.

    Args:
        name: Its name.
        of: Who is asked for it, for the message.
    """
    if name not in MEMORIES:
        raise UnknownNameError.among("memory", name, of, MEMORIES)


def spread(start: int, stop: int, count: int) -> list[int]:
    """Return at most `count` evenly spread indices from `start` to `stop` (excluded).

    The first and the last frame are among them, unless `count` is 1.
    """
    last = stop - start - 1
    count = min(count, last + 1)
    return [start + j * last // max(count - 1, 1) for j in range(count)]


def runs(frames: Iterable[int]) -> tuple[tuple[int, int], ...]:
    """Return each run of consecutive indices: the first, and the one after the last.

    Args:
        frames: Indices, ascending.
    """
    found = []
    for _, run in groupby(enumerate(frames), lambda pair: pair[1] - pair[0]):
        indices = [index for _, index in run]
        found.append((indices[0], indices[-1] + 1))
    return tuple(found)


def lesson_frames(sessions: Iterable[Session], frames: Sequence[int]) -> int:
    """Count those of some frames of a buffer that are of the lesson.

    Args:
        sessions: The buffer's sessions.
        frames: Indices in the buffer, ascending.
    """
    lessons = (session for session in sessions if session.role == "lesson")
    return sum(bisect_left(frames, one.stop) - bisect_left(frames, one.start) for one in lessons)


def lesson_share(sessions: Iterable[Session], frames: Sequence[int]) -> float:
    """Return the share of lesson frames, 0 to 1, in an even sample of what is given of a buffer.

    The live observation that follows is the sample's last frame, and is no lesson.

    Args:
        sessions: The buffer's sessions.
        frames: What is given: indices in the buffer, ascending.
    """
    *sample, _ = even_sample(len(frames))
    return lesson_frames(sessions, [frames[place] for place in sample]) / (len(sample) + 1)


def evidence_kept(evidence: Iterable[Evidence], kept: Collection[int]) -> float | None:
    """Return the share of a lesson's evidence spans of which at least one frame is kept, 0 to 1.

    A span that several sessions show, such as two halves of the lesson, counts once; what a
    contradicting lesson shows does not count.

    Args:
        evidence: The buffer's evidence.
        kept: Frames of the buffer that a sample holds.

    Returns:
        The share; None where there is no evidence to keep.
    """
    found: dict[object, bool] = {}
    for one in evidence:
        if one.session.role != "contradiction":
            key = one.session.source, one.span
            found[key] = found.get(key, False) or one.seen(kept)
    return sum(found.values()) / len(found) if found else None
