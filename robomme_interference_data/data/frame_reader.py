"""Decode the frames of a buffer's sessions, in parallel or one by one, with an optional cache."""

import math
import os
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby, repeat
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import KEY_FRAMES
from robomme_interference_data.errors import FormatError
from robomme_interference_data.schema.manifest import Session, SessionEntry

from .dataset import Dataset, camera_feature

if TYPE_CHECKING:
    from robomme_interference_data.storage.cache import DecodedCache

_PIECE = 8 * KEY_FRAMES
"""Frames that a thread decodes at a time."""

_MAX_BYTES = 16 << 30
"""Most bytes of frames in memory at once: a small video file may hold many large frames."""


class FrameReader:
    """Reads frames of sessions, from the cache if possible, on `threads` (None: one per CPU).

    If `verified`, frames from the cache are compared with their digest.
    """

    def __init__(
        self,
        sessions: Sequence[Session],
        datasets: Mapping[str, Dataset],
        cache: "DecodedCache | None",
        threads: int | None,
    ):
        self._sessions = sessions
        self._datasets = datasets
        self._cache = cache
        self._threads = threads or os.cpu_count() or 1
        self.verified = False

    def read(self, camera: str, out: NDArray[np.uint8]) -> None:
        """Read all frames of a camera into `out`, `(T, H, W, 3) uint8`."""
        with ThreadPoolExecutor(self._threads) as pool:
            try:
                for finish in [self._start_reading(s, camera, out, pool) for s in self._sessions]:
                    finish()
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def iter(self, camera: str, chosen: Sequence[int]) -> Generator[NDArray[np.uint8]]:
        """Yield frames of a camera, `(H, W, 3) uint8`, by their ascending indices."""
        indices = np.asarray(chosen, np.int64)
        for run in np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1):
            if len(run):
                yield from self._iter_frames(camera, int(run[0]), int(run[-1]) + 1)

    def _cached(
        self, entry: SessionEntry, camera: str
    ) -> tuple[str | None, NDArray[np.uint8] | None]:
        """Return a session's key in the cache, None if it cannot be cached, and its frames."""
        dataset = self._datasets[entry.dataset]
        if self._cache is None:
            return None, None
        digests = dataset.record(entry.episode_index).digests(entry.start, entry.stop)
        if digests is None:
            return None, None
        key = digests.get(camera_feature(camera), "")
        shape = (entry.stop - entry.start, *dataset.shape(camera))
        return key, self._cache.get(key, shape, verify=self.verified)

    def _keep(self, key: str | None, frames: NDArray[np.uint8]) -> None:
        if self._cache is None or key is None:
            return
        from robomme_interference_data.storage.cache import frames_sha256

        # Only under their true digest: another buffer set may hold the frames with that digest.
        if frames_sha256(frames) == key:
            self._cache.put(key, frames)

    def _start_reading(
        self, session: Session, camera: str, out: NDArray[np.uint8], pool: ThreadPoolExecutor
    ) -> Callable[[], None]:
        """Start to read a session into its part of `out`; call the result to wait for the end."""
        entry, target = session.entry, out[session.start : session.stop]
        dataset, length = self._datasets[entry.dataset], entry.stop - entry.start
        key, cached = self._cached(entry, camera)
        piece = _PIECE if self._threads > 1 else length
        shown = target.reshape(length, entry.repeat, *target.shape[1:])  # a view

        def read(first: int) -> None:
            last = min(first + piece, length)
            if cached is not None:
                shown[first:last] = cached[first:last, None]
                return
            start, stop = entry.start + first, entry.start + last
            frames = dataset.iter_frames(entry.episode_index, camera, start, stop)
            for number, frame in enumerate(frames, first):
                shown[number] = frame

        reading = [pool.submit(read, first) for first in range(0, length, piece)]

        def finish() -> None:
            for piece_read in reading:
                piece_read.result()
            if cached is None:
                self._keep(key, shown[:, 0])

        return finish

    def _iter_frames(self, camera: str, start: int, stop: int) -> Generator[NDArray[np.uint8]]:
        """Yield frames `start` to `stop` (excluded), `(H, W, 3) uint8`, in order."""
        for session in self._sessions:
            indices = range(max(start, session.start), min(stop, session.stop))
            if not indices:
                continue
            entry, dataset = session.entry, self._datasets[session.entry.dataset]
            stored = [(index - session.start) // entry.repeat for index in indices]
            key, whole = self._cached(entry, camera)
            frames: Iterator[NDArray[np.uint8]]
            if key is None:
                first, last = entry.start + stored[0], entry.start + stored[-1] + 1
                frames = dataset.iter_frames(entry.episode_index, camera, first, last)
            else:
                if whole is None:
                    whole = allocate_frames(entry.stop - entry.start, dataset.shape(camera))
                    dataset.read_frames(entry.episode_index, camera, entry.start, whole)
                    self._keep(key, whole)
                frames = iter(whole[stored[0] : stored[-1] + 1])
            for frame, (_, shown) in zip(frames, groupby(stored), strict=True):
                yield from repeat(frame, len(list(shown)))


def allocate_frames(frames: int, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return an array for frames, `(T, H, W, 3) uint8`, unless it would be too large."""
    size = frames * math.prod(shape)
    if size > _MAX_BYTES:
        raise FormatError(
            f"{frames} frames of shape {shape} need {size:,} bytes; at most {_MAX_BYTES:,} are "
            "allocated at once",
            "Read them in chunks, without a cache: buffer.stream(64)",
        )
    return np.empty((frames, *shape), np.uint8)
