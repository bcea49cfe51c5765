"""Read a dataset in the LeRobot v3 layout: episode records, frames and vectors, spans at a time.

Only pyarrow and PyAV are used; tests hold the result against lerobot's own reader.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robomme_interference_data import parquet, video
from robomme_interference_data.constants import (
    ACTION,
    CAMERA_PREFIX,
    STATE,
)
from robomme_interference_data.dataset_meta import (
    LESSON_SHA,
    SHA,
    read_episodes,
    read_identity,
    read_info,
)
from robomme_interference_data.digest import FeatureDigests
from robomme_interference_data.embeddings import EmbeddingIndex
from robomme_interference_data.errors import (
    FormatError,
    TruncatedVideoError,
    UnknownNameError,
    nearest,
)
from robomme_interference_data.files import Files, check_names
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema import EpisodeRecord

__all__ = ["Dataset"]

_ROWS_KEPT = 1024


@dataclass(frozen=True)
class _Place:
    """Where an episode's video lies."""

    path: str
    first_frame: int


class Dataset:
    """Demonstrations or distractor units on disk or on the Hub.

    Args:
        files: How to reach the files.

    Raises:
        MissingFileError: `meta/info.json` or `meta/interference.json` is missing.
        FormatError: One of them is of an unknown version.
    """

    def __init__(self, files: Files):
        self.files = files
        self._rows: dict[int, dict[str, Any]] = {}
        self._indexes: dict[tuple[str, str], EmbeddingIndex] = {}
        self.info = read_info(files)
        self.identity = read_identity(files)

    @property
    def kind(self) -> str:
        """`demonstrations` or `distractors`."""
        return str(self.identity["kind"])

    @property
    def revision(self) -> str:
        """Identity of the content: a SHA-256 over all episode records."""
        return str(self.identity["revision"])

    @cached_property
    def features(self) -> dict[str, tuple[int, ...]]:
        """Shape of one value by feature name: cameras `(H, W, 3)`, vectors `(D,)`."""
        return {
            name: tuple(feature["shape"])
            for name, feature in self.info["features"].items()
            if feature["dtype"] == "video" or name in (STATE, ACTION)
        }

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """Feature names of the cameras, sorted."""
        return tuple(sorted(name for name in self.features if name.startswith(CAMERA_PREFIX)))

    @cached_property
    def episodes(self) -> pa.Table:
        """The per-episode columns (see docs/format.md), by episode index; statistics left out."""
        return read_episodes(self.files, list(self.features), self.info["total_episodes"])

    def __len__(self) -> int:
        return int(self.info["total_episodes"])

    def record(self, episode_index: int) -> EpisodeRecord:
        """Return the record of an episode.

        Raises:
            UnknownNameError: There is no such episode.
        """
        row = self._row(episode_index)
        return EpisodeRecord(
            episode_index=episode_index,
            id=EpisodeId.parse(row["episode_id"]),
            length=row["length"],
            goals=tuple(row["goals"]),
            seed=row["seed"],
            difficulty=row["difficulty"],
            simulator=row["simulator"],
            raw_length=row["raw_length"],
            exec_start_idx=row["exec_start_idx"],
            exact=row["exact"],
            sha256=row["sha256"],
            feature_sha256={n: row[SHA + n] for n in self.features},
            lesson_sha256=row.get("lesson_sha256"),
            lesson_feature_sha256={
                n: row[LESSON_SHA + n] for n in self.features if LESSON_SHA + n in row
            },
        )

    def records(self) -> Iterator[EpisodeRecord]:
        """Yield the records of all episodes, by episode index."""
        return (self.record(index) for index in range(len(self)))

    def index_of(self, episode: EpisodeId) -> int:
        """Return the number of an episode in the dataset, by its id.

        Raises:
            UnknownNameError: The dataset does not hold it; offers the nearest id.
        """
        found = pc.index(self.episodes["episode_id"], str(episode)).as_py()
        if found < 0:
            known = self.episodes["episode_id"].to_pylist()
            raise UnknownNameError(
                f"{episode} is not in the {self.kind} of {self.files.describe()}",
                nearest(str(episode), known),
            )
        return int(found)

    def index(self, encoder: str, camera: str = "front") -> EmbeddingIndex:
        """Return the embeddings of the stored frames, opened once.

        Args:
            encoder: Name of the encoder, such as `thumbnail`.
            camera: Name of the camera, with or without `observation.images.`.

        Raises:
            MissingIndexError: The dataset has no embeddings of this encoder and camera.
            StaleIndexError: They were made of other data, or with another encoder.
            FormatError: They are of an unknown version, or damaged.
        """
        key = encoder, camera
        if key not in self._indexes:
            self._indexes[key] = EmbeddingIndex(self.files, self.revision, encoder, camera)
        return self._indexes[key]

    def digests(self, episode_index: int, start: int, stop: int) -> dict[str, str] | None:
        """Return the recorded feature digests of a span; None if none are recorded for it."""
        record = self.record(episode_index)
        if (start, stop) == (0, record.length):
            return record.feature_sha256
        if (start, stop) == (0, record.exec_start_idx):
            return record.lesson_feature_sha256
        return None

    def iter_frames(
        self, episode_index: int, camera: str, start: int, stop: int
    ) -> Iterator[NDArray[np.uint8]]:
        """Decode frames `start` to `stop` (excluded) of an episode, `(H, W, 3) uint8`, in order.

        Raises:
            MissingFileError, FormatError, TruncatedVideoError: See `video.iter_frames`.
        """
        place = self._video(episode_index, camera, start, stop)
        first = place.first_frame
        return video.iter_frames(
            self.files.path(place.path),
            first + start,
            first + stop,
            self.info["fps"],
            self.features[camera],
        )

    def read_frames(
        self, episode_index: int, camera: str, start: int, out: NDArray[np.uint8]
    ) -> None:
        """Decode frames from `start` on into `out`, `(T, H, W, 3) uint8`.

        Raises:
            MissingFileError, FormatError, TruncatedVideoError: See `video.decode_into`.
        """
        place = self._video(episode_index, camera, start, start + len(out))
        video.decode_into(
            out, self.files.path(place.path), place.first_frame + start, self.info["fps"]
        )

    def read_vectors(
        self, episode_index: int, feature: str, start: int, stop: int
    ) -> NDArray[np.float32]:
        """Read states or actions of frames `start` to `stop` (excluded), `(T, D) float32`.

        Raises:
            MissingFileError: The data file is missing.
            FormatError: It cannot be read, or holds other columns or sizes than it should.
            TruncatedVideoError: It holds fewer frames of the episode than recorded, or the
                episode has no such frames.
        """
        row = self._row(episode_index)
        self._check_span(row, start, stop)
        path = self.files.path(
            self.info["data_path"].format(
                chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
            )
        )
        with parquet.reading(path), pq.ParquetFile(path) as file:
            columns = ["frame_index", feature]
            check_names(path, file.schema_arrow.names, ["episode_index", *columns])
            owners = file.read(columns=["episode_index"])
            keep = parquet.matching(owners, {"episode_index": episode_index})
            rows = list(parquet.read_rows(file, columns, keep))
            table = pa.concat_tables(rows or [file.schema_arrow.empty_table()])
        if not np.array_equal(table["frame_index"].to_numpy(), np.arange(row["length"])):
            raise TruncatedVideoError(
                f"{path}: episode {episode_index} has {len(table)} frames in the data file; "
                f"{row['length']} are recorded",
                "The dataset is damaged: download or build it again.",
            )
        values = table[feature].combine_chunks().flatten().to_numpy(zero_copy_only=False)
        shape = (row["length"], *self.features[feature])
        if values.size != math.prod(shape):
            raise FormatError(
                f"{path}: {feature} of episode {episode_index} has {values.size} values; expected "
                f"{' × '.join(map(str, shape))}",
                "The dataset is damaged: download or build it again.",
            )
        return np.ascontiguousarray(values.reshape(shape)[start:stop], dtype=np.float32)

    def span_digests(self, episode_index: int, start: int, stop: int) -> dict[str, str]:
        """Decode a span and return the digests of all its features; one frame in memory."""
        return next(iter(self._digests(episode_index, start, [stop])))

    def prefix_digests(self, episode_index: int, stops: list[int]) -> list[dict[str, str]]:
        """Decode an episode once; return its digests over frames 0 to each of `stops`."""
        return self._digests(episode_index, 0, stops)

    def _digests(self, episode_index: int, start: int, stops: list[int]) -> list[dict[str, str]]:
        digests: dict[int, dict[str, str]] = {stop: {} for stop in stops}
        for name in self.features:
            running = FeatureDigests()
            values = (
                self.iter_frames(episode_index, name, start, max(stops))
                if name in self.cameras
                else iter(self.read_vectors(episode_index, name, start, max(stops)))
            )
            for index, value in enumerate(values, start + 1):
                running.update(name, value)
                if index in digests:
                    digests[index] |= running.current()
        return [digests[stop] for stop in stops]

    def _row(self, episode_index: int) -> dict[str, Any]:
        if not 0 <= episode_index < len(self):
            raise UnknownNameError(
                f"episode {episode_index} is not in {self.files.describe()}, which has "
                f"{len(self)} episodes"
            )
        row = self._rows.get(episode_index)
        if row is None:
            row = self.episodes.slice(episode_index, 1).to_pylist()[0]
            if len(self._rows) > _ROWS_KEPT:
                self._rows.clear()
            self._rows[episode_index] = row
        return row

    def _check_span(self, row: dict[str, Any], start: int, stop: int) -> None:
        if not 0 <= start <= stop <= row["length"]:
            raise TruncatedVideoError(
                f"{row['episode_id']} has {row['length']} stored frames in "
                f"{self.files.describe()}; frames {start} to {stop - 1} were asked for"
            )

    def _video(self, episode_index: int, camera: str, start: int, stop: int) -> _Place:
        if camera not in self.cameras:
            raise UnknownNameError(
                f"camera {camera!r} is not in {self.files.describe()}",
                nearest(camera, self.cameras),
            )
        row = self._row(episode_index)
        self._check_span(row, start, stop)
        key = f"videos/{camera}/"
        return _Place(
            self.info["video_path"].format(
                video_key=camera,
                chunk_index=row[key + "chunk_index"],
                file_index=row[key + "file_index"],
            ),
            round(row[key + "from_timestamp"] * self.info["fps"]),
        )
