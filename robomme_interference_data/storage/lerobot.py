"""Read LeRobot datasets with pyarrow and PyAV alone: v3.0, and v2.1 as its variant.

The only reader of that layout: history datasets of this package and recordings of anybody else go
through it. Tests hold it against lerobot's own.
"""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robomme_interference_data.constants import EPISODES_DIR, INFO_PATH, TASKS_PATH
from robomme_interference_data.errors import FormatError, MissingFileError, UnknownNameError

from . import video
from .files import Files, parse_json, read_bytes, read_json
from .lerobot_layout import (
    VERSIONS,
    EpisodeLocation,
    check_info,
    place_episode,
)
from .parquet import RowSpan, is_plain, open_parquet, read_table, reading

_V21_EPISODES = "meta/episodes.jsonl"
_V21_TASKS = "meta/tasks.jsonl"

_MOST_LINES = 64 << 20
"""Bytes of v2.1's per-episode columns, at most: those of half a million episodes."""

_MOST_NUMBERS = 4096
"""Numbers in a vector of a frame, at most: a held frame's are repeated in a buffer."""

_MOST_BYTES = 1 << 30
"""Bytes that the per-episode columns may take in all: a million episodes have less."""

_MOST_COLUMNS = 1000
"""Of v2.1's per-episode columns, at most: each row may name others."""


