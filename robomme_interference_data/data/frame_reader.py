"""Read the frames of a buffer's sessions: side by side on threads, or one by one; with a cache."""

import math
import os
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby, repeat

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import KEY_FRAMES
from robomme_interference_data.errors import FormatError
from robomme_interference_data.schema.manifest import Session, SessionEntry
from robomme_interference_data.schema.sampling import runs
from robomme_interference_data.storage.cache import DecodedCache, frames_sha256

from .dataset import Dataset, camera_feature

_PIECE = 8 * KEY_FRAMES
"""Frames that one thread decodes at a time."""

_MOST_BYTES = 16 << 30
"""Bytes of frames that are held at once, at most: a short video may hold many large frames."""


class FrameReader:
    """Reads frames of sessions, from a cache where it has them.

    Args:
        sessions: The sessions in their places.
        datasets: The datasets that hold them, by name.
        cache: Keeps decoded frames; None for no cache.
        threads: Threads that decode side by side; None for one per processor.

    Attributes:
        verified: Whether what the cache holds is compared with its digest.
    """

    def __init__(
        self,
        sessions: Sequence[Session],
        datasets: Mapping[str, Dataset],
        cache: DecodedCache | None,
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
        for start, stop in runs(chosen):
            yield from self._iter_frames(camera, start, stop)

    def _recorded(self, entry: SessionEntry) -> dict[str, str] | None:
        """Return the recorded digests of a session by feature; None if none are recorded."""
        record = self._datasets[entry.dataset].record(entry.episode_index)
        return record.digests(entry.start, entry.stop)

    def _cached(
        self, entry: SessionEntry, camera: str
    ) -> tuple[str | None, NDArray[np.uint8] | None]:
        """Return what the cache calls a session's frames, if it may keep them; and those it has."""
        recorded = None if self._cache is None else self._recorded(entry)
        if self._cache is None or recorded is None:
            return None, None
        name = recorded.get(camera_feature(camera), "")
        shape = (entry.stop - entry.start, *self._datasets[entry.dataset].shape(camera))
        return name, self._cache.get(name, shape, verify=self.verified)

    def _keep(self, name: str | None, frames: NDArray[np.uint8]) -> None:
        # Under their own digest only: another buffer set may hold the frames that are called so.
        if self._cache is not None and name is not None and frames_sha256(frames) == name:
            self._cache.put(name, frames)

    def _start_reading(
        self, session: Session, camera: str, out: NDArray[np.uint8], pool: ThreadPoolExecutor
    ) -> Callable[[], None]:
        """Start to read a session into its place in `out`; the result waits until it is done."""
        entry, target = session.entry, out[session.start : session.stop]
        dataset, length = self._datasets[entry.dataset], entry.stop - entry.start
        name, cached = self._cached(entry, camera)
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
            for one in reading:
                one.result()
            if cached is None:
                self._keep(name, shown[:, 0])

        return finish

    def _iter_frames(self, camera: str, start: int, stop: int) -> Generator[NDArray[np.uint8]]:
        """Yield frames `start` to `stop` (excluded), `(H, W, 3) uint8`, in order."""
        for session in self._sessions:
            places = range(max(start, session.start), min(stop, session.stop))
            if not places:
                continue
            entry, dataset = session.entry, self._datasets[session.entry.dataset]
            stored = [(place - session.start) // entry.repeat for place in places]
            name, whole = self._cached(entry, camera)
            frames: Iterator[NDArray[np.uint8]]
            if name is None:
                first, last = entry.start + stored[0], entry.start + stored[-1] + 1
                frames = dataset.iter_frames(entry.episode_index, camera, first, last)
            else:
                if whole is None:
                    whole = room_for(entry.stop - entry.start, dataset.shape(camera))
                    dataset.read_frames(entry.episode_index, camera, entry.start, whole)
                    self._keep(name, whole)
                frames = iter(whole[stored[0] : stored[-1] + 1])
            for frame, (_, shown) in zip(frames, groupby(stored), strict=True):
                yield from repeat(frame, len(list(shown)))


def room_for(frames: int, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return an array for so many frames, `(T, H, W, 3) uint8`, unless they are too large."""
    size = frames * math.prod(shape)
    if size > _MOST_BYTES:
        raise FormatError(
            f"{frames} frames of shape {shape} take {size:,} bytes; at most {_MOST_BYTES:,} are "
            "held at once",
            "Take them in chunks, without a cache: buffer.stream(64)",
        )
    return np.empty((frames, *shape), np.uint8)
