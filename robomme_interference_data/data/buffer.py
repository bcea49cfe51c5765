"""A history buffer: its sessions in order, and their frames when asked for."""

import math
import os
from bisect import bisect_right
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby, repeat

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DISTRACTORS, KEY_FRAMES, STATE
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InvalidOptionError,
    MissingExtraError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId, whole_number
from robomme_interference_data.schema.evidence import Evidence, place_evidence
from robomme_interference_data.schema.manifest import (
    BufferManifest,
    Session,
    SessionEntry,
    place_sessions,
)
from robomme_interference_data.schema.sampling import runs
from robomme_interference_data.storage.cache import DecodedCache, frames_sha256
from robomme_interference_data.storage.digest import combine

from .buffer_set_index import SplitIndex
from .dataset import Dataset, camera_feature
from .query import Query

_PIECE = 8 * KEY_FRAMES
"""Frames that one thread decodes at a time."""

_MOST_BYTES = 16 << 30
"""Bytes of frames that are held at once, at most: a short video may hold many large frames."""


@dataclass(frozen=True)
class Chunk:
    """Frames of a buffer, as `Buffer.stream` gives them; the arrays are the caller's.

    Attributes:
        indices: Of the frames in the buffer, ascending, `(n,) int64`.
        frames: Camera to `(n, H, W, 3) uint8`.
        states: `(n, D) float32`.
        session_index: `(n,) int64`.
    """

    indices: NDArray[np.int64]
    frames: dict[str, NDArray[np.uint8]]
    states: NDArray[np.float32]
    session_index: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.session_index)


