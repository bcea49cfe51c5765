"""A history buffer: its sessions in order, and their frames, decoded on demand."""

from bisect import bisect_right
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DISTRACTORS
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.ids import EpisodeId, whole_number
from robomme_interference_data.schema.manifest import BufferManifest, SessionEntry, layout_sessions
from robomme_interference_data.schema.other_states import OtherStates, check_rule

from .dataset import Dataset
from .frame_reader import FrameReader, allocate_frames
from .query import Query
from .state_reader import StateReader

if TYPE_CHECKING:
    from robomme_interference_data.schema.evidence import Evidence
    from robomme_interference_data.storage.cache import DecodedCache

    from .embeddings import BufferSetIndex


@dataclass(frozen=True)
class Chunk:
    """Consecutive frames from `Buffer.stream`; the arrays are copies.

    Attributes:
        indices: Indices of the frames in the buffer, ascending, `(n,) int64`.
        frames: By camera, `(n, H, W, 3) uint8` RGB.
        states: Robot states, `(n, 8) float32`, see `Buffer.states` and `Buffer.stream`.
        session_index: Number of each frame's session, from 0, `(n,) int64`.
    """

    indices: NDArray[np.int64]
    frames: dict[str, NDArray[np.uint8]]
    states: NDArray[np.float32]
    session_index: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.session_index)


