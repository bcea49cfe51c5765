"""Decode the frames of a buffer's sessions, in parallel or one by one, with an optional cache."""

import math
import os
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import groupby, repeat
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import KEY_FRAMES
from robomme_interference_data.errors import FormatError, HashMismatchError, InterferenceError
from robomme_interference_data.schema.manifest import Session, SessionEntry
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.arrays import FeatureDigests
from robomme_interference_data.storage.text import digest_json

from .dataset import Dataset, camera_feature

if TYPE_CHECKING:
    from robomme_interference_data.storage.cache import DecodedCache

_PIECE = 8 * KEY_FRAMES
"""Frames that a thread decodes at a time."""

_MAX_BYTES = 16 << 30
"""Most bytes of frames in memory at once: a small video file may hold many large frames."""

_warned: set[Path] = set()
"""Folders of caches that could not be written to, and were warned about."""


class FrameReader:
    """Reads frames of sessions, from the cache if possible, on `threads` (None: one per CPU)."""

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

    def read(self, camera: str, out: NDArray[np.uint8]) -> None:
        """Read all frames of a camera into `out`, `(T, H, W, 3) uint8`."""
        with ThreadPoolExecutor(self._threads) as pool:
            reading = [r for s in self._sessions for r in self._start_reading(s, camera, out, pool)]
            try:
                for piece_read in reading:
                    piece_read.result()
            except BaseException:
                # Else the pool would finish all that is queued before the error arrives.
                pool.shutdown(cancel_futures=True)
                raise

    def iter(self, camera: str, chosen: Sequence[int]) -> Generator[NDArray[np.uint8]]:
        """Yield frames of a camera, `(H, W, 3) uint8`, by their ascending indices."""
        indices = np.asarray(chosen, np.int64)
        # Runs of consecutive frames: a video is decoded in order, and each run begins with a seek.
        for run in np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1):
            if len(run):
                yield from self._iter_frames(camera, int(run[0]), int(run[-1]) + 1)

    def _cached(self, entry: SessionEntry, camera: str) -> NDArray[np.uint8] | None:
        """Return an entry's frames from the cache; None if there is none, or it is unusable."""
        if self._cache is None:
            return None
        dataset = self._datasets[entry.dataset]
        session = dataset.record(entry.episode_index).session[1]
        size = session * math.prod(dataset.shape(camera))
        # A manifest may claim frames after the session, and a small video may hold many large ones.
        if entry.stop > session or size > self._cache.max_bytes:
            return None
        try:
            frames = cached_session(self._cache, dataset, entry.episode_index, camera)
        except OSError as error:
            if isinstance(error, InterferenceError):  # the video itself
                raise
            _warn_once(self._cache.folder, error)
            return None
        return frames[entry.start : entry.stop]

    def _start_reading(
        self, session: Session, camera: str, out: NDArray[np.uint8], pool: ThreadPoolExecutor
    ) -> list[Future[None]]:
        """Start to read a session into its part of `out`."""
        entry, target = session.entry, out[session.start : session.stop]
        dataset, length = self._datasets[entry.dataset], entry.stop - entry.start
        shown = target.reshape(length, entry.repeat, *target.shape[1:])  # a view

        def read(first: int, last: int) -> None:
            cached = self._cached(entry, camera)
            if cached is not None:
                shown[first:last] = cached[first:last, None]
                return
            start, stop = entry.start + first, entry.start + last
            frames = dataset.iter_frames(entry.episode_index, camera, start, stop)
            for number, frame in enumerate(frames, first):
                shown[number] = frame

        # The cache holds whole sessions, so pieces would wait for each other.
        piece = _PIECE if self._threads > 1 and self._cache is None else length
        firsts = range(0, length, piece)
        return [pool.submit(read, first, min(first + piece, length)) for first in firsts]

    def _iter_frames(self, camera: str, start: int, stop: int) -> Generator[NDArray[np.uint8]]:
        """Yield frames `start` to `stop` (excluded), `(H, W, 3) uint8`, in order."""
        for session in self._sessions:
            indices = range(max(start, session.start), min(stop, session.stop))
            if not indices:
                continue
            entry, dataset = session.entry, self._datasets[session.entry.dataset]
            stored = [(index - session.start) // entry.repeat for index in indices]
            cached = self._cached(entry, camera)
            frames: Iterator[NDArray[np.uint8]]
            if cached is None:
                first, last = entry.start + stored[0], entry.start + stored[-1] + 1
                frames = dataset.iter_frames(entry.episode_index, camera, first, last)
            else:
                frames = iter(cached[stored[0] : stored[-1] + 1])
            # A held frame is decoded once and shown several times.
            for frame, (_, shown) in zip(frames, groupby(stored), strict=True):
                yield from repeat(frame, len(list(shown)))


def cached_session(
    cache: "DecodedCache",
    dataset: Dataset,
    episode_index: int,
    camera: str,
    shape: tuple[int, ...] | None = None,
    convert: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] | None = None,
) -> NDArray[np.uint8]:
    """Return the frames of an episode's session, a lesson or unit, from the cache.

    Args:
        cache: The cache, which stores them if it lacks them.
        dataset: Dataset of the episode.
        episode_index: Number of the episode.
        camera: Name of the camera, with or without `observation.images.`.
        shape: Shape of a converted frame, from which the conversion follows: `(3, S, S)`.
        convert: Makes it of a decoded one, `(H, W, 3) uint8`; None for no conversion.

    Returns:
        `(T, H, W, 3) uint8` RGB, or `(T, *shape) uint8`; read-only.

    Raises:
        HashMismatchError: The decoded frames do not have the recorded digest.
        OSError: The cache cannot be written to.
    """
    record, feature = dataset.record(episode_index), camera_feature(camera)
    start, stop = record.session
    recorded = record.feature_sha256.get(feature)

    def decode() -> Iterator[NDArray[np.uint8]]:
        digests = FeatureDigests()
        for frame in dataset.iter_frames(episode_index, camera, start, stop):
            digests.update(feature, frame)
            yield frame if convert is None else convert(frame)
        # Nothing is stored under a digest that an untrusted dataset only claims.
        check_session(dataset, record, feature, digests)

    whole = (stop - start, *(shape or dataset.shape(camera)))
    layout = "HWC" if convert is None else "CHW, means of areas"
    return cache.frames(digest_json([recorded, layout, whole]), whole, decode)


def check_session(
    dataset: Dataset, record: EpisodeRecord, feature: str, digests: FeatureDigests
) -> None:
    """Compare the digest of a feature of an episode's session with the recorded one.

    Raises:
        HashMismatchError: They differ.
    """
    if digests.current()[feature] != record.feature_sha256.get(feature):
        raise HashMismatchError.damaged(
            f"{dataset.files.describe()}: {feature} of {record.episode_id} does not have the "
            "recorded SHA-256"
        )


def _warn_once(folder: Path, error: OSError) -> None:
    if folder not in _warned:
        _warned.add(folder)
        warnings.warn(
            f"decoded frames cannot be cached in {folder}: {error.strerror or error}",
            RuntimeWarning,
            stacklevel=2,
        )


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