class Buffer:
    """A history buffer; made by `load_buffer`. Frames are decoded when asked for.

    Attributes:
        manifest: What the buffer holds, by name.
        query: The query episode: its goal, and what the robot sees first.
        sessions: The sessions in order, with their places in the buffer.
    """

    def __init__(
        self,
        manifest: BufferManifest,
        query: Query,
        datasets: Mapping[str, Dataset],
        *,
        cache: DecodedCache | None = None,
        threads: int | None = None,
    ):
        self.manifest = manifest
        self.query = query
        self.sessions = place_sessions(manifest.sessions)
        self._datasets = datasets
        self._cache = cache
        self._threads = threads or os.cpu_count() or 1
        self._verified = False

    def __repr__(self) -> str:
        return (
            f"Buffer({self.episode_id}, {self.condition}, frames={len(self)}, "
            f"sessions={len(self.sessions)}, cameras={list(self.cameras)})"
        )

    def _repr_png_(self) -> bytes | None:
        """Return the film strip, as notebooks show it; without matplotlib they show the text."""
        from robomme_interference_data.viz.filmstrip import strip_png

        with suppress(MissingExtraError):
            return strip_png(self)
        return None

    def __len__(self) -> int:
        """Return the number of history frames, without the first live observation."""
        return self.manifest.history_frames

    @property
    def episode_id(self) -> EpisodeId:
        """Id of the query episode."""
        return self.manifest.episode_id

    @property
    def condition(self) -> str:
        """Name of the condition, such as `k3`."""
        return self.manifest.condition

    @property
    def goal(self) -> str:
        """The query's goal in words: the first of its wordings."""
        return self.manifest.goal

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, such as `front` and `wrist`."""
        return self.query.dataset.cameras

    @property
    def session_index(self) -> NDArray[np.int64]:
        """For each frame, the number of its session, `(T,) int64`; a new array."""
        return np.repeat(
            np.arange(len(self.sessions), dtype=np.int64), list(map(len, self.sessions))
        )

    @cached_property
    def states(self) -> NDArray[np.float32]:
        """Robot states, `(T, 8) float32`: joint positions in rad, gripper opening; read-only."""
        parts = [np.empty((0, *self.query.dataset.features[STATE]), np.float32)]
        for entry in self.manifest.sessions:
            values = self._datasets[entry.dataset].read_vectors(
                entry.episode_index, STATE, entry.start, entry.stop
            )
            parts.append(np.repeat(values, entry.repeat, axis=0))
        states = np.concatenate(parts)
        states.setflags(write=False)
        return states

    @cached_property
    def evidence(self) -> tuple[Evidence, ...] | None:
        """Which frames of the buffer show a part of the hidden answer, session by session.

        None where that is unknown of a lesson that it holds, or of one that contradicts it.
        """
        return place_evidence(
            self.sessions,
            lambda entry: self._datasets[entry.dataset].record(entry.episode_index).evidence,
        )

    def fetch(self, cameras: Sequence[str] | None = None) -> None:
        """Bring the files of the buffer and its query to this machine, if they lie elsewhere.

        Args:
            cameras: Names of the cameras; None for all.

        Raises:
            UnknownNameError: There is no such camera.
            MissingFileError, HubError: A file is not there, or the Hub cannot be reached.
        """
        wanted = self.cameras if cameras is None else cameras
        episodes = {self.query.dataset: [self.query.record.episode_index]}
        for entry in self.manifest.sessions:
            episodes.setdefault(self._datasets[entry.dataset], []).append(entry.episode_index)
        for dataset, indices in episodes.items():
            dataset.files.fetch(one for i in indices for one in dataset.files_of(i, wanted))

    def frames(self, camera: str = "front") -> NDArray[np.uint8]:
        """Decode all frames of a camera, sessions side by side on several threads.

        Args:
            camera: Name of the camera, with or without `observation.images.`.

        Returns:
            `(T, H, W, 3) uint8` RGB; a new array.

        Raises:
            UnknownNameError: There is no such camera.
            MissingFileError, FormatError, TruncatedVideoError: A video cannot be read.
        """
        out = _room(len(self), self.query.dataset.shape(camera))
        self.fetch([camera])
        with ThreadPoolExecutor(self._threads) as pool:
            try:
                for finish in [self._start_reading(s, camera, out, pool) for s in self.sessions]:
                    finish()
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        return out

    def frame(self, index: int, camera: str = "front") -> NDArray[np.uint8]:
        """Decode one frame of the buffer, `(H, W, 3) uint8` RGB.

        Args:
            index: Index in the buffer, 0 to `len(buffer) - 1`.
            camera: As for `frames`.

        Raises:
            InvalidOptionError: `index` is no whole number.
            UnknownNameError: There is no such frame or camera.
            MissingFileError, FormatError, TruncatedVideoError: As for `frames`.
        """
        index = whole_number("index", index, "a whole number from 0, such as 3")
        self._check_inside(index, index)
        session = self.sessions[bisect_right(self.sessions, index, key=lambda s: s.start) - 1]
        entry = session.entry
        stored = entry.start + (index - session.start) // entry.repeat
        dataset = self._datasets[entry.dataset]
        [frame] = dataset.iter_frames(entry.episode_index, camera, stored, stored + 1)
        return frame

    def stream(
        self,
        chunk: int = 64,
        cameras: Sequence[str] | None = None,
        indices: Sequence[int] | None = None,
    ) -> Generator[Chunk]:
        """Decode the buffer, or some of its frames, in chunks, holding one chunk at a time.

        With a cache, frames that it lacks are decoded a whole session at a time.

        Args:
            chunk: Frames in a chunk; the last one may be shorter.
            cameras: Names of the cameras; None for all.
            indices: Of the frames, ascending, each once; None for all.

        Raises:
            InvalidOptionError: `chunk` is not positive, the indices do not ascend, or an argument
                is of another type.
            UnknownNameError: The buffer has no such frame or camera.
            MissingFileError, FormatError, TruncatedVideoError: As for `frames`.
        """
        expected = "a whole number from 1"
        chunk = whole_number("chunk", chunk, expected)
        if chunk < 1:
            raise InvalidOptionError.expected("chunk", chunk, expected)
        chosen = self._chosen(indices)
        if isinstance(cameras, str) or not isinstance(cameras, Iterable | None):
            raise InvalidOptionError.expected("cameras", cameras, "their names: ['front', 'wrist']")
        wanted = self.cameras if cameras is None else tuple(cameras)
        shapes = {name: self.query.dataset.shape(name) for name in wanted}
        decoders = {name: self._iter_chosen(name, chosen) for name in wanted}
        session_index = self.session_index
        try:
            for first in range(0, len(chosen), chunk):
                these = chosen[first : first + chunk].copy()
                frames = {}
                for name, shape in shapes.items():
                    frames[name] = np.empty((len(these), *shape), np.uint8)
                    for image in frames[name]:
                        image[...] = next(decoders[name])
                yield Chunk(these, frames, self.states[these], session_index[these])
        finally:
            for decoder in decoders.values():
                decoder.close()

    def index(self, encoder: str, camera: str = "front") -> SplitIndex:
        """Open the indexes of the datasets that the buffer needs; see `SplitIndex`."""
        needed = {DISTRACTORS, self.query.dataset.kind}
        needed |= {entry.dataset for entry in self.manifest.sessions}
        datasets = {name: one for name, one in self._datasets.items() if name in needed}
        return SplitIndex(datasets, encoder, camera)

    def embeddings(self, encoder: str, camera: str = "front") -> NDArray[np.float32]:
        """Look up the embeddings of all frames; none is decoded.

        Args:
            encoder: Name of the encoder, such as `thumbnail`, whose index lies in the datasets.
            camera: Name of the camera, with or without `observation.images.`.

        Returns:
            `(T, D) float32`, each of length 1, in the buffer's order; a new array.

        Raises:
            MissingIndexError, StaleIndexError, FormatError: See `SplitIndex`.
        """
        index = self.index(encoder, camera)
        parts: list[NDArray[np.float32]] = [np.empty((0, index.size), np.float32)]
        for entry in self.manifest.sessions:
            values = index.span(entry.dataset, entry.episode_index, entry.start, entry.stop)
            parts.append(values if entry.repeat == 1 else np.repeat(values, entry.repeat, axis=0))
        return np.concatenate(parts)

    def query_embedding(self, encoder: str, camera: str = "front") -> NDArray[np.float32]:
        """Look up the embedding of the first live observation, `(D,) float32`.

        For grading without a simulator: in a rollout, what the robot sees is embedded then.

        Raises:
            MissingIndexError, StaleIndexError, FormatError: See `SplitIndex`.
        """
        place = self.query.place
        span = place.dataset, place.episode_index, place.frame, place.frame + 1
        return self.index(encoder, camera).span(*span)[0]

    def verify(self) -> None:
        """Decode everything and compare it with the manifest's SHA-256.

        From then on, what a cache holds is compared too, whenever it is read.

        Raises:
            HashMismatchError: A session's data is not what the manifest names.
        """
        self._verified = True
        for entry in self.manifest.sessions:
            dataset = self._datasets[entry.dataset]
            [found] = dataset.digests(entry.episode_index, [(entry.start, entry.stop)])
            if combine(found) == entry.sha256:
                continue
            recorded = self._recorded(entry) or {}
            differing = [name for name in found if found[name] != recorded.get(name)]
            raise HashMismatchError(
                f"{self.manifest}: {entry.role} {entry.source} ({entry.dataset} episode "
                f"{entry.episode_index}, frames {entry.start} to {entry.stop - 1}) does not have "
                "the SHA-256 of the manifest; differing: "
                f"{', '.join(differing) or 'the manifest itself'}",
                "The data is damaged or belongs to another version: download or build it again, "
                "then run robomme-interference verify SPLIT",
            )

    def _chosen(self, indices: Sequence[int] | None) -> NDArray[np.int64]:
        """Return what `stream` is asked for, `(n,) int64`."""
        if indices is None:
            return np.arange(len(self))
        chosen = np.asarray(indices)
        if not chosen.size:
            return np.empty(0, np.int64)
        if chosen.ndim != 1 or chosen.dtype.kind not in "iu" or (np.diff(chosen) < 1).any():
            expected = "whole numbers, ascending, each once, such as range(64)"
            raise InvalidOptionError.expected("indices", indices, expected)
        self._check_inside(int(chosen[0]), int(chosen[-1]))
        return chosen.astype(np.int64)

    def _check_inside(self, *indices: int) -> None:
        for index in indices:
            if not 0 <= index < len(self):
                raise UnknownNameError(
                    f"frame {index} is not in the buffer of {self.manifest}, which has "
                    f"{len(self)} history frames, numbered from 0"
                )

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
        return name, self._cache.get(name, shape, verify=self._verified)

    def _keep(self, name: str | None, frames: NDArray[np.uint8]) -> None:
        # Under their own digest only: another split may hold the frames that are called so.
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

    def _iter_chosen(self, camera: str, chosen: NDArray[np.int64]) -> Generator[NDArray[np.uint8]]:
        """Yield frames, `(H, W, 3) uint8`, by their ascending indices."""
        for start, stop in runs(chosen.tolist()):
            yield from self._iter_frames(camera, start, stop)

    def _iter_frames(self, camera: str, start: int, stop: int) -> Generator[NDArray[np.uint8]]:
        """Yield frames `start` to `stop` (excluded), `(H, W, 3) uint8`, in order."""
        for session in self.sessions:
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
                    whole = _room(entry.stop - entry.start, dataset.shape(camera))
                    dataset.read_frames(entry.episode_index, camera, entry.start, whole)
                    self._keep(name, whole)
                frames = iter(whole[stored[0] : stored[-1] + 1])
            for frame, (_, shown) in zip(frames, groupby(stored), strict=True):
                yield from repeat(frame, len(list(shown)))


def _room(frames: int, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    size = frames * math.prod(shape)
    if size > _MOST_BYTES:
        raise FormatError(
            f"{frames} frames of shape {shape} take {size:,} bytes; at most {_MOST_BYTES:,} are "
            "held at once",
            "Take them in chunks, without a cache: buffer.stream(64)",
        )
    return np.empty((frames, *shape), np.uint8)
