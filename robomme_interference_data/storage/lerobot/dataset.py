"""Read LeRobot datasets with pyarrow and PyAV alone: v3.0, v2.1 and v2.0.

The older two differ from each other in their statistics only, which are not read.

The only reader of that layout, for datasets of this package and for recordings. Tests compare it
with lerobot's own reader.
"""

import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from robomme_interference_data.constants import INFO_PATH
from robomme_interference_data.errors import (
    FormatError,
    MissingFileError,
    UnknownNameError,
    counted,
)

from ..files import Files
from ..parquet import RowSpan
from ..text import read_json
from ..video.frames import iter_frames, read_times
from .info import check_info
from .location import (
    EpisodeLocation,
    VideoLocation,
    VideoSpan,
    has_own_files,
    locate_episode,
    locate_video,
    span_problems,
)
from .tables import read_episode_lines, read_episodes, read_tasks

VERSIONS = ("v3.0", "v2.1", "v2.0")

_CORRECT_EPISODES = f"Correct the episode table in meta/, or {INFO_PATH}, or write both again."
_CORRECT_ROWS = (
    "Sort the table by episode_index and frame_index, and correct the one that is wrong, or write "
    "the dataset again."
)


class LeRobotFiles:
    """A LeRobot dataset: its metadata, and values and frames of its episodes.

    `tables` are the paths of its episode tables, if known: on the Hub, listing the files takes
    longer than fetching these. `statistics` are the features whose statistics `table` has.
    """

    def __init__(self, files: Files, tables: Sequence[str] = (), statistics: Sequence[str] = ()):
        self.files = files
        self._tables, self._statistics = tables, statistics
        self._rows: dict[int, dict[str, Any]] = {}
        # By camera and video file, the problems of each episode.
        self._video_problems: dict[tuple[str, str], dict[int, str]] = {}
        try:
            path = files.path(INFO_PATH)
        except MissingFileError as error:
            raise MissingFileError(
                f"{files.describe()} is no LeRobot dataset: {INFO_PATH} is missing",
                "Give the folder that holds meta/, data/ and videos/.",
            ) from error
        self.info = read_json(path, nan_as_none=True)
        self.version = self.info.get("codebase_version")
        if self.version not in VERSIONS:
            raise FormatError(
                f"{files.describe()} is a LeRobot dataset of version {self.version!r}; this "
                f"package reads {', '.join(VERSIONS)}",
                "Convert an older one with LeRobot's own scripts (lerobot.scripts."
                "convert_dataset_v21_to_v30 and its predecessors); for a newer one, update this "
                "package.",
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
        """Return the shape of a column's values; of a camera `(H, W, 3)`, even if stored first."""
        feature = self.info["features"][column]
        shape = tuple(feature["shape"])
        if feature["dtype"] in ("video", "image"):
            # LeRobot's older datasets have the channels first.
            if len(shape) == 3 and shape[2] != 3:
                shape = (*shape[1:], shape[0])
            if len(shape) != 3 or shape[2] != 3:
                raise FormatError(
                    f"{self.files.describe()}: {column} has the shape {feature['shape']} in "
                    f"{INFO_PATH}; expected (height, width, 3)",
                    f"Correct {INFO_PATH}, or leave the camera out.",
                )
        return shape

    def __len__(self) -> int:
        return int(self.info["total_episodes"])

    @cached_property
    def table(self) -> pa.Table:
        """The per-episode columns by episode index."""
        where = self.files.describe()
        if not has_own_files(self.info):
            table = read_episodes(self.files, self._tables, self._statistics)
        else:
            table = read_episode_lines(self.files)
        for name in ("episode_index", "length"):
            column = table[name] if name in table.column_names else pa.nulls(1)
            if column.null_count or not pa.types.is_integer(column.type):
                raise FormatError(
                    f"{where}: the episode table has no whole numbers {name!r}", _CORRECT_EPISODES
                )
        # Its lines may come in any order, since they are found by number.
        if has_own_files(self.info):
            table = table.sort_by("episode_index")
        # LeRobot finds an episode of v3.0 by its place, not by its number.
        numbers = table["episode_index"].to_numpy()
        if not np.array_equal(numbers, np.arange(len(self))):
            listed = ", ".join(map(str, numbers[:5].tolist())) + (", …" if len(numbers) > 5 else "")
            raise FormatError(
                f"{where}: the episode table lists {counted(len(numbers), 'episode')}: "
                f"{listed or 'none'}; expected {len(self)}, as total_episodes in {INFO_PATH}, "
                "numbered from 0, in this order",
                _CORRECT_EPISODES,
            )
        return table.combine_chunks()

    @cached_property
    def task_texts(self) -> dict[int, str]:
        """The task texts that the dataset lists, by their index."""
        return read_tasks(self.files, lines=has_own_files(self.info))

    def tasks_of(self, index: int) -> tuple[str, ...]:
        """Return the tasks of an episode's frames, in the order in which they begin.

        These are what LeRobot returns with each frame. None, if the frames have no task index.
        """
        rows = self.rows(index)
        if "task_index" not in rows.names:
            return ()
        numbers = dict.fromkeys(rows.scalars("task_index").tolist())
        for number in numbers:
            if number not in self.task_texts:
                raise FormatError(
                    f"{rows.path}: frames of episode {index} have the task_index {number}, which "
                    f"meta/ does not list; it lists {len(self.task_texts)} tasks",
                    "Add the task's text to the list of tasks, or correct the frames.",
                )
        return tuple(self.task_texts[number] for number in numbers)

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

    @property
    def video_features(self) -> list[str]:
        """The cameras whose frames are in video files."""
        features = self.info["features"]
        return [name for name, feature in features.items() if feature["dtype"] == "video"]

    def locate(self, index: int) -> EpisodeLocation:
        """Return where the rows of an episode lie."""
        return locate_episode(self.info, index, self.row(index), self.files.describe())

    def locate_video(self, index: int, column: str) -> VideoLocation:
        """Return where the frames of an episode lie, for a camera in video files."""
        return locate_video(self.info, column, index, self.row(index), self.files.describe())

    def rows(self, index: int) -> RowSpan:
        """Return the rows of an episode in its data file."""
        location = self.locate(index)
        path = self.files.path(location.data)
        file = RowSpan(path)
        # By value: row numbers in the metadata count over all files, and may be damaged.
        found = np.flatnonzero(file.scalars("episode_index") == index)
        start = int(found[0]) if len(found) else 0
        rows = file.part(start, start + len(found))
        numbers = np.arange(len(found))  # not `location.length`, which may be huge
        if len(found) != location.length:
            raise FormatError(
                f"{path}: {counted(len(found), 'row')} of episode {index}; the episode table has "
                f"the length {location.length}",
                _CORRECT_ROWS,
            )
        if (found != start + numbers).any() or (rows.scalars("frame_index") != numbers).any():
            raise FormatError(
                f"{path}: the rows of episode {index} are not one after the other, with "
                "frame_index 0, 1, …",
                _CORRECT_ROWS,
            )
        return rows

    def vectors(self, index: int, column: str) -> NDArray[np.float32]:
        """Read a column of vectors of an episode, `(T, D) float32`."""
        rows = self.rows(index)
        values = rows.vectors(column)
        if values.shape[1:] != self.shape(column):
            raise FormatError(
                f"{rows.path}: {column} of episode {index} has {values.shape[1]} values in each "
                f"frame; {INFO_PATH} has the shape {self.shape(column)}",
                "Correct the one that is wrong.",
            )
        return values

    def iter_frames(
        self, index: int, column: str, start: int, stop: int
    ) -> Iterator[NDArray[np.uint8]]:
        """Decode frames `start` to `stop` (excluded) of an episode, `(H, W, 3) uint8`, in order."""
        self.check_span(index, start, stop)
        location = self.locate_video(index, column)
        path, first = self.files.path(location.path), location.first
        return iter_frames(path, first + start, first + stop, self.fps, self.shape(column))

    def check_video(self, index: int, column: str) -> None:
        """Check that an episode's video file has the frames that the episode table states.

        The times of all frames of the file are read, without decoding, once for each file.

        Raises:
            FormatError: It has not, or its frames are not evenly spaced in time.
        """
        relative = self.locate_video(index, column).path
        path, key = self.files.path(relative), (column, relative)
        if key not in self._video_problems:
            times = read_times(path)
            spans = self._spans_in_file(index, column)
            first = times.first_number(self.fps)
            self._video_problems[key] = span_problems(spans, first, len(times))
        problem = self._video_problems[key].get(index)
        if problem is not None:
            hint = "Write the video again, with a frame for each row, or leave the episode out."
            if self.version == "v3.0":
                hint = (
                    "Write the dataset again, or correct from_timestamp in its episode table, or "
                    "leave the episode out."
                )
            raise FormatError(f"{path}: {problem}", hint)

    def _spans_in_file(self, index: int, column: str) -> list[VideoSpan]:
        """Return the episodes in the video file that holds an episode, by number."""
        row, fps, key = self.row(index), self.fps, f"videos/{column}"
        if has_own_files(self.info):
            return [VideoSpan(index, row["length"], 0.0, math.nan)]
        names = [f"{key}/chunk_index", f"{key}/file_index"]
        here = [pc.equal(self.table[name], row[name]) for name in names]
        rows = self.table.filter(pc.and_(*here)).to_pylist()
        return [
            VideoSpan(
                other["episode_index"],
                other["length"],
                _seconds(other.get(f"{key}/from_timestamp")) * fps,
                _seconds(other.get(f"{key}/to_timestamp")) * fps,
            )
            for other in rows
        ]

    def check_span(self, index: int, start: int, stop: int) -> None:
        """Check that an episode has frames `start` to `stop` (excluded)."""
        length = self.row(index)["length"]
        if not 0 <= start <= stop <= length:
            raise FormatError(
                f"episode {index} of {self.files.describe()} has {length} stored frames; frames "
                f"{start} to {stop - 1} were requested"
            )


def _seconds(value: Any) -> float:
    """Return a time of the episode table, NaN if it is none."""
    return float(value) if isinstance(value, int | float) else math.nan
