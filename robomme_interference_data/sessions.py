"""Read the frames of a buffer's sessions, out of the cache of decoded frames where there is one."""

from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.cache import DecodedCache
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema import SessionEntry

__all__ = ["Session", "SessionReader"]

_PIECE = 128
"""Frames that one thread decodes at a time: a multiple of the key frame distance (16)."""


@dataclass(frozen=True)
class Session:
    """A session of a buffer.

    Attributes:
        role: `lesson`, `distractor`, … (see `schema.ROLES`).
        family: Family of the recorded episode.
        source: Id of the recorded episode.
        start: First frame of the session in the buffer.
        stop: Frame after its last one.
        entry: Where the frames are stored.
    """

    role: str
    family: str
    source: EpisodeId
    start: int
    stop: int
    entry: SessionEntry

    @property
    def span(self) -> tuple[int, int]:
        """First frame in the buffer, and the one after the last."""
        return (self.start, self.stop)


class SessionReader:
    """Reads the frames of sessions.

    Args:
        datasets: The datasets that hold them, by name.
        cache: Where decoded sessions are kept; None for nowhere.
        threads: Threads that decode at once, 1 or more.
    """

    def __init__(self, datasets: Mapping[str, Dataset], cache: DecodedCache | None, threads: int):
        self._datasets = datasets
        self._cache = cache
        self._threads = threads

    def read(self, sessions: Sequence[Session], feature: str, out: NDArray[np.uint8]) -> None:
        """Decode all frames of a buffer's sessions, side by side on several threads.

        Args:
            sessions: The sessions.
            feature: Feature name of the camera.
            out: `(T, H, W, 3) uint8`; each session is written to its place in it.

        Raises:
            MissingFileError, FormatError, TruncatedVideoError: A video cannot be read.
        """
        with ThreadPoolExecutor(self._threads) as pool:
            try:
                finish = [self._start_reading(s, feature, out, pool) for s in sessions]
                for step in finish:
                    step()
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def read_one(self, session: Session, feature: str, index: int, out: NDArray[np.uint8]) -> None:
        """Decode frame `index` of the buffer, which is in `session`, into `out` `(1, H, W, 3)`."""
        entry = session.entry
        stored = entry.start + (index - session.start) // entry.repeat
        self._datasets[entry.dataset].read_frames(entry.episode_index, feature, stored, out)

    def _start_reading(
        self,
        session: Session,
        feature: str,
        out: NDArray[np.uint8],
        pool: ThreadPoolExecutor,
    ) -> Callable[[], None]:
        """Start to read a session into its place in `out`; the result waits until it is done."""
        entry = session.entry
        dataset = self._datasets[entry.dataset]
        target = out[session.start : session.stop]
        length = entry.stop - entry.start
        digest = self._digest(entry, feature)
        if self._cache is not None and digest is not None:
            cached = self._cache.get(digest, (length, *out.shape[1:]))
            if cached is not None:
                copied = pool.submit(_copy_repeated, target, cached, entry.repeat)
                return copied.result
        span = target if entry.repeat == 1 else np.empty((length, *out.shape[1:]), np.uint8)
        piece = _PIECE if self._threads > 1 else length
        read = [
            pool.submit(
                dataset.read_frames,
                entry.episode_index,
                feature,
                entry.start + first,
                span[first : first + piece],
            )
            for first in range(0, length, piece)
        ]

        def finish() -> None:
            for future in read:
                future.result()
            if span is not target:
                _copy_repeated(target, span, entry.repeat)
            if self._cache is not None and digest is not None:
                self._cache.put(digest, span)

        return finish

    def iter_frames(
        self, sessions: Sequence[Session], feature: str, start: int, stop: int
    ) -> Generator[NDArray[np.uint8]]:
        """Yield frames `start` to `stop` (excluded) of a buffer, `(H, W, 3) uint8`, in order.

        With a cache, what it lacks is decoded a whole session at a time.

        Raises:
            MissingFileError, FormatError, TruncatedVideoError: A video cannot be read.
        """
        for session in sessions:
            first, last = max(start, session.start), min(stop, session.stop)
            if first >= last:
                continue
            entry = session.entry
            stored = entry.start + (first - session.start) // entry.repeat
            end = entry.start + -(-(last - session.start) // entry.repeat)
            position = first
            for frame in self._stored_frames(entry, feature, stored, end):
                shown = min(
                    last, position + entry.repeat - (position - session.start) % entry.repeat
                )
                while position < shown:
                    yield frame
                    position += 1

    def _stored_frames(
        self, entry: SessionEntry, feature: str, start: int, stop: int
    ) -> Generator[NDArray[np.uint8]]:
        """Yield stored frames, start inclusive, stop exclusive; with a cache, out of it.

        What the cache lacks is decoded into it, the whole session.
        """
        dataset = self._datasets[entry.dataset]
        digest = self._digest(entry, feature)
        if self._cache is None or digest is None:
            yield from dataset.iter_frames(entry.episode_index, feature, start, stop)
            return
        shape = (entry.stop - entry.start, *dataset.features[feature])
        frames = self._cache.get(digest, shape)
        if frames is None:
            frames = np.empty(shape, np.uint8)
            dataset.read_frames(entry.episode_index, feature, entry.start, frames)
            self._cache.put(digest, frames)
        yield from frames[start - entry.start : stop - entry.start]

    def _digest(self, entry: SessionEntry, feature: str) -> str | None:
        """Return the name of a session's frames in the cache; None without cache or digest."""
        if self._cache is None:
            return None
        dataset = self._datasets[entry.dataset]
        recorded = dataset.digests(entry.episode_index, entry.start, entry.stop)
        return recorded[feature] if recorded else None


def _copy_repeated(target: NDArray[np.uint8], frames: NDArray[np.uint8], repeat: int) -> None:
    for offset in range(repeat):
        target[offset::repeat] = frames
