"""The methods of choosing a part of a history, by name: the released one and others; without IO.

A method cuts the history into segments and chooses among them, or chooses frames without cuts. Only
`oracle`, a reference, uses the true sessions.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from robomme_interference_data.constants import SAMPLE_FRAMES, UNIT_FRAMES
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.sampling import runs

from .measure import Similarities
from .segment import FrameSpan, highest_cosine

_CHANGE_FRAMES = UNIT_FRAMES
"""Frames on each side of a border that `changes` compares (ours): as many as a distractor unit has.

A change may take as long: with 16 frames it misses one of 40.
"""

_WINDOW_FRAMES = 128
"""Frames of a window unless a rule has another number (ours): 12.8 s."""

_FOLLOWING = 0.1
"""Quantile of a segment's adjacent cosines from which other frames count as similar (ours)."""


@dataclass(frozen=True)
class Parts:
    """What a method may choose from.

    Attributes:
        segments: The segments that may be chosen, in order; empty if the method does not cut.
        scores: Score of each of them; empty if the method has no scores.
        frames: The number of frames of the rule; 0 if the method has none.
    """

    segments: Sequence[FrameSpan]
    scores: Mapping[FrameSpan, float]
    frames: int

    def best(self, segments: Sequence[FrameSpan]) -> FrameSpan:
        """Return the segment with the highest score; of equal ones the first of `segments`."""
        return max(segments, key=lambda span: self.scores[span])


@dataclass(frozen=True)
class Method:
    """A method of choosing.

    Attributes:
        chooses: What it chooses, in words.
        choose: Returns the chosen spans in order, disjoint, at least one.
        sides: Number of frames on each side of a border whose means are compared to cut there, see
            `side_cosines`; None if it does not cut.
        frames: Number of frames that it chooses, or of a window, unless the rule has another; None
            if it has no such number. A method has `sides` or `frames`, or neither.
        score: Score of a segment, given the cosines of its frames with the first live observation.
    """

    chooses: str
    choose: Callable[[Similarities, Parts], Sequence[FrameSpan]]
    sides: int | None = None
    frames: int | None = None
    score: Callable[[NDArray[np.float32]], float] | None = None


def best_window(alike: NDArray[np.float32], frames: int, within: FrameSpan) -> FrameSpan:
    """Return the window around the frame that is most alike, inside a span.

    Of the windows of `frames` frames inside the span that hold that frame, it is the one with the
    highest mean; of equal ones the earliest. A shorter span is returned whole.

    Args:
        alike: Cosine of each frame with the first live observation, `(T,)`.
        frames: Frames of the window, at least 1.
        within: The span, at least one frame.
    """
    start, stop = within
    if stop - start <= frames:
        return within
    best = start + int(np.argmax(alike[start:stop]))
    first, last = max(start, best - frames + 1), min(best, stop - frames)
    windows = sliding_window_view(alike[first : last + frames], frames)
    means = np.round(windows.mean(axis=1, dtype=np.float64), 6)
    chosen = first + int(np.argmax(means))
    return chosen, chosen + frames


def best_windows(alike: NDArray[np.float32], frames: int, count: int) -> list[FrameSpan]:
    """Return the best windows one after another, each among the frames that are left, in order.

    Each is the `best_window` of the run of frames that are left which holds the most alike one of
    them, the earliest of equal ones. There are fewer than `count` if no frames are left.
    """
    left: list[FrameSpan] = [(0, len(alike))]
    chosen: list[FrameSpan] = []
    while left and len(chosen) < count:
        run = max(left, key=lambda span: alike[slice(*span)].max())
        window = best_window(alike, frames, run)
        left.remove(run)
        left += [span for span in ((run[0], window[0]), (window[1], run[1])) if span[0] < span[1]]
        left.sort()
        chosen.append(window)
    return sorted(chosen)


def _highest(values: NDArray[np.float32]) -> float:
    return float(values.max())


def _mean(values: NDArray[np.float32]) -> float:
    return float(np.round(values.mean(dtype=np.float64), 6))


def _best(measured: Similarities, parts: Parts) -> list[FrameSpan]:
    return [parts.best(parts.segments)]


def _joined(measured: Similarities, parts: Parts) -> list[FrameSpan]:
    """Return the best segment, and all segments with a similar frame."""
    first = parts.best(parts.segments)
    following = measured.adjacent[first[0] : first[1] - 1]
    if not len(following):  # a single frame has no adjacent cosine
        return [first]
    limit = np.quantile(following, _FOLLOWING, method="lower")
    rows = measured.embeddings()
    inside = rows[slice(*first)]
    return [
        span
        for span in parts.segments
        if span == first or highest_cosine(rows[slice(*span)], inside) >= limit
    ]


def _random(measured: Similarities, parts: Parts) -> list[FrameSpan]:
    seed = f"robomme-interference random\n{measured.episode_id} {measured.condition}"
    number = int.from_bytes(sha256(seed.encode()).digest())
    return [parts.segments[number % len(parts.segments)]]


def _closest(measured: Similarities, parts: Parts) -> Sequence[FrameSpan]:
    closest = np.argsort(-measured.alike, kind="stable")[: parts.frames]
    return runs(np.sort(closest).tolist())


def _oracle(measured: Similarities, parts: Parts) -> list[FrameSpan]:
    if not measured.lesson:
        name = f"{measured.episode_id} under {measured.condition}"
        raise InvalidOptionError(f"{name}: oracle needs a lesson, and the history holds none")
    return [measured.lesson[0]]


METHODS = {
    "max": Method(
        "the segment with the frame closest to the first live observation (released rule)",
        _best,
        sides=1,
        score=_highest,
    ),
    "latest": Method(
        "the segment of max, or the last segment with an equally close frame",
        lambda measured, parts: [parts.best(parts.segments[::-1])],
        sides=1,
        score=_highest,
    ),
    "joined": Method(
        "the segment of max, and all segments with a similar frame (ours)",
        _joined,
        sides=1,
        score=_highest,
    ),
    "mean": Method(
        "the segment with the highest mean cosine with the first live observation",
        _best,
        sides=1,
        score=_mean,
    ),
    "changes": Method(
        f"as max, of segments cut where the means of {_CHANGE_FRAMES} frames before and after "
        "differ most (ours)",
        _best,
        sides=_CHANGE_FRAMES,
        score=_highest,
    ),
    "window": Method(
        "the frames in a row around the closest frame with the highest mean cosine, without "
        "segments (ours)",
        lambda measured, parts: best_windows(measured.alike, parts.frames, 1),
        frames=_WINDOW_FRAMES,
    ),
    "windows3": Method(
        "the window of window, and twice more that of the frames that are left (ours)",
        lambda measured, parts: best_windows(measured.alike, parts.frames, 3),
        frames=_WINDOW_FRAMES,
    ),
    "top": Method(
        "the frames closest to the first live observation, without segments",
        _closest,
        frames=SAMPLE_FRAMES,
    ),
    "last": Method("the last segment", lambda measured, parts: [parts.segments[-1]], sides=1),
    "random": Method("a random segment", _random, sides=1),
    "oracle": Method("the true lesson, or its first part", _oracle),
}
"""The methods. Ties go to the earliest segment or frame, except for `latest`; segments of fewer
than `MIN_FRAMES` frames are skipped.

`joined` finds a session that is in several parts: two frames are similar if their cosine reaches
that of nine in ten adjacent frames of the segment of `max`.
"""
