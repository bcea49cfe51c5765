"""One of a buffer set's datasets, on disk or on the Hub: demonstrations, distractor units, ….

It is a LeRobot dataset in which every episode has its own files, with our columns in
`meta/episodes`, a smaller copy of that table in `meta/interference.parquet`, and its identity in
`meta/interference.json`.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
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
    Unit,
)
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InvalidOptionError,
    MissingFileError,
    UnknownNameError,
    named,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import from_dict, to_dict
from robomme_interference_data.schema.manifest import TEACHING, SessionEntry
from robomme_interference_data.schema.records import DatasetIdentity, EpisodeRecord, EvidenceSpan
from robomme_interference_data.storage.arrays import EMPTY_SHA256, combine, digest_spans
from robomme_interference_data.storage.files import Files, read_sums, sha256_file
from robomme_interference_data.storage.lerobot.dataset import LeRobotFiles
from robomme_interference_data.storage.text import digest_json, read_header


def camera_feature(camera: str) -> str:
    """Return the feature name of a camera, with or without `observation.images.`."""
    if not isinstance(camera, str):
        raise InvalidOptionError.expected("camera", camera, "the name of one, such as 'front'")
    return CAMERA_PREFIX + camera.removeprefix(CAMERA_PREFIX)


_COUNTED = ("total_episodes", "total_frames", "total_tasks", "splits")
"""Fields of `info.json` that follow from the episodes."""


def revision_of(
    identity: DatasetIdentity, info: Mapping[str, Any], records: Iterable[EpisodeRecord]
) -> str:
    """Return the revision of a dataset: the SHA-256 over what describes its content.

    That is all of its identity that does not follow from the rest, `info.json` without its counts,
    and the episode records, which hold the digests of all frames and vectors.
    """
    described = {
        "kind": identity.kind,
        "codec": identity.codec,
        "unit": identity.unit,
        "sources": list(identity.sources),
        "info": {name: value for name, value in info.items() if name not in _COUNTED},
    }
    return digest_json([described, *map(to_dict, records)], end="\n")


class Dataset:
    """One of a buffer set's datasets.

    Attributes:
        files: Access to its files, the only argument.
        lerobot: Its LeRobot part.
        identity: Content of `meta/interference.json`.

    Raises:
        MissingFileError: `meta/info.json` or `meta/interference.json` is missing.
        FormatError: One of them is damaged, or of an unknown version.
    """

    def __init__(self, files: Files):
        self.files = files
        with suppress(MissingFileError):  # reported below
            # All at once, if they are on the Hub.
            files.fetch((INFO_PATH, IDENTITY_PATH, RECORDS_PATH))
        # The small copy of the episode table: LeRobot's own also has statistics of every feature.
        self.lerobot = LeRobotFiles(files, [RECORDS_PATH])
        try:
            path = files.path(IDENTITY_PATH)
        except MissingFileError:
            raise MissingFileError(
                f"{files.describe()} is a LeRobot dataset, but not one of history sessions: "
                f"{IDENTITY_PATH} is missing",
                "Build one from it.",
                f"build DIR --only distractors --source lerobot:{files.location}",
            ) from None
        self.identity = read_header(path, DatasetIdentity)
        self._name = files.describe()
        self._records: dict[int, EpisodeRecord] = {}
        self._checked = False

    def __reduce__(self) -> tuple[Any, ...]:
        return _open_again, (self.files, self.revision)

    def __repr__(self) -> str:
        return f"Dataset({self.kind}, {self._name}, episodes={len(self)})"

    def __len__(self) -> int:
        return len(self.lerobot)

    @property
    def kind(self) -> str:
        """Name of the dataset in a buffer set, such as `demonstrations`."""
        return self.identity.kind

    @property
    def unit(self) -> Unit:
        """Size of its units.

        Raises:
            FormatError: The identity records no valid one.
        """
        stored = self.identity.unit
        known = {*Unit._fields}
        needed = known - {*Unit._field_defaults}
        if stored is None or not needed <= {*stored} <= known or min(stored.values()) < 1:
            raise FormatError.damaged(self._name, f"{IDENTITY_PATH}: unit is {stored}")
        return Unit(**stored)

    @property
    def revision(self) -> str:
        """Identity of the content, see `revision_of`."""
        return self.identity.revision

    @cached_property
    def features(self) -> dict[str, tuple[int, ...]]:
        """Shape of one value by feature name: cameras `(H, W, 3)`, vectors `(D,)`.

        States of recordings without any are `(0,)`: LeRobot cannot store them, so `info.json` lacks
        them, and their digest is that of no bytes.

        Raises:
            FormatError: `info.json` has other shapes, or no states although some are recorded.
        """
        shapes = {
            name: self.lerobot.shape(name)
            for name, feature in self.lerobot.features.items()
            if feature["dtype"] == "video" or name in (STATE, ACTION)
        }
        if STATE not in shapes and self._is_stateless():
            shapes[STATE] = (0,)
        for name in (STATE, *({ACTION} & shapes.keys())):
            if len(shapes.get(name, ())) != 1:
                what = f"{INFO_PATH}: {name} has shape {shapes.get(name)}; expected (D,)"
                raise FormatError.damaged(self._name, what)
        return shapes

    @property
    def fps(self) -> float:
        """Recorded frames per second."""
        return self.lerobot.fps

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, such as `front` and `wrist`, sorted; the first is every default."""
        names = (n for n in self.features if n.startswith(CAMERA_PREFIX))
        return tuple(sorted(name.removeprefix(CAMERA_PREFIX) for name in names))

    def camera(self, name: str | None = None, option: str = "camera") -> str:
        """Return the name of a camera without `observation.images.`: every default is taken here.

        Args:
            name: Name of the camera, with or without `observation.images.`; None for the first.
            option: The setting that takes the name, for errors.

        Raises:
            UnknownNameError: There is no such camera, or none at all.
        """
        plain = None if name is None else camera_feature(name).removeprefix(CAMERA_PREFIX)
        if not self.cameras:
            raise UnknownNameError(
                f"{self._name} was stored without images; a camera is needed",
                f"Build a buffer set with {named('cameras')}, such as front.",
            )
        if plain is None:
            return self.cameras[0]
        if plain not in self.cameras:
            raise UnknownNameError(
                f"camera {plain!r} is not in {self._name}",
                f"Set {named(option)} to one of its cameras: {', '.join(self.cameras)}.",
            )
        return plain

    def shape(self, camera: str | None = None) -> tuple[int, ...]:
        """Return the shape of a camera's frames, `(H, W, 3)`; see `camera`.

        Raises:
            UnknownNameError: There is no such camera.
        """
        return self.features[self._feature(camera)]

    def record(self, episode_index: int) -> EpisodeRecord:
        """Return the record of an episode.

        Raises:
            UnknownNameError: There is no such episode.
            FormatError: The episode table is damaged.
        """
        record = self._records.get(episode_index)
        if record is None:
            row = self.lerobot.row(episode_index)
            record = self._records[episode_index] = from_dict(EpisodeRecord, row, self._name)
        return record

    def records(self) -> Iterator[EpisodeRecord]:
        """Yield the records of all episodes, by episode index."""
        if len(self._records) < len(self):
            # Converting the whole table at once is faster than row by row.
            for index, row in enumerate(self.lerobot.table.to_pylist()):
                self._records[index] = from_dict(EpisodeRecord, row, self._name)
        return (self._records[index] for index in range(len(self)))

    def check_records(self) -> None:
        """Check the records of all episodes, and what describes them, against the revision; once.

        Raises:
            HashMismatchError: They differ.
        """
        # Every verified buffer and every run asks for it.
        if self._checked:
            return
        if revision_of(self.identity, self.lerobot.info, self.records()) != self.revision:
            raise HashMismatchError.damaged(
                f"the episode records of {self._name}, its identity and {INFO_PATH} are not those "
                "of its revision"
            )
        self._checked = True

    def session(self, role: str, record: EpisodeRecord) -> SessionEntry:
        """Return the session of an episode, a whole lesson or a unit, in one of `ROLES`."""
        name, sha256 = record.episode_id, combine(record.feature_sha256)
        stored = self.kind, self.revision, record.episode_index
        return SessionEntry(role, name.family, name, *stored, *record.session, 1, sha256)

    def evidence(self, entry: SessionEntry) -> Sequence[EvidenceSpan] | None:
        """Return the evidence of the episode, or of the task of a day, that a session is of.

        Tasks of a day that are no lesson of the query have none: they show other answers.
        """
        record = self.record(entry.episode_index)
        if record.day is None:
            return record.evidence
        if entry.role not in TEACHING:
            return ()
        spans = (span for span in record.day.spans if span.start <= entry.start < span.stop)
        return [shown for span in spans for shown in span.evidence]

    def index_of(self, episode: EpisodeId) -> int:
        """Return the number of an episode in the dataset, by its id.

        Raises:
            UnknownNameError: The dataset does not hold it; offers the nearest id.
        """
        index = self._index_by_id.get(str(episode))
        if index is None:
            where = f"the {self.kind} of {self._name}"
            raise UnknownNameError.among("episode", str(episode), where, self._index_by_id)
        return index

    @cached_property
    def _index_by_id(self) -> dict[str, int]:
        if "episode_id" not in self.lerobot.table.column_names:
            raise FormatError.damaged(self._name, "its episodes have no episode_id")
        ids = self.lerobot.table["episode_id"].to_pylist()
        return {str(text): index for index, text in enumerate(ids)}

    def files_of(self, episode_index: int, cameras: Iterable[str]) -> list[str]:
        """Return the paths of the files that hold an episode's vectors and the given cameras."""
        data = self.lerobot.locate(episode_index).data
        features = [self._feature(camera) for camera in cameras]
        return [data, *(self.lerobot.locate_video(episode_index, name).path for name in features)]

    def video_of(self, episode_index: int, camera: str) -> tuple[Path, int]:
        """Return the video file of an episode, and the number of its first frame there.

        Raises:
            UnknownNameError: There is no such camera.
            MissingFileError: The file is missing.
        """
        location = self.lerobot.locate_video(episode_index, self._feature(camera))
        return self.files.path(location.path), location.first

    def iter_frames(
        self, episode_index: int, camera: str | None, start: int, stop: int
    ) -> Iterator[NDArray[np.uint8]]:
        """Decode frames `start` to `stop` (excluded) of an episode, `(H, W, 3) uint8`, in order.

        Raises:
            MissingFileError, FormatError: See `video.iter_frames`.
        """
        return self.lerobot.iter_frames(episode_index, self._feature(camera), start, stop)

    def read_frames(
        self, episode_index: int, camera: str | None, start: int, out: NDArray[np.uint8]
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
            UnknownNameError: The dataset has no such states or actions.
            MissingFileError, FormatError: See `LeRobotFiles.vectors`.
        """
        vectors = [name for name in self.features if not name.startswith(CAMERA_PREFIX)]
        if feature not in vectors:
            raise UnknownNameError.among("feature", feature, self._name, vectors)
        self.lerobot.check_span(episode_index, start, stop)
        if self.features[feature] == (0,):
            return np.empty((stop - start, 0), np.float32)
        return self.lerobot.vectors(episode_index, feature)[start:stop]

    def digests(self, episode_index: int, spans: Sequence[tuple[int, int]]) -> list[dict[str, str]]:
        """Decode an episode once and return the digests by feature of its spans, ends excluded."""
        # Each feature is read once for all spans: decoding takes far longer than hashing.
        first, last = min(start for start, _ in spans), max(stop for _, stop in spans)

        def values(name: str) -> Iterable[NDArray[Any]]:
            read = self.iter_frames if name.startswith(CAMERA_PREFIX) else self.read_vectors
            return read(episode_index, name, first, last)

        return digest_spans(spans, ((name, values(name)) for name in self.features), first)

    def sums(self) -> dict[str, str]:
        """Return the recorded SHA-256 by relative path of every file except embedding indexes.

        Raises:
            FormatError: The list does not have the SHA-256 in the identity.
        """
        path = self.files.path(SUMS_PATH)
        if sha256_file(path) != self.identity.sums:
            raise FormatError.damaged(path, f"not the SHA-256 in {IDENTITY_PATH}")
        return read_sums(path)

    def _is_stateless(self) -> bool:
        """Return whether the records are of episodes that were recorded without states."""
        return len(self) > 0 and self.record(0).feature_sha256.get(STATE) == EMPTY_SHA256

    def _feature(self, camera: str | None) -> str:
        return camera_feature(self.camera(camera))


def _open_again(files: Files, revision: str) -> Dataset:
    """Return an unpickled dataset, or a copy of one: open files cannot be pickled."""
    dataset = Dataset(files)
    if dataset.revision != revision:
        raise HashMismatchError(
            f"{files.describe()} has revision {dataset.revision[:12]}…; the dataset that was "
            f"pickled had {revision[:12]}…",
            "Open it again; do not change data that is in use.",
        )
    return dataset
