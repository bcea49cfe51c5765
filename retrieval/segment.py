"""Cut a history into segments where adjacent frames differ; without IO.

The paper's rule: cut wherever the cosine of adjacent frames is below a threshold.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

FrameSpan = tuple[int, int]
"""First frame, and the one after the last."""

_DIGITS = 6
"""Cosines are rounded, so that equal frames tie on every machine."""

_SAMPLE = 1024


def cosines(embeddings: NDArray[np.floating], query: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the cosine of each embedding, `(T, D)`, with `query`, `(D,)`; all of length 1."""
    rows = embeddings.astype(np.float32, copy=False)
    return np.round(rows @ query.astype(np.float32), _DIGITS)


def adjacent_cosines(embeddings: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the cosine of each embedding, `(T, D)`, with the next, `(T - 1,) float32`."""
    rows = embeddings.astype(np.float32, copy=False)
    return np.round(np.einsum("td,td->t", rows[:-1], rows[1:]), _DIGITS)


def closest_cosines(embeddings: NDArray[np.floating], span: FrameSpan) -> NDArray[np.float32]:
    """Return the cosine of each embedding with the closest one of a span, `(T,) float32`."""
    rows = embeddings.astype(np.float32, copy=False)
    return np.round(rows @ rows[slice(*span)].T, _DIGITS).max(axis=1)


def segments(adjacent: NDArray[np.float32], threshold: float) -> tuple[FrameSpan, ...]:
    """Return the segments of all frames, cut after frame t where `adjacent[t] < threshold`."""
    starts = [0, *(np.flatnonzero(adjacent < threshold) + 1).tolist()]
    stops = [*starts[1:], len(adjacent) + 1]
    return tuple(zip(starts, stops, strict=True))


def typical_cosine(episodes: int, read: Callable[[int], NDArray[np.float32]]) -> float:
    """Return the median cosine of two frames of different episodes; 0 for a single episode.

    This is the cosine of unrelated frames: near 1 for SigLIP, which sees a robot at a table in
    every frame, and near 0 for a centered encoder. An even sample of about 1024 frames has equally
    many of each episode. `read` returns the embeddings of an episode, `(T, D)`, of length 1.
    """
    if episodes < 2:
        return 0.0
    chosen = _middles(episodes, min(episodes, _SAMPLE))
    each = _SAMPLE // len(chosen)
    parts = [rows[_middles(len(rows), each)] for rows in map(read, chosen)]
    sample = np.concatenate(parts)
    owner = np.repeat(np.arange(len(chosen)), each)
    pairs = (sample @ sample.T)[owner[:, None] < owner]
    return round(float(np.median(pairs)), 4)


def _middles(length: int, count: int) -> list[int]:
    """Return the middle of each of `count` equal parts of `range(length)`."""
    return [(2 * part + 1) * length // (2 * count) for part in range(count)]
