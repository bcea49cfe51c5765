"""Check LeRobot's own files in a dataset against its episodes and its data.

A file with the recorded SHA-256 can still hold wrong values, if it was written so. LeRobot's
statistics are not recomputed: no buffer depends on them, and their files have recorded digests.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa

from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    EPISODES_DIR,
    FRAME_COLUMNS,
    INFO_PATH,
    RECORDS_PATH,
    TASKS_PATH,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.fetched_copy import FetchedCopy
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.schema.codec import arrow_schema
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.lerobot.dataset import LeRobotFiles
from robomme_interference_data.storage.lerobot.statistics import STATISTICS
from robomme_interference_data.storage.lerobot.tables import episode_column_names

_TOLERANCE_S = 1e-4
"""LeRobot's own tolerance of timestamps, in seconds."""


def lerobot_violations(dataset: Dataset, copy: FetchedCopy | None) -> Iterator[tuple[str, str]]:
    """Yield each violation: the file or episode, and what is wrong.

    In a partial copy only the files that are there are read.
    """
    yield from _info(dataset)
    yield from _columns(dataset)
    tasks = {text: number for number, text in dataset.lerobot.task_texts.items()}
    if set(tasks) != {record.goal for record in dataset.records()}:
        yield TASKS_PATH, "does not list the goals of the episodes, each once"
    # LeRobot reads the frames of all files in the order of their paths.
    data = [dataset.lerobot.locate(index).data for index in range(len(dataset))]
    if data != sorted(data):
        yield EPISODES_DIR, "does not have the data files in the order of the episodes"
    first = 0
    users: dict[str, int] = {}
    for record in dataset.records():
        row = dataset.lerobot.row(record.episode_index)
        expected: dict[str, Any] = {
            "tasks": [record.goal],
            "dataset_from_index": first,
            "dataset_to_index": first + record.length,
        }
        for camera in dataset.cameras:
            key = f"videos/{CAMERA_PREFIX}{camera}/"
            expected[key + "from_timestamp"] = 0.0
            expected[key + "to_timestamp"] = record.length / dataset.lerobot.fps
        for name, value in expected.items():
            if not _equal(row.get(name), value):
                what = f"{name} of {record.episode_id} is {row.get(name)}; expected {value}"
                yield EPISODES_DIR, what
        path_of_rows = dataset.lerobot.locate(record.episode_index).data
        videos = dataset.lerobot.video_features
        located = [dataset.lerobot.locate_video(record.episode_index, name) for name in videos]
        for path in [path_of_rows, *(location.path for location in located)]:
            user = users.setdefault(path, record.episode_index)
            if user != record.episode_index:
                yield path, f"is shared by episodes {user} and {record.episode_index}"
        if copy is None or copy.holds_all(dataset, record.episode_index):
            try:
                for name in videos:
                    dataset.lerobot.check_video(record.episode_index, name)
                yield from _rows(dataset, record.episode_index, first, tasks.get(record.goal))
            except InterferenceError as error:
                yield path_of_rows, error.message
        first += record.length


def _columns(dataset: Dataset) -> Iterator[tuple[str, str]]:
    """Check that both episode tables have the declared columns, and the same values."""
    table, names = LeRobotFiles(dataset.files).table, episode_column_names(dataset.files)
    videos = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    records = arrow_schema(EpisodeRecord, sorted(dataset.features))
    lean = {
        "tasks",
        "data/chunk_index",
        "data/file_index",
        "dataset_from_index",
        "dataset_to_index",
        "meta/episodes/chunk_index",
        "meta/episodes/file_index",
    }
    lean |= {*records.names}
    for camera in dataset.cameras:
        lean |= {f"videos/{CAMERA_PREFIX}{camera}/{name}" for name in videos}
    features = (*_stored(dataset), *FRAME_COLUMNS)
    statistics = {f"stats/{feature}/{name}" for feature in features for name in STATISTICS}
    copy = dataset.lerobot.table
    yield from _names(EPISODES_DIR, names, lean | statistics)
    yield from _names(RECORDS_PATH, copy.column_names, lean)
    for name in sorted(lean & {*copy.column_names} & {*table.column_names}):
        if copy[name] != table[name]:
            yield RECORDS_PATH, f"column {name} differs from that of {EPISODES_DIR}"
        elif name in records.names and copy.schema.field(name).type != records.field(name).type:
            kind = records.field(name).type
            yield RECORDS_PATH, f"column {name} is of type {copy[name].type}; expected {kind}"


def _names(where: str, names: list[str], expected: set[str]) -> Iterator[tuple[str, str]]:
    for name in sorted(expected.symmetric_difference(names)):
        yield where, f"{name} is {'missing' if name in expected else 'undeclared'}"


def _info(dataset: Dataset) -> Iterator[tuple[str, str]]:
    info = dataset.lerobot.info
    expected = {
        "total_episodes": len(dataset),
        "total_frames": sum(record.length for record in dataset.records()),
        "total_tasks": len({record.goal for record in dataset.records()}),
        "splits": {"train": f"0:{len(dataset)}"},
    }
    for name, value in expected.items():
        if info.get(name) != value:
            yield INFO_PATH, f"{name} is {info.get(name)}; expected {value}"
    yield from _names(INFO_PATH, [*dataset.lerobot.features], {*_stored(dataset), *FRAME_COLUMNS})


def _rows(dataset: Dataset, index: int, first: int, task: int | None) -> Iterator[tuple[str, str]]:
    """Check the columns that LeRobot adds to every frame."""
    rows = dataset.lerobot.rows(index)
    path = dataset.lerobot.locate(index).data
    vectors = {name for name in _stored(dataset) if not name.startswith(CAMERA_PREFIX)}
    yield from _names(path, rows.names, vectors | {*FRAME_COLUMNS})
    for name in sorted(vectors & {*rows.names}):
        kind = rows.table([name])[name].type
        values = kind.value_type if pa.types.is_nested(kind) else kind  # one value is no list
        if values != pa.float32():
            yield path, f"{name} of episode {index} is of type {values}; expected float"
    count = len(rows)
    if not np.array_equal(rows.scalars("index"), first + np.arange(count)):
        yield path, f"index of episode {index} is not {first} to {first + count - 1}"
    # Without a task, the list of tasks is a violation.
    if task is not None and not np.array_equal(rows.scalars("task_index"), np.full(count, task)):
        yield path, f"task_index of episode {index} is not {task} in all frames"
    times = rows.table(["timestamp"])["timestamp"]
    if not pa.types.is_floating(times.type):
        yield path, f"timestamp of episode {index} is of type {times.type}"
    elif not np.allclose(times.to_numpy(), np.arange(count) / dataset.fps, 0, _TOLERANCE_S):
        yield path, f"timestamp of episode {index} is not frame_index / {dataset.fps:g}"


def _equal(stored: Any, expected: Any) -> bool:
    if isinstance(expected, float):
        return isinstance(stored, float) and abs(stored - expected) <= _TOLERANCE_S
    return bool(stored == expected)


def _stored(dataset: Dataset) -> list[str]:
    """Return the features that LeRobot's files have: not states of no values."""
    return [name for name, shape in dataset.features.items() if shape != (0,)]
