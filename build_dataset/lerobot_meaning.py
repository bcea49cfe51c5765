"""Check what LeRobot's own files in a dataset mean: its reader trusts them.

A file whose SHA-256 is the recorded one can still say what is not so, if it was written so.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa

from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    EPISODES_DIR,
    INFO_PATH,
    RECORDS_PATH,
    STATS_PATH,
    TASKS_PATH,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.storage.files import read_json
from robomme_interference_data.storage.lerobot import LeRobotFiles

_TOLERANCE_S = 1e-4
"""LeRobot's own tolerance of timestamps, in seconds."""


def lerobot_violations(dataset: Dataset) -> Iterator[tuple[str, str]]:
    """Yield the file or episode, and what is not so.

    Raises:
        InterferenceError: A file cannot be read.
    """
    yield from _info(dataset)
    yield from _lean_copy(dataset)
    tasks = dataset.lerobot.tasks
    if list(tasks.values()) != list(range(len(tasks))):
        yield TASKS_PATH, f"task_index is {list(tasks.values())[:5]}; expected 0, 1, …"
    used = {record.goal for record in dataset.records()}
    if set(tasks) != used:
        yield TASKS_PATH, "does not list the goals of the episodes, each once"
    first = 0
    places: dict[str, int] = {}
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
        place = dataset.lerobot.place(record.episode_index)
        for path in (place.data, *(path for path, _ in place.videos.values())):
            other = places.setdefault(path, record.episode_index)
            if other != record.episode_index:
                yield path, f"is shared by episodes {other} and {record.episode_index}"
        try:
            for path, _ in place.videos.values():
                dataset.files.path(path)
            yield from _rows(dataset, record.episode_index, first, tasks.get(record.goal))
        except InterferenceError as error:
            yield place.data, error.message
        first += record.length


def _lean_copy(dataset: Dataset) -> Iterator[tuple[str, str]]:
    """Check that what is read of an episode is what LeRobot's own table says."""
    table = LeRobotFiles(dataset.files).table
    if dataset.lerobot.table.column_names != table.column_names:
        yield RECORDS_PATH, f"does not have the columns of {EPISODES_DIR}, without statistics"
        return
    for name in table.column_names:
        if dataset.lerobot.table[name] != table[name]:
            yield RECORDS_PATH, f"column {name} is not that of {EPISODES_DIR}"


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
    stats = read_json(dataset.files.path(STATS_PATH))
    for name in dataset.features:
        values = stats.get(name)
        try:
            found = dict(values or {}).values()
            finite = all(np.isfinite(np.asarray(one, float)).all() for one in found)
        except (TypeError, ValueError):
            finite = False
        if not values or not finite:
            yield STATS_PATH, f"has no finite statistics of {name}"


def _rows(dataset: Dataset, index: int, first: int, task: int | None) -> Iterator[tuple[str, str]]:
    """Check the columns that LeRobot adds to every frame."""
    rows = dataset.lerobot.rows(index)
    path = dataset.lerobot.place(index).data
    frames = np.arange(len(rows))
    for name, expected in (
        ("index", first + frames),
        ("task_index", np.full(len(rows), -1 if task is None else task)),
    ):
        if not np.array_equal(rows.scalars(name), expected):
            yield path, f"{name} of episode {index} is not {expected[0]} to {expected[-1]}"
    times = rows.table(["timestamp"])["timestamp"]
    if not pa.types.is_floating(times.type):
        yield path, f"timestamp of episode {index} is of type {times.type}"
    elif not np.allclose(times.to_numpy(), frames / dataset.lerobot.fps, 0, _TOLERANCE_S):
        yield path, f"timestamp of episode {index} is not frame_index / {dataset.lerobot.fps:g}"


def _equal(found: Any, expected: Any) -> bool:
    if isinstance(expected, float):
        return isinstance(found, float) and abs(found - expected) <= _TOLERANCE_S
    return bool(found == expected)
