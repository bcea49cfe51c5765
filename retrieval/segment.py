"""Cut a history into segments where it stops resembling itself: pure.

The paper's rule: a cut wherever the cosine of adjacent frames is below a threshold. 0.923 is the
threshold for its encoder alone; `adaptive_threshold` gives one for any encoder.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import InvalidOptionError

__all__ = [
    "MIN_FRAMES",
    "Span",
    "adaptive_threshold",
    "adjacent_cosines",
    "cosines",
    "segments",
    "typical_cosine",
]

Span = tuple[int, int]
"""First frame, and the one after the last."""

MIN_FRAMES = 4
"""Frames of the shortest segment that may be chosen (released reference)."""

_BLOCK = 4096
"""Embeddings that are held as float32 at a time."""

_DIGITS = 6
"""Cosines are rounded, so that frames that are equal tie on every machine."""

_SAMPLE = 1024


def cosines(
    embeddings: NDArray[np.float16], query: NDArray[np.floating], block: int = _BLOCK
) -> NDArray[np.float32]:
    """Return the cosine of each embedding with one, `(T,) float32`, in bounded memory.

    Args:
        embeddings: `(T, D) float16`, each of length 1; may be a memory map.
        query: `(D,)`, of length 1.
        block: Embeddings that are held as float32 at a time.
    """
    wanted = query.astype(np.float32)
    out = np.empty(len(embeddings), np.float32)
    for first in range(0, len(embeddings), block):
        rows = embeddings[first : first + block].astype(np.float32)
        out[first : first + block] = rows @ wanted
    return np.round(out, _DIGITS)


def adjacent_cosines(embeddings: NDArray[np.float16], block: int = _BLOCK) -> NDArray[np.float32]:
    """Return the cosine of each frame with the next, `(T - 1,) float32`, in bounded memory.

    Args:
        embeddings: `(T, D) float16`, each of length 1; may be a memory map.
        block: Embeddings that are held as float32 at a time.
    """
    out = np.empty(max(len(embeddings) - 1, 0), np.float32)
    for first in range(0, len(out), block):
        rows = embeddings[first : first + block + 1].astype(np.float32)
        out[first : first + block] = np.einsum("td,td->t", rows[:-1], rows[1:])
    return np.round(out, _DIGITS)


def segments(adjacent: NDArray[np.float32], threshold: float) -> tuple[Span, ...]:
    """Cut between frames t and t + 1 where `adjacent[t]` is below the threshold.

    Args:
        adjacent: Cosine of each frame with the next, `(T - 1,)`; T is at least 1.
        threshold: From −1 (no cut) to more than 1 (a cut after every frame).

    Returns:
        The segments in order; together they are all frames.
    """
    starts = [0, *(np.flatnonzero(adjacent < threshold) + 1).tolist()]
    stops = [*starts[1:], len(adjacent) + 1]
    return tuple(zip(starts, stops, strict=True))


def typical_cosine(episodes: Sequence[NDArray[np.float16]]) -> float:
    """Return the median cosine of two frames of different episodes.

    It tells what an encoder finds in two frames that have nothing to do with each other: near 1
    for SigLIP, which sees a robot at a table every time, and near 0 for a centred encoder. Every
    episode weighs the same: of each there are as many frames in an even sample of about 1024.

    Args:
        episodes: The train pool: of each episode `(T, D) float16`, each of length 1, T at least 1;
            may be memory maps.

    Returns:
        From −1 to 1; 0 if there are fewer than two episodes.
    """
    if len(episodes) < 2:
        return 0.0
    chosen = [episodes[n] for n in _middles(len(episodes), min(len(episodes), _SAMPLE))]
    each = _SAMPLE // len(chosen)
    sample = np.concatenate([one[_middles(len(one), each)] for one in chosen]).astype(np.float32)
    owner = np.repeat(np.arange(len(chosen)), each)
    pairs = (sample @ sample.T)[owner[:, None] < owner]
    return round(float(np.median(pairs)), 4)


def _middles(length: int, count: int) -> list[int]:
    """Return the middle of each of `count` equal parts of `range(length)`."""
    return [(2 * part + 1) * length // (2 * count) for part in range(count)]


def adaptive_threshold(typical: float) -> float:
    """Return the cut that is halfway from what unrelated frames share (`typical`) to equality.

    Ours. It has no free parameter, and knows the train pool but no test episode; with it, a
    threshold need not be fitted for every encoder.

    Raises:
        InvalidOptionError: `typical` is no cosine.
    """
    if not -1 <= typical <= 1:
        raise InvalidOptionError(f"typical cosine {typical}; expected −1 to 1")
    return (1 + typical) / 2


def long_enough(spans: tuple[Span, ...], least: int = MIN_FRAMES) -> Iterator[Span]:
    """Yield the segments of at least `least` frames; all of them if none is so long (ours)."""
    kept = [span for span in spans if span[1] - span[0] >= least]
    yield from kept or spans