class LeRobotFiles:
    """A LeRobot dataset: its metadata, and values and frames of its episodes.

    Args:
        files: How to reach the dataset.
        tables: Paths of its episode tables, if they are known: on the Hub, to list files takes
            longer than to fetch these.
    """

    def __init__(self, files: Files, tables: Sequence[str] = ()):
        self.files = files
        self._tables = tables
        self._rows: dict[int, dict[str, Any]] = {}
        try:
            path = files.path(INFO_PATH)
        except MissingFileError as error:
            raise MissingFileError(
                f"{files.describe()} is no LeRobot dataset: {INFO_PATH} is missing",
                "Point to the folder that holds meta/, data/ and videos/.",
            ) from error
        self.info = read_json(path)
        self.version = self.info.get("codebase_version")
        if self.version not in VERSIONS:
            raise FormatError(
                f"{files.describe()} is a LeRobot dataset of version {self.version!r}; this "
                f"package reads {' and '.join(VERSIONS)}",
                "Convert it with LeRobot's own scripts (lerobot.scripts."
                "convert_dataset_v21_to_v30 and its predecessors).",
            )
        check_info(self.info, path)

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(self.info["fps"])

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """The dataset's columns, with `dtype` and `shape`."""
        return dict(self.info["features"])

    def shape(self, column: str) -> tuple[int, ...]:
        """Return the shape of a column's values; of a camera `(H, W, 3)`, however it is told."""
        feature = self.info["features"][column]
        shape = tuple(feature["shape"])
        if feature["dtype"] in ("video", "image"):
            if len(shape) == 3 and shape[2] != 3:
                shape = (*shape[1:], shape[0])
            if len(shape) != 3 or shape[2] != 3:
                what = f"{INFO_PATH} says that {column} has shape {feature['shape']}"
                raise FormatError.damaged(self.files.describe(), what)
        return shape

    def __len__(self) -> int:
        return int(self.info["total_episodes"])

    @cached_property
    def table(self) -> pa.Table:
        """The per-episode columns by episode index, without statistics."""
        table = self._v30_table() if self.version == "v3.0" else self._v21_table()
        where = self.files.describe()
        for name in ("episode_index", "length"):
            column = table[name] if name in table.column_names else pa.nulls(1)
            if column.null_count or not pa.types.is_integer(column.type):
                raise FormatError.damaged(where, f"its episodes have no whole numbers {name!r}")
        table = table.sort_by("episode_index")
        if not np.array_equal(table["episode_index"].to_numpy(), np.arange(len(self))):
            raise FormatError.damaged(
                where, f"meta/ does not list the episodes 0 to {len(self) - 1}, each once"
            )
        return table.combine_chunks()

    @cached_property
    def tasks(self) -> dict[str, Any]:
        """The index of each task text that the dataset lists."""
        if self.version == "v2.1":
            rows = list(self._json_lines(_V21_TASKS))
        else:
            rows = RowSpan(self.files.path(TASKS_PATH)).table().to_pylist()
        texts = (str(row.get("task", row.get("__index_level_0__"))) for row in rows)
        return {text: row.get("task_index") for text, row in zip(texts, rows, strict=True)}

    def row(self, index: int) -> dict[str, Any]:
        """Return the per-episode columns of an episode as plain values."""
        if not 0 <= index < len(self):
            raise UnknownNameError(
                f"episode {index} is not in {self.files.describe()}, which has {len(self)} episodes"
            )
        row = self._rows.get(index)
        if row is None:
            row = self._rows[index] = self.table.slice(index, 1).to_pylist()[0]
        return row

    def locate(self, index: int) -> EpisodeLocation:
        """Return where an episode lies."""
        return place_episode(self.info, index, self.row(index), self.files.describe())

    def rows(self, index: int) -> RowSpan:
        """Return the rows of an episode in its data file."""
        place = self.locate(index)
        path = self.files.path(place.data)
        whole = RowSpan(path)
        found = np.flatnonzero(whole.scalars("episode_index") == index)
        start = int(found[0]) if len(found) else 0
        rows = whole.part(start, start + len(found))
        numbers = np.arange(len(found))  # as many as there are, whatever length the metadata says
        if (
            len(found) != place.length
            or (found != start + numbers).any()
            or (rows.scalars("frame_index") != numbers).any()
        ):
            raise FormatError(
                f"{path} holds {len(found)} rows of episode {index}; {place.length}, one after the "
                "other and counted from 0, are expected",
                "The dataset is damaged: download or build it again.",
            )
        return rows

    def vectors(self, index: int, column: str) -> NDArray[np.float32]:
        """Read a column of vectors of an episode, `(T, D) float32`."""
        rows = self.rows(index)
        values = rows.vectors(column)
        if values.shape[1:] != self.shape(column) or values.shape[1] > _MOST_NUMBERS:
            raise FormatError.damaged(
                rows.path,
                f"{column} of episode {index} has {values.shape[1]} values a frame; info.json "
                f"says {self.shape(column)}",
            )
        return values

    def iter_frames(
        self, index: int, column: str, start: int, stop: int
    ) -> Iterator[NDArray[np.uint8]]:
        """Decode frames `start` to `stop` (excluded) of an episode, `(H, W, 3) uint8`, in order."""
        relative, first = self.locate(index).videos[column]
        self.check_span(index, start, stop)
        path, shape = self.files.path(relative), self.shape(column)
        return video.iter_frames(path, first + start, first + stop, self.fps, shape)

    def check_span(self, index: int, start: int, stop: int) -> None:
        """Check that an episode has frames `start` to `stop` (excluded)."""
        length = self.row(index)["length"]
        if not 0 <= start <= stop <= length:
            raise FormatError(
                f"episode {index} of {self.files.describe()} has {length} stored frames; frames "
                f"{start} to {stop - 1} were asked for"
            )

    def _v30_table(self) -> pa.Table:
        names = self._tables or self.files.list(EPISODES_DIR, ".parquet")
        paths = [self.files.path(name) for name in names]
        if not paths:
            raise MissingFileError(
                f"{EPISODES_DIR} holds no parquet file in {self.files.describe()}",
                "The dataset is not complete: download or build it again.",
            )
        tables = []
        for path in paths:
            file = open_parquet(path)
            told = (field for field in file.schema_arrow if is_plain(field.type))
            names = [field.name for field in told if not field.name.startswith("stats/")]
            tables.append(read_table(file, path, names))
            if sum(table.nbytes for table in tables) > _MOST_BYTES:
                raise FormatError.damaged(path, f"with others over {_MOST_BYTES:,} bytes")
        with reading(paths[0]):  # files with columns of different types
            return pa.concat_tables(tables)

    def _v21_table(self) -> pa.Table:
        rows = list(self._json_lines(_V21_EPISODES))
        names = dict.fromkeys(name for row in rows for name in row)
        if len(names) > _MOST_COLUMNS:
            raise FormatError.damaged(self.files.path(_V21_EPISODES), f"{len(names)} columns")
        with reading(self.files.path(_V21_EPISODES)):
            return pa.table({name: [row.get(name) for row in rows] for name in names})

    def _json_lines(self, relative: str) -> Iterator[dict[str, Any]]:
        path = self.files.path(relative)
        for number, line in enumerate(read_bytes(path, _MOST_LINES).splitlines(), 1):
            if line.strip():
                yield parse_json(line, f"{path}, line {number}")