class Buffer:
    """A history buffer, returned by `load_buffer`; frames are decoded on demand.

    Attributes:
        manifest: Which sessions the buffer holds, and their digests.
        query: The query episode: its goal and the first live observation.
        sessions: The sessions in order, with their frame ranges in the buffer.
    """

    def __init__(
        self,
        manifest: BufferManifest,
        query: Query,
        datasets: Mapping[str, Dataset],
        *,
        cache: "DecodedCache | None" = None,
        threads: int | None = None,
        check_rules: Callable[[BufferManifest], None] | None = None,
    ):
        self.manifest = manifest
        self.query = query
        self.sessions = layout_sessions(manifest.sessions)
        self._datasets, self._check_rules = datasets, check_rules
        self._reader = FrameReader(self.sessions, datasets, cache, threads)
        self._states = StateReader(manifest, query.dataset, datasets)

    def __repr__(self) -> str:
        return (
            f"Buffer({self.episode_id}, {self.condition}, frames={len(self)}, "
            f"sessions={len(self.sessions)}, cameras={list(self.cameras)})"
        )

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
        """Number of each frame's session, from 0, `(T,) int64`; a new array."""
        numbers = np.arange(len(self.sessions), dtype=np.int64)
        return np.repeat(numbers, list(map(len, self.sessions)))

    @property
    def states(self) -> NDArray[np.float32]:
        """Robot states, `(T, 8) float32`: 7 joint positions in rad, the gripper; a new array.

        Raises:
            InvalidOptionError: A unit is of a robot with another number of values; see `states_by`.
        """
        return self.states_by("refuse")

    def states_by(self, other_states: OtherStates) -> NDArray[np.float32]:
        """Return the states with the query's number of values, `(T, D) float32`; a new array.

        Args:
            other_states: What to do with states of another number of values: `refuse`, `pad` (zeros
                after fewer values) or `omit` (zeros in place of all values).

        Raises:
            InvalidOptionError: The rule is `refuse`, or `pad` with more values than the query's.
        """
        # A copy: later chunks of `stream` are cut from this array.
        return self._states.all(other_states).copy()

    def session_states(self, session: int) -> NDArray[np.float32]:
        """Return the states of a session as they were recorded, `(n, D) float32`; a new array.

        Args:
            session: Number of the session, from 0.
        """
        return self._states.session(session).copy()

    def gather[Value: np.generic](
        self, read: Callable[[SessionEntry], NDArray[Value]], empty: NDArray[Value]
    ) -> NDArray[Value]:
        """Return values of all frames, read session by session; held frames repeat.

        Args:
            read: Returns the values of a session's stored frames.
            empty: Values of no frames, `(0, …)`.

        Returns:
            `(T, …)`, in the buffer's order; a new array.
        """
        sessions = self.manifest.sessions
        # A held frame is stored once, and counts `repeat` times.
        values = (np.repeat(read(entry), entry.repeat, 0) for entry in sessions)
        return np.concatenate([empty, *values])

    @cached_property
    def evidence(self) -> "tuple[Evidence, ...] | None":
        """Frames of the buffer that show parts of the hidden answer, session by session.

        None if that is unknown for a lesson, or for a contradicting lesson, in the buffer.
        """
        from robomme_interference_data.schema.evidence import map_evidence

        return map_evidence(
            self.sessions, lambda entry: self._datasets[entry.dataset].evidence(entry)
        )

    def fetch(self, cameras: Sequence[str] | None = None) -> None:
        """Download the files of the buffer and its query, if they are on the Hub.

        Args:
            cameras: Names of the cameras; None for all.

        Raises:
            InvalidOptionError: `cameras` is one name instead of several.
            UnknownNameError: There is no such camera.
            MissingFileError, HubError: A file is missing, or the Hub cannot be reached.
        """
        names = self._names(cameras)
        self._fetch([names] * len(self.sessions), names)

    def _names(self, cameras: Sequence[str] | None) -> tuple[str, ...]:
        """Return these cameras, None for all; an unknown one is an error, also in a folder."""
        # A text would be taken as a list of names of one letter each.
        if isinstance(cameras, str) or not isinstance(cameras, Iterable | None):
            raise InvalidOptionError.expected("cameras", cameras, "their names: ['front', 'wrist']")
        names = self.cameras if cameras is None else tuple(cameras)
        for name in names:
            self.query.dataset.shape(name)
        return names

    def _fetch(self, cameras: Iterable[Sequence[str]], query: Sequence[str] | None = None) -> None:
        """Download states and the given cameras of each session, all files of a dataset at once."""
        episodes_of: dict[Dataset, list[tuple[int, Sequence[str]]]] = {}
        for entry, names in zip(self.manifest.sessions, cameras, strict=True):
            dataset = self._datasets[entry.dataset]
            episodes_of.setdefault(dataset, []).append((entry.episode_index, names))
        if query is not None:
            record = self.query.record
            episodes_of.setdefault(self.query.dataset, []).append((record.episode_index, query))
        for dataset, episodes in episodes_of.items():  # lazily: local datasets need no paths
            dataset.files.fetch(path for held in episodes for path in dataset.files_of(*held))

    def frames(self, camera: str | None = None) -> NDArray[np.uint8]:
        """Decode all frames of a camera, on several threads.

        Args:
            camera: Name of the camera, with or without `observation.images.`; None for the first.

        Returns:
            `(T, H, W, 3) uint8` RGB; a new array.

        Raises:
            UnknownNameError: There is no such camera.
            MissingFileError, FormatError: A video cannot be read.
            HashMismatchError: With a cache: frames do not have the recorded SHA-256.
        """
        name = self.query.dataset.camera(camera)
        out = allocate_frames(len(self), self.query.dataset.shape(name))
        # Before anything is decoded: the Hub's files come several at a time, not one by one.
        self._fetch([[name]] * len(self.sessions))
        self._reader.read(name, out)
        return out

    def frame(self, index: int, camera: str | None = None) -> NDArray[np.uint8]:
        """Decode one frame of the buffer, `(H, W, 3) uint8` RGB.

        Args:
            index: Index in the buffer, 0 to `len(buffer) - 1`.
            camera: As for `frames`.

        Raises:
            InvalidOptionError: `index` is not an integer.
            UnknownNameError: There is no such frame or camera.
            MissingFileError, FormatError: As for `frames`.
        """
        index = whole_number("index", index, "an integer from 0, such as 3")
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
        other_states: OtherStates = "refuse",
    ) -> Generator[Chunk]:
        """Decode the buffer, or some of its frames, in chunks; one chunk is in memory at a time.

        With a cache, missing frames are decoded a whole session at a time.

        Args:
            chunk: Frames per chunk; the last one may be shorter.
            cameras: Names of the cameras; None for all.
            indices: Indices of the frames, strictly ascending; None for all.
            other_states: What to do with states of another number of values than the query's, see
                `states_by`; `omit` if states are not used.

        Raises:
            InvalidOptionError: `chunk` is not positive, the indices do not ascend, an argument has
                the wrong type, or `other_states` does not allow the states of a session.
            UnknownNameError: The buffer has no such frame or camera.
            MissingFileError, FormatError: As for `frames`.
        """
        chunk = whole_number("chunk", chunk, "an integer from 1", 1)
        chosen = self._chosen(indices)
        names = self._names(cameras)
        shapes = {name: self.query.dataset.shape(name) for name in names}
        session_index = self.session_index
        used = {*session_index[chosen].tolist()}
        check_rule(other_states)
        # Fetched together, so that no chunk waits for its videos. `states` needs all sessions.
        self._fetch(names if number in used else () for number in range(len(self.sessions)))
        decoders = {name: self._reader.iter(name, chosen.tolist()) for name in names}
        try:
            for first in range(0, len(chosen), chunk):
                # A copy, since the caller owns the chunk.
                indices_now = chosen[first : first + chunk].copy()
                frames = {}
                for name, shape in shapes.items():
                    frames[name] = np.empty((len(indices_now), *shape), np.uint8)
                    for image in frames[name]:
                        image[...] = next(decoders[name])
                states = self._states.all(other_states)[indices_now]
                yield Chunk(indices_now, frames, states, session_index[indices_now])
        finally:
            # Also if the caller stops early: each holds an open file and its decoder.
            for decoder in decoders.values():
                decoder.close()

    def index(self, encoder: str, camera: str | None = None) -> "BufferSetIndex":
        """Open the embedding indexes of the datasets that the buffer needs.

        Args:
            encoder: Name of the encoder, such as `thumbnail`.
            camera: Name of the camera, with or without `observation.images.`; None for the first.

        Raises:
            MissingFileError: A dataset has no embeddings of this encoder and camera, or they were
                made of other data or with another encoder.
            FormatError: They are damaged.
        """
        from .embeddings import BufferSetIndex

        # The index of the units has what makes all embeddings comparable: center, typical cosine.
        needed = {DISTRACTORS, self.query.dataset.kind} & {*self._datasets}
        needed |= {entry.dataset for entry in self.manifest.sessions}
        datasets = {name: self._datasets[name] for name in sorted(needed)}
        return BufferSetIndex(datasets, encoder, camera)

    def embeddings(self, encoder: str, camera: str | None = None) -> NDArray[np.float32]:
        """Read the stored embeddings of all frames; no video is decoded.

        Args and errors are those of `index`.

        Returns:
            `(T, D) float32`, each of length 1, in the buffer's order; a new array.
        """
        index = self.index(encoder, camera)
        return self.gather(
            lambda entry: index.span(entry.dataset, entry.episode_index, entry.start, entry.stop),
            np.empty((0, index.size), np.float32),
        )

    def query_embedding(self, encoder: str, camera: str | None = None) -> NDArray[np.float32]:
        """Read the stored embedding of the first live observation, `(D,) float32`.

        Use it to grade retrieval without a simulator; a rollout embeds the live image instead.
        Args and errors are those of `index`.
        """
        stored = self.query.first_frame
        span = stored.dataset, stored.episode_index, stored.frame, stored.frame + 1
        return self.index(encoder, camera).span(*span)[0]

    def verify(self) -> None:
        """Check the manifest, decode everything, and compare it with the recorded SHA-256.

        Raises:
            HashMismatchError: The manifest is not the one that the rules give, a dataset does not
                have its revision, or frames or states differ from the recorded ones.
        """
        from .verified import verify_buffer  # most buffers are not verified

        verify_buffer(self.manifest, self.query, self._datasets, self._check_rules)

    def _chosen(self, indices: Sequence[int] | None) -> NDArray[np.int64]:
        """Return the indices of the frames to stream, `(n,) int64`."""
        if indices is None:
            return np.arange(len(self))
        chosen = np.asarray(indices)
        if not chosen.size:
            return np.empty(0, np.int64)
        if chosen.ndim != 1 or chosen.dtype.kind not in "iu" or (np.diff(chosen) < 1).any():
            expected = "strictly ascending integers, such as range(64)"
            raise InvalidOptionError.expected("indices", indices, expected)
        self._check_inside(int(chosen[0]), int(chosen[-1]))
        return chosen.astype(np.int64)

    def _check_inside(self, *indices: int) -> None:
        for index in indices:
            if not 0 <= index < len(self):
                raise UnknownNameError(
                    f"frame {index} is not in the buffer of {self.manifest}, whose "
                    f"{len(self)} history frames are numbered from 0"
                )
