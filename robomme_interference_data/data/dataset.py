"""One of a buffer set's datasets, on disk or on the Hub: demonstrations, distractor units, ….

A LeRobot dataset in which every episode has files of its own, with our columns in `meta/episodes`,
a lean copy of that table in `meta/interference.parquet`, and its identity in
`meta/interference.json`.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import (
    ACTION,
    CAMERA_PREFIX,
    IDENTITY_PATH,
    INFO_PATH,
    RECORDS_PATH,
    STATE,
    SUMS_PATH,
)
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InvalidOptionError,
    MissingFileError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import from_dict, to_dict
from robomme_interference_data.schema.manifest import SessionEntry
from robomme_interference_data.schema.records import DatasetIdentity, EpisodeRecord
from robomme_interference_data.storage.arrays import SpanDigester, combine
from robomme_interference_data.storage.files import (
    Files,
    canonical_json,
    read_header,
    read_sums,
    sha256_file,
)
from robomme_interference_data.storage.lerobot import LeRobotFiles

from .embeddings import EmbeddingIndex


def camera_feature(camera: str) -> str:
    """Return the feature name of a camera, whether `observation.images.` is given or not."""
    if not isinstance(camera, str):
        raise InvalidOptionError.expected("camera", camera, "the name of one, such as 'front'")
    return CAMERA_PREFIX + camera.removeprefix(CAMERA_PREFIX)


def revision_of(records: Iterable[EpisodeRecord]) -> str:
    """Return the SHA-256 over episode records, which is the revision of a dataset of them."""
    revision = hashlib.sha256()
    for record in records:
        revision.update(canonical_json(to_dict(record)).encode(errors="backslashreplace") + b"\n")
    return revision.hexdigest()


class Dataset:
    """One of a buffer set's datasets; which, its `kind` says.

    Args:
        files: How to reach the files.

    Raises:
        MissingFileError: `meta/info.json` or `meta/interference.json` is missing.
        FormatError: One of them is damaged, or of an unknown version.
    """

    def __init__(self, files: Files):
        self.files = files
        with suppress(MissingFileError):  # which is told below, as what it means
            files.fetch((INFO_PATH, IDENTITY_PATH, RECORDS_PATH))
        self.lerobot = LeRobotFiles(files, [RECORDS_PATH])
        try:
            path = files.path(IDENTITY_PATH)
        except MissingFileError:
            raise MissingFileError(
                f"{files.describe()} is a LeRobot dataset, but not one of history sessions: "
                f"{IDENTITY_PATH} is missing",
                "Build one from it.",
                f"build distractors DIR --source lerobot:{files.describe()}",
            ) from None
        self.identity = read_header(path, DatasetIdentity)
        self._indexes: dict[tuple[str, str], EmbeddingIndex] = {}
        self._records: dict[int, EpisodeRecord] = {}
        self._checked = False

    def __repr__(self) -> str:
        return f"Dataset({self.kind}, {self.files.describe()}, episodes={len(self)})"

    def __len__(self) -> int:
        return len(self.lerobot)

    @property
    def kind(self) -> str:
        """Name of the dataset in a buffer set, such as `demonstrations`."""
        return self.identity.kind

    @property
    def revision(self) -> str:
        """Identity of the content: a SHA-256 over all episode records."""
        return self.identity.revision

    @cached_property
    def features(self) -> dict[str, tuple[int, ...]]:
        """Shape of one value by feature name: cameras `(H, W, 3)`, vectors `(D,)`.

        Raises:
            FormatError: `info.json` tells other shapes, or no states.
        """
        found = {
            name: self.lerobot.shape(name)
            for name, feature in self.lerobot.features.items()
            if feature["dtype"] == "video" or name in (STATE, ACTION)
        }
        for name in (STATE, *({ACTION} & found.keys())):
            if len(found.get(name, ())) != 1:
                what = f"{INFO_PATH} tells no vectors {name}, but {found.get(name)}"
                raise FormatError.damaged(self.files.describe(), what)
        return found

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, such as `front` and `wrist`, sorted."""
        names = (n for n in self.features if n.startswith(CAMERA_PREFIX))
        return tuple(sorted(name.removeprefix(CAMERA_PREFIX) for name in names))

    def shape(self, camera: str) -> tuple[int, ...]:
        """Return the shape of a camera's frames, `(H, W, 3)`.

        Raises:
            UnknownNameError: There is no such camera.
        """
        return self.features[self._camera(camera)]

    def record(self, episode_index: int) -> EpisodeRecord:
        """Return the record of an episode.

        Raises:
            UnknownNameError: There is no such episode.
            FormatError: The episode table is damaged.
        """
        record = self._records.get(episode_index)
        if record is None:
            row, where = self.lerobot.row(episode_index), self.files.describe()
            record = self._records[episode_index] = from_dict(EpisodeRecord, row, where)
        return record

    def records(self) -> Iterator[EpisodeRecord]:
        """Yield the records of all episodes, by episode index."""
        if len(self._records) < len(self):
            where = self.files.describe()
            for index, row in enumerate(self.lerobot.table.to_pylist()):
                self._records[index] = from_dict(EpisodeRecord, row, where)
        return (self._records[index] for index in range(len(self)))

    def check_records(self) -> None:
        """Check the records of all episodes against the revision; once.

        Raises:
            HashMismatchError: They are others.
        """
        if not self._checked and revision_of(self.records()) != self.revision:
            raise HashMismatchError(
                f"the episode records of {self.files.describe()} are not those of its revision",
                "The data is damaged: download or build it again.",
                "verify BUFFER_SET",
            )
        self._checked = True

    def session(self, role: str, record: EpisodeRecord) -> SessionEntry:
        """Return the session that an episode of the dataset is: a whole lesson, or a unit.

        Args:
            role: What it is to a query, one of `records.ROLES`.
            record: The episode's record.
        """
        name, sha256 = record.episode_id, combine(record.feature_sha256)
        place = self.kind, self.revision, record.episode_index
        return SessionEntry(role, name.family, name, *place, *record.session, 1, sha256)

    def index_of(self, episode: EpisodeId) -> int:
        """Return the number of an episode in the dataset, by its id.

        Raises:
            UnknownNameError: The dataset does not hold it; offers the nearest id.
        """
        found = self._places.get(str(episode))
        if found is None:
            where = f"the {self.kind} of {self.files.describe()}"
            raise UnknownNameError.among("episode", str(episode), where, self._places)
        return found

    @cached_property
    def _places(self) -> dict[str, int]:
        if "episode_id" not in self.lerobot.table.column_names:
            raise FormatError.damaged(self.files.describe(), "its episodes have no episode_id")
        ids = self.lerobot.table["episode_id"].to_pylist()
        return {str(text): index for index, text in enumerate(ids)}

    def files_of(self, episode_index: int, cameras: Iterable[str]) -> list[str]:
        """Return the paths of the files that hold an episode's vectors and the given cameras."""
        place = self.lerobot.locate(episode_index)
        return [place.data, *(place.videos[self._camera(camera)][0] for camera in cameras)]

    def index(self, encoder: str, camera: str = "front") -> EmbeddingIndex:
        """Return the embeddings of the stored frames, opened once.

        Args:
            encoder: Name of the encoder, such as `thumbnail`.
            camera: Name of the camera, with or without `observation.images.`.

        Raises:
            UnknownNameError: There is no such camera.
            MissingIndexError: The dataset has no embeddings of this encoder and camera.
            MissingIndexError: They were made of other data, or with another encoder.
            FormatError: They are of an unknown version, or damaged.
        """
        if not isinstance(encoder, str):
            raise InvalidOptionError.expected("encoder", encoder, "its name, such as 'thumbnail'")
        key = encoder, self._camera(camera)
        if key not in self._indexes:
            self._indexes[key] = EmbeddingIndex(self.files, self.revision, encoder, camera)
        return self._indexes[key]

    def iter_frames(
        self, episode_index: int, camera: str, start: int, stop: int
    ) -> Iterator[NDArray[np.uint8]]:
        """Decode frames `start` to `stop` (excluded) of an episode, `(H, W, 3) uint8`, in order.

        Raises:
            MissingFileError, FormatError: See `video.iter_frames`.
        """
        return self.lerobot.iter_frames(episode_index, self._camera(camera), start, stop)

    def read_frames(
        self, episode_index: int, camera: str, start: int, out: NDArray[np.uint8]
    ) -> None:
        """Decode frames from `start` on into `out`, `(T, H, W, 3) uint8`.

        Raises:
            MissingFileError, FormatError: See `video.iter_frames`.
        """
        frames = self.iter_frames(episode_index, camera, start, start + len(out))
        for target, frame in zip(out, frames, strict=True):
            target[...] = frame

    def read_vectors(
        self, episode_index: int, feature: str, start: int, stop: int
    ) -> NDArray[np.float32]:
        """Read states or actions of frames `start` to `stop` (excluded), `(T, D) float32`.

        Raises:
            MissingFileError, FormatError: See `LeRobotFiles.vectors`.
        """
        self.lerobot.check_span(episode_index, start, stop)
        return self.lerobot.vectors(episode_index, feature)[start:stop]

    def digests(
        self,
        episode_index: int,
        spans: Sequence[tuple[int, int]],
        watch: Callable[[str, NDArray[Any]], None] | None = None,
    ) -> list[dict[str, str]]:
        """Decode an episode once; return the digests by feature of spans of it, end excluded.

        Args:
            episode_index: The episode.
            spans: First frame, and the one after the last, of each span.
            watch: Called with each feature and value on the way.
        """
        first, last = min(start for start, _ in spans), max(stop for _, stop in spans)
        running = SpanDigester(spans)
        for name in self.features:
            values: Iterable[NDArray[Any]] = (
                self.iter_frames(episode_index, name, first, last)
                if name.startswith(CAMERA_PREFIX)
                else self.read_vectors(episode_index, name, first, last)
            )
            for index, value in enumerate(values, first):
                running.update(name, index, value)
                if watch is not None:
                    watch(name, value)
        return running.digests()

    def sums(self) -> dict[str, str]:
        """Return the recorded SHA-256 of every file but the indexes', by relative path.

        Raises:
            FormatError: The list is not the one that the identity names.
        """
        path = self.files.path(SUMS_PATH)
        if sha256_file(path) != self.identity.sums:
            raise FormatError.damaged(path, f"not the SHA-256 that {IDENTITY_PATH} says")
        return read_sums(path)

    def _camera(self, camera: str) -> str:
        name = camera_feature(camera)
        if name not in self.features:
            where = self.files.describe()
            plain = camera.removeprefix(CAMERA_PREFIX)
            raise UnknownNameError.among("camera", plain, where, self.cameras)
        return name
