"""Cut a history into segments where it stops resembling itself: pure.

The paper's rule: a cut wherever the cosine of adjacent frames is below a threshold.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Span = tuple[int, int]
"""First frame, and the one after the last."""

_DIGITS = 6
"""Cosines are rounded, so that frames that are equal tie on every machine."""

_SAMPLE = 1024


def cosines(embeddings: NDArray[np.floating], query: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the cosine of each embedding with one, `(T,) float32`.

    Args:
        embeddings: `(T, D)`, each of length 1.
        query: `(D,)`, of length 1.
    """
    rows = embeddings.astype(np.float32, copy=False)
    return np.round(rows @ query.astype(np.float32), _DIGITS)


def adjacent_cosines(embeddings: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the cosine of each frame with the next, `(T - 1,) float32`; none of no frames.

    Args:
        embeddings: `(T, D)`, each of length 1.
    """
    rows = embeddings.astype(np.float32, copy=False)
    return np.round(np.einsum("td,td->t", rows[:-1], rows[1:]), _DIGITS)


def closest_cosines(embeddings: NDArray[np.floating], span: Span) -> NDArray[np.float32]:
    """Return the cosine of each embedding with the closest one of a span, `(T,) float32`.

    Args:
        embeddings: `(T, D)`, each of length 1.
        span: At least one of them.
    """
    rows = embeddings.astype(np.float32, copy=False)
    return np.round(rows @ rows[slice(*span)].T, _DIGITS).max(axis=1)


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


def typical_cosine(episodes: int, read: Callable[[int], NDArray[np.float32]]) -> float:
    """Return the median cosine of two frames of different episodes.

    It tells what an encoder finds in two frames that have nothing to do with each other: near 1
    for SigLIP, which sees a robot at a table every time, and near 0 for a centred encoder. Every
    episode weighs the same: of each there are as many frames in an even sample of about 1024.

    Args:
        episodes: How many the pool holds.
        read: Returns the embeddings of one of them, `(T, D) float32`, each of length 1, T at
            least 1.

    Returns:
        From −1 to 1; 0 if there are fewer than two episodes.
    """
    if episodes < 2:
        return 0.0
    chosen = _middles(episodes, min(episodes, _SAMPLE))
    each = _SAMPLE // len(chosen)
    parts = [found[_middles(len(found), each)] for found in map(read, chosen)]
    sample = np.concatenate(parts)
    owner = np.repeat(np.arange(len(chosen)), each)
    pairs = (sample @ sample.T)[owner[:, None] < owner]
    return round(float(np.median(pairs)), 4)


def _middles(length: int, count: int) -> list[int]:
    """Return the middle of each of `count` equal parts of `range(length)`."""
    return [(2 * part + 1) * length // (2 * count) for part in range(count)]
