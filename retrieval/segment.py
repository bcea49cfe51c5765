"""Cut a history into segments where what lies on both sides of a border differs; without IO.

The paper's rule compares adjacent frames, and cuts wherever their cosine is below a threshold. In a
stream without hard cuts adjacent frames are always alike. So a border may also be between the means
of several frames on each side, cut where they differ most: the sliding window of change-point
detection (Truong, Oudre and Vayatis, Signal Processing 167, 2020, section 5.2.1), with the cosine
as similarity. It takes time in proportion to the number of frames.
"""

from collections.abc import Callable

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

FrameSpan = tuple[int, int]
"""First frame, and the one after the last."""

_DIGITS = 6
"""Cosines are rounded, so that equal frames tie on every machine."""

_SAMPLE = 1024

_BLOCK = 1024
"""Rows or columns that are computed at a time, to bound the memory for long histories."""


def cosines(embeddings: NDArray[np.floating], query: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the cosine of each embedding, `(T, D)`, with `query`, `(D,)`; all of length 1."""
    rows = embeddings.astype(np.float32, copy=False)
    return np.round(rows @ query.astype(np.float32), _DIGITS)


def adjacent_cosines(embeddings: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the cosine of each embedding, `(T, D)`, with the next, `(T - 1,) float32`."""
    rows = embeddings.astype(np.float32, copy=False)
    return np.round(np.einsum("td,td->t", rows[:-1], rows[1:]), _DIGITS)


def side_cosines(embeddings: NDArray[np.floating], width: int) -> NDArray[np.float32]:
    """Return the cosine of the means on both sides of each border, `(T - 1,) float32`.

    Value t is of the border after frame t: of the mean of `width` embeddings that end with frame t,
    and the mean of the next `width`. It is 1 where a side has fewer frames, and 0 if a mean is
    zero. With `width` 1 it is the cosine of adjacent frames.

    Args:
        embeddings: `(T, D)`, of length 1 or 0.
        width: Frames on each side, at least 1.
    """
    length, size = embeddings.shape
    found = np.ones(max(length - 1, 0), np.float32)
    if length < 2 * width:
        return found
    products, before, after = np.zeros((3, length - 2 * width + 1))
    for start in range(0, size, _BLOCK // 16):
        values = embeddings[:, start : start + _BLOCK // 16]
        sums = np.zeros((length + 1, values.shape[1]))
        np.cumsum(values, axis=0, dtype=np.float64, out=sums[1:])
        sides = sums[width:] - sums[:-width]
        left, right = sides[:-width], sides[width:]
        products += np.einsum("td,td->t", left, right)
        before += np.einsum("td,td->t", left, left)
        after += np.einsum("td,td->t", right, right)
    lengths = np.sqrt(before * after)
    cosine = products / np.where(lengths > 0, lengths, 1)
    found[width - 1 : length - width] = np.round(cosine, _DIGITS)
    return found


def highest_cosine(embeddings: NDArray[np.float32], others: NDArray[np.float32]) -> float:
    """Return the highest cosine of two embeddings, one of `(T, D)` and one of `(S, D)`."""
    blocks = (embeddings[start : start + _BLOCK] for start in range(0, len(embeddings), _BLOCK))
    return max(float(np.round(block @ others.T, _DIGITS).max()) for block in blocks)


def segments(
    borders: NDArray[np.float32], threshold: float, width: int = 1
) -> tuple[FrameSpan, ...]:
    """Return the segments of all frames.

    They are cut after frame t where `borders[t]` is below the threshold, and the lowest of the
    `width - 1` values before it and after it; of equally low ones the first.

    Args:
        borders: Cosine of both sides of each border, `(T - 1,) float32`.
        threshold: Threshold.
        width: Shortest distance of two cuts; 1 for a cut wherever a value is below the threshold.
    """
    cuts = borders < threshold
    if len(borders):
        near = np.pad(borders, width - 1, constant_values=np.inf)
        lowest = sliding_window_view(near, 2 * width - 1).argmin(axis=1)
        cuts &= lowest == width - 1
    starts = [0, *(np.flatnonzero(cuts) + 1).tolist()]
    stops = [*starts[1:], len(borders) + 1]
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
