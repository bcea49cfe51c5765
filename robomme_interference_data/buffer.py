"""A history buffer: its sessions in order, and their frames when asked for."""

import os
from bisect import bisect_right
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.cache import DecodedCache
from robomme_interference_data.constants import CAMERA_PREFIX, STATE
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.digest import combine
from robomme_interference_data.embeddings import EmbeddingIndex
from robomme_interference_data.errors import (
    HashMismatchError,
    InvalidOptionError,
    StaleIndexError,
    UnknownNameError,
    nearest,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema import BufferManifest
from robomme_interference_data.sessions import Session, SessionReader

__all__ = ["Buffer", "Chunk"]


@dataclass(frozen=True)
class Chunk:
    """Consecutive frames of a buffer, as `Buffer.stream` gives them.

    Attributes:
        start: Index of the first frame in the buffer.
        frames: Camera to `(n, H, W, 3) uint8`.
        states: `(n, D) float32`.
        session_index: `(n,) int64`.
    """

    start: int
    frames: dict[str, NDArray[np.uint8]]
    states: NDArray[np.float32]
    session_index: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.session_index)


class Buffer:
    """A history buffer; made by `load_buffer`. Frames are decoded when asked for.

    Attributes:
        manifest: What the buffer holds, by name.
    """

    def __init__(
        self,
        manifest: BufferManifest,
        datasets: Mapping[str, Dataset],
        *,
        cache: DecodedCache | None = None,
        threads: int | None = None,
    ):
        self.manifest = manifest
        self._datasets = datasets
        if threads is not None and threads < 1:
            raise InvalidOptionError(f"threads={threads}; expected 1 or more")
        self._reader = SessionReader(datasets, cache, threads or os.cpu_count() or 1)

    def __repr__(self) -> str:
        return (
            f"Buffer({self.episode_id}, k={self.k}, frames={len(self)}, "
            f"sessions={len(self.manifest.sessions)}, cameras={list(self.cameras)})"
        )

    def __len__(self) -> int:
        """Return the number of history frames, without the first live observation."""
        return self.manifest.history_frames

    @property
    def episode_id(self) -> EpisodeId:
        """Id of the query episode."""
        return self.manifest.episode_id

    @property
    def k(self) -> int:
        """Number of distractor sessions."""
        return self.manifest.k

    @property
    def goal(self) -> str:
        """The query's goal in words: the first of its wordings."""
        return self.manifest.goal

    @property
    def exec_start_idx(self) -> int:
        """Number of history frames before the first live observation."""
        return self.manifest.history_frames

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, such as `front` and `wrist`."""
        names = self._datasets[self.manifest.query.dataset].cameras
        return tuple(name.removeprefix(CAMERA_PREFIX) for name in names)

    @cached_property
    def sessions(self) -> tuple[Session, ...]:
        """The sessions in order, with their places in the buffer."""
        entries = self.manifest.sessions
        stops = list(accumulate(entry.num_frames for entry in entries))
        return tuple(
            Session(e.role, e.family, e.source, stop - e.num_frames, stop, e)
            for e, stop in zip(entries, stops, strict=True)
        )

    @property
    def session_index(self) -> NDArray[np.int64]:
        """For each frame, the number of its session, `(T,) int64`."""
        counts = [entry.num_frames for entry in self.manifest.sessions]
        return np.repeat(np.arange(len(counts), dtype=np.int64), counts)

    @cached_property
    def states(self) -> NDArray[np.float32]:
        """Robot states, `(T, 8) float32`: joint positions in rad, gripper opening."""
        return self._vectors(STATE)

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
        feature = self._feature(camera)
        out = np.empty((len(self), *self._shape(feature)), np.uint8)
        self._reader.read(self.sessions, feature, out)
        return out

    def frame(self, index: int, camera: str = "front") -> NDArray[np.uint8]:
        """Decode one frame of the buffer, `(H, W, 3) uint8` RGB.

        Args:
            index: Index in the buffer, 0 to `len(buffer) - 1`.
            camera: As for `frames`.

        Raises:
            UnknownNameError: There is no such frame or camera.
            MissingFileError, FormatError, TruncatedVideoError: As for `frames`.
        """
        if not 0 <= index < len(self):
            raise UnknownNameError(
                f"frame {index} is not in the buffer of {self.episode_id} at k={self.k}, which "
                f"has {len(self)} history frames, numbered from 0"
            )
        session = self.sessions[bisect_right(self.sessions, index, key=lambda s: s.start) - 1]
        feature = self._feature(camera)
        out = np.empty((1, *self._shape(feature)), np.uint8)
        self._reader.read_one(session, feature, index, out)
        return out[0]

    def query_frame(self, camera: str = "front") -> NDArray[np.uint8]:
        """Decode the first live observation, `(H, W, 3) uint8` RGB; not part of the buffer."""
        query = self.manifest.query
        feature = self._feature(camera)
        out = np.empty((1, *self._shape(feature)), np.uint8)
        self._datasets[query.dataset].read_frames(query.episode_index, feature, query.frame, out)
        return out[0]

    def query_state(self) -> NDArray[np.float32]:
        """Return the state of the first live observation, `(8,) float32`; see `states`."""
        query = self.manifest.query
        dataset = self._datasets[query.dataset]
        return dataset.read_vectors(query.episode_index, STATE, query.frame, query.frame + 1)[0]

    def embeddings(self, encoder: str, camera: str = "front") -> NDArray[np.float16]:
        """Look up the embeddings of all frames; none is decoded.

        Args:
            encoder: Name of the encoder, such as `thumbnail`, whose index lies in the datasets.
            camera: Name of the camera, with or without `observation.images.`.

        Returns:
            `(T, D) float16`, each of length 1, in the buffer's order.

        Raises:
            MissingIndexError: A dataset has no embeddings of this encoder and camera.
            StaleIndexError: They were made of other data, with another encoder, or differently in
                the two datasets.
            FormatError: They are of an unknown version, or damaged.
        """
        parts = []
        query = self.query_index(encoder, camera)
        for entry in self.manifest.sessions:
            index = self._datasets[entry.dataset].index(encoder, camera)
            if index.made != query.made:
                raise StaleIndexError(
                    f"the embeddings of encoder {encoder!r} were made differently in "
                    f"{self._datasets[self.manifest.query.dataset].files.describe()} and in "
                    f"{self._datasets[entry.dataset].files.describe()}",
                    "Make them again, both at once: robomme-interference index --data SPLIT "
                    f"--encoder {encoder}",
                )
            values = index.span(entry.episode_index, entry.start, entry.stop)
            parts.append(values if entry.repeat == 1 else np.repeat(values, entry.repeat, axis=0))
        if len(parts) == 1:
            return parts[0]
        return np.concatenate(parts) if parts else np.empty((0, query.size), np.float16)

    def query_embedding(self, encoder: str, camera: str = "front") -> NDArray[np.float16]:
        """Look up the embedding of the first live observation, `(D,) float16`; see `embeddings`.

        For grading without a simulator: in a rollout, what the robot sees is embedded then.
        """
        query = self.manifest.query
        index = self.query_index(encoder, camera)
        return index.span(query.episode_index, query.frame, query.frame + 1)[0]

    def query_index(self, encoder: str, camera: str = "front") -> EmbeddingIndex:
        """Return the index of the query's dataset; see `embeddings` for the errors."""
        return self._datasets[self.manifest.query.dataset].index(encoder, camera)

    def stream(
        self,
        chunk: int = 64,
        cameras: tuple[str, ...] | None = None,
        start: int = 0,
        stop: int | None = None,
    ) -> Generator[Chunk]:
        """Decode the buffer, or a span of it, in chunks, in order, holding one chunk at a time.

        With a cache, frames that it lacks are decoded a whole session at a time.

        Args:
            chunk: Frames in a chunk; the last one may be shorter.
            cameras: Names of the cameras; None for all.
            start: First frame of the span.
            stop: Frame after its last one; None for the buffer's end.

        Raises:
            InvalidOptionError: `chunk` is not positive, or the span is not inside the buffer.
            UnknownNameError, MissingFileError, FormatError, TruncatedVideoError: As `frames`.
        """
        if chunk < 1:
            raise InvalidOptionError(f"chunk={chunk}; expected 1 or more")
        end = len(self) if stop is None else stop
        if not 0 <= start <= end <= len(self):
            raise InvalidOptionError(
                f"frames {start} to {end} are not inside the buffer of {self.episode_id} at "
                f"k={self.k}, which has {len(self)} history frames, numbered from 0"
            )
        wanted = self.cameras if cameras is None else cameras
        names = {name: self._feature(name) for name in wanted}
        decoders = {
            name: self._reader.iter_frames(self.sessions, feature, start, end)
            for name, feature in names.items()
        }
        session_index = self.session_index
        try:
            for first in range(start, end, chunk):
                last = min(first + chunk, end)
                frames = {}
                for name, feature in names.items():
                    out = np.empty((last - first, *self._shape(feature)), np.uint8)
                    for position in range(last - first):
                        out[position] = next(decoders[name])
                    frames[name] = out
                yield Chunk(first, frames, self.states[first:last], session_index[first:last])
        finally:
            for decoder in decoders.values():
                decoder.close()

    def verify(self) -> None:
        """Decode everything and compare it with the manifest's SHA-256.

        Raises:
            HashMismatchError: A session's data is not what the manifest names.
        """
        for session in self.sessions:
            entry = session.entry
            dataset = self._datasets[entry.dataset]
            found = dataset.span_digests(entry.episode_index, entry.start, entry.stop)
            if combine(found) == entry.sha256:
                continue
            recorded = dataset.digests(entry.episode_index, entry.start, entry.stop) or {}
            differing = [name for name in found if found[name] != recorded.get(name)]
            raise HashMismatchError(
                f"{self.episode_id} at k={self.k}: {entry.role} {entry.source} "
                f"({entry.dataset} episode {entry.episode_index}, frames {entry.start} to "
                f"{entry.stop - 1}) does not have the SHA-256 of the manifest; differing: "
                f"{', '.join(differing) or 'the manifest itself'}",
                "The data is damaged or belongs to another version: download or build it again, "
                "then run robomme-interference verify SPLIT",
            )

    def _vectors(self, feature: str) -> NDArray[np.float32]:
        parts = []
        for entry in self.manifest.sessions:
            values = self._datasets[entry.dataset].read_vectors(
                entry.episode_index, feature, entry.start, entry.stop
            )
            parts.append(np.repeat(values, entry.repeat, axis=0))
        if not parts:
            shape = self._datasets[self.manifest.query.dataset].features[feature]
            return np.empty((0, *shape), np.float32)
        return np.concatenate(parts)

    def _feature(self, camera: str) -> str:
        name = camera.removeprefix(CAMERA_PREFIX)
        if name not in self.cameras:
            raise UnknownNameError(
                f"camera {camera!r} is not in the buffer of {self.episode_id}",
                nearest(name, self.cameras),
            )
        return CAMERA_PREFIX + name

    def _shape(self, feature: str) -> tuple[int, ...]:
        return self._datasets[self.manifest.query.dataset].features[feature]
