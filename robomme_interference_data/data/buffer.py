"""A history buffer: its sessions in order, and their frames when asked for."""

from bisect import bisect_right
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DISTRACTORS, STATE
from robomme_interference_data.errors import (
    HashMismatchError,
    InvalidOptionError,
    MissingExtraError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId, whole_number
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.schema.evidence import Evidence, map_evidence
from robomme_interference_data.schema.manifest import (
    BufferManifest,
    Session,
    layout_sessions,
)
from robomme_interference_data.storage.arrays import combine
from robomme_interference_data.storage.cache import DecodedCache

from .buffer_set_index import BufferSetIndex
from .dataset import Dataset
from .frame_reader import FrameReader, room_for
from .query import Query

_DAMAGED = "The data is damaged or belongs to another version: download or build it again."
_VERIFY = "verify BUFFER_SET"


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
        self.sessions = layout_sessions(manifest.sessions)
        self._datasets = datasets
        self._reader = FrameReader(self.sessions, datasets, cache, threads)

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
    def _stops(self) -> list[int]:
        return [session.stop for session in self.sessions]

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
        return map_evidence(
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
        query = self.query.dataset, self.query.record.episode_index, wanted
        self._fetch(query, *(self._source(one, wanted) for one in self.sessions))

    def _source(
        self, session: Session, cameras: Sequence[str]
    ) -> tuple[Dataset, int, Sequence[str]]:
        entry = session.entry
        return self._datasets[entry.dataset], entry.episode_index, cameras

    def _fetch(self, *wanted: tuple[Dataset, int, Sequence[str]]) -> None:
        """Bring the vectors and some cameras of episodes here, those of a dataset all at once."""
        episodes: dict[Dataset, list[tuple[int, Sequence[str]]]] = {}
        for dataset, index, cameras in wanted:
            episodes.setdefault(dataset, []).append((index, cameras))
        for dataset, some in episodes.items():
            dataset.files.fetch(path for one in some for path in dataset.files_of(*one))

    def frames(self, camera: str = "front") -> NDArray[np.uint8]:
        """Decode all frames of a camera, sessions side by side on several threads.

        Args:
            camera: Name of the camera, with or without `observation.images.`.

        Returns:
            `(T, H, W, 3) uint8` RGB; a new array.

        Raises:
            UnknownNameError: There is no such camera.
            MissingFileError, FormatError: A video cannot be read.
        """
        out = room_for(len(self), self.query.dataset.shape(camera))
        self._fetch(*(self._source(one, [camera]) for one in self.sessions))
        self._reader.read(camera, out)
        return out

    def frame(self, index: int, camera: str = "front") -> NDArray[np.uint8]:
        """Decode one frame of the buffer, `(H, W, 3) uint8` RGB.

        Args:
            index: Index in the buffer, 0 to `len(buffer) - 1`.
            camera: As for `frames`.

        Raises:
            InvalidOptionError: `index` is no whole number.
            UnknownNameError: There is no such frame or camera.
            MissingFileError, FormatError: As for `frames`.
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
            MissingFileError, FormatError: As for `frames`.
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
        used = {*np.searchsorted(self._stops, chosen, side="right").tolist()}
        sources = enumerate(self.sessions)
        # All at once: a chunk would wait for its videos otherwise. States are of all sessions.
        self._fetch(*(self._source(one, wanted if n in used else ()) for n, one in sources))
        decoders = {name: self._reader.iter(name, chosen.tolist()) for name in wanted}
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

    def index(self, encoder: str, camera: str = "front") -> BufferSetIndex:
        """Open the indexes of the datasets that the buffer needs; see `SplitIndex`."""
        needed = {DISTRACTORS, self.query.dataset.kind} & {*self._datasets}
        needed |= {entry.dataset for entry in self.manifest.sessions}
        datasets = {name: self._datasets[name] for name in sorted(needed)}
        return BufferSetIndex(datasets, encoder, camera)

    def embeddings(self, encoder: str, camera: str = "front") -> NDArray[np.float32]:
        """Look up the embeddings of all frames; none is decoded.

        Args:
            encoder: Name of the encoder, such as `thumbnail`, whose index lies in the datasets.
            camera: Name of the camera, with or without `observation.images.`.

        Returns:
            `(T, D) float32`, each of length 1, in the buffer's order; a new array.

        Raises:
            MissingIndexError, FormatError: See `SplitIndex`.
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
            MissingIndexError, FormatError: See `SplitIndex`.
        """
        place = self.query.first_frame
        span = place.dataset, place.episode_index, place.frame, place.frame + 1
        return self.index(encoder, camera).span(*span)[0]

    def verify(self) -> None:
        """Check the manifest, decode everything, and compare it with the recorded SHA-256.

        From then on, what a cache holds is compared too, whenever it is read.

        Raises:
            HashMismatchError: The manifest contradicts the query's record, a dataset's records
                are not those of its revision, or frames or states are not the recorded ones.
        """
        self._reader.verified = True
        query, manifest = self.query, self.manifest
        for dataset in {query.dataset, *(self._datasets[e.dataset] for e in manifest.sessions)}:
            dataset.check_records()
        condition = parse_condition(manifest.condition)
        planned = query.manifest(condition, manifest.sessions, exact=manifest.exact)
        for name, value in vars(planned).items():
            if getattr(manifest, name) != value:
                what = f"{name} of {manifest} is not that of its query and sessions"
                raise HashMismatchError(what, _DAMAGED, _VERIFY)
        for entry in manifest.sessions:
            span = entry.start, entry.stop
            what = f"{entry.role} {entry.source}"
            self._check_span(what, entry.dataset, entry.episode_index, span, entry.sha256)
        place, recorded = query.first_frame, query.record.span_sha256
        span = place.frame, place.frame + 1
        sha256 = recorded.query if recorded else ""
        self._check_span("first live view", place.dataset, place.episode_index, span, sha256)

    def _check_span(
        self, what: str, name: str, index: int, span: tuple[int, int], sha256: str
    ) -> None:
        dataset = self._datasets[name]
        [found] = dataset.digests(index, [span])
        if combine(found) == sha256:
            return
        recorded = dataset.record(index).digests(*span)
        differing = [name for name in found if recorded and found[name] != recorded.get(name)]
        raise HashMismatchError(
            f"{self.manifest}: {what} ({name} episode {index}, frames {span[0]} to {span[1] - 1}) "
            f"does not have the recorded SHA-256{': ' * bool(differing)}{', '.join(differing)}",
            _DAMAGED,
            _VERIFY,
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
