"""Check LeRobot's own files in a dataset against its episodes and its data.

A file with the recorded SHA-256 can still hold wrong values, if it was written so.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from robomme_interference_data.build_dataset.dataset.image_stats import (
    QUANTILES,
    STATISTICS,
    Statistics,
    episode_statistics,
)
from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    EPISODES_DIR,
    INFO_PATH,
    RECORDS_PATH,
    STATS_PATH,
    TASKS_PATH,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.fetched_copy import FetchedCopy
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.schema.codec import arrow_schema
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.files import read_json
from robomme_interference_data.storage.lerobot import LeRobotFiles

_TOLERANCE_S = 1e-4
"""LeRobot's own tolerance of timestamps, in seconds."""

_FRAME_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Columns that LeRobot adds to every frame, in its order."""


def lerobot_violations(dataset: Dataset, copy: FetchedCopy | None) -> Iterator[tuple[str, str]]:
    """Yield each violation: the file or episode, and what is wrong.

    In a partial copy only the files that are there are read.
    """
    yield from _info(dataset)
    table = LeRobotFiles(dataset.files, statistics=True).table
    yield from _columns(dataset, table)
    statistics = episode_statistics(table)
    yield from _total_statistics(dataset, statistics)
    tasks = dataset.lerobot.tasks
    if list(tasks.values()) != list(range(len(tasks))):
        yield TASKS_PATH, f"task_index is {list(tasks.values())[:5]}; expected 0, 1, …"
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
        location = dataset.lerobot.locate(record.episode_index)
        for path in (location.data, *(path for path, _ in location.videos.values())):
            other = users.setdefault(path, record.episode_index)
            if other != record.episode_index:
                yield path, f"is shared by episodes {other} and {record.episode_index}"
        if copy is None or copy.holds_all(dataset, record.episode_index):
            task, stored = tasks.get(record.goal), statistics[record.episode_index]
            try:
                for path, _ in location.videos.values():
                    dataset.files.path(path)
                yield from _rows(dataset, record.episode_index, first, task, stored)
            except InterferenceError as error:
                yield location.data, error.message
        first += record.length


def _columns(dataset: Dataset, table: pa.Table) -> Iterator[tuple[str, str]]:
    """Check that both episode tables have the declared columns, and the same values."""
    videos = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    records = arrow_schema(EpisodeRecord, sorted(dataset.features))
    lean = {
        *("tasks", "data/chunk_index", "data/file_index"),
        *("dataset_from_index", "dataset_to_index"),
        *(f"videos/{CAMERA_PREFIX}{camera}/{one}" for camera in dataset.cameras for one in videos),
        *("meta/episodes/chunk_index", "meta/episodes/file_index"),
        *records.names,
    }
    features = (*dataset.features, *_FRAME_COLUMNS)
    statistics = {f"stats/{feature}/{name}" for feature in features for name in STATISTICS}
    copy = dataset.lerobot.table
    yield from _names(EPISODES_DIR, table.column_names, lean | statistics)
    yield from _names(RECORDS_PATH, copy.column_names, lean)
    for name in lean & {*copy.column_names} & {*table.column_names}:
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
    yield from _names(INFO_PATH, [*dataset.lerobot.features], {*dataset.features, *_FRAME_COLUMNS})


def _total_statistics(dataset: Dataset, episodes: list[Statistics]) -> Iterator[tuple[str, str]]:
    """Check that the statistics of the dataset follow from those of its episodes."""
    stats = read_json(dataset.files.path(STATS_PATH))
    features = {*dataset.features, *_FRAME_COLUMNS}
    yield from _names(STATS_PATH, [*stats], features)
    for name in features & stats.keys():
        try:
            expected = _aggregated([one[name] for one in episodes])
            same = stats[name].keys() == expected.keys() and all(
                np.allclose(np.ravel(stats[name][one]), value, 1e-6, 1e-8)
                for one, value in expected.items()
            )
        except (AttributeError, KeyError, TypeError, ValueError):
            same = False
        if not same:
            yield STATS_PATH, f"{name} does not follow from the statistics of the episodes"


def _aggregated(episodes: list[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the statistics of all episodes, like LeRobot, which is not needed to verify."""
    values = {name: np.stack([one[name] for one in episodes]) for name in STATISTICS}
    weights = values["count"] / values["count"].sum(axis=0)
    total = {name: (values[name] * weights).sum(axis=0) for name in STATISTICS}
    variances = values["std"] ** 2 + (values["mean"] - total["mean"]) ** 2
    return total | {
        "min": values["min"].min(axis=0),
        "max": values["max"].max(axis=0),
        "std": np.sqrt((variances * weights).sum(axis=0)),
        "count": values["count"].sum(axis=0),
    }


def differing_statistics(stored: Mapping[str, Any], values: Any) -> Iterator[str]:
    """Yield the names of stored statistics that are not those of values, `(T, D)`.

    LeRobot computes them in 32 bits, and quantiles from a histogram of 5,000 bins. A sum of n
    values in 32 bits is off by up to n · 2⁻²⁴ of the largest.
    """
    lowest, highest = values.min(axis=0), values.max(axis=0)
    largest = 1 + np.abs(values).max(axis=0)
    fine, binned = 1e-6 * largest, 1e-6 * largest + 1e-3 * (highest - lowest)
    expected = {
        "min": (lowest, fine),
        "max": (highest, fine),
        "mean": (values.mean(axis=0), fine + len(values) * 2.0**-24 * largest),
        "std": (values.std(axis=0), 1e-3 * largest),
        "count": (np.array([len(values)]), 0),
    }
    for name, quantile in QUANTILES.items():
        expected[name] = np.quantile(values, quantile, axis=0, method="inverted_cdf"), binned
    for name, (value, tolerance) in expected.items():
        found = stored.get(name, np.empty(0))
        if found.shape != value.shape or not (np.abs(found - value) <= tolerance).all():
            yield name


def _rows(
    dataset: Dataset, index: int, first: int, task: int | None, statistics: Statistics
) -> Iterator[tuple[str, str]]:
    """Check the columns that LeRobot adds to every frame, and the statistics of all columns."""
    rows = dataset.lerobot.rows(index)
    path = dataset.lerobot.locate(index).data
    frames = np.arange(len(rows))
    vectors = [name for name in dataset.features if not name.startswith(CAMERA_PREFIX)]
    yield from _names(path, rows.names, {*vectors, *_FRAME_COLUMNS})
    values = {name: dataset.lerobot.vectors(index, name).astype(float) for name in vectors}
    values["index"] = (first + frames)[:, None]
    if task is not None:  # else the list of tasks is a violation
        values["task_index"] = np.full((len(rows), 1), task)
    for name in ("index", "task_index"):
        if name in values and not np.array_equal(rows.scalars(name), values[name][:, 0]):
            start, stop = values[name][0, 0], values[name][-1, 0]
            expected = f"{start} to {stop}" if name == "index" else f"{start} in all frames"
            yield path, f"{name} of episode {index} is not {expected}"
    times = rows.table(["timestamp"])["timestamp"]
    if not pa.types.is_floating(times.type):
        yield path, f"timestamp of episode {index} is of type {times.type}"
    elif not np.allclose(times.to_numpy(), frames / dataset.lerobot.fps, 0, _TOLERANCE_S):
        yield path, f"timestamp of episode {index} is not frame_index / {dataset.lerobot.fps:g}"
    values |= {"frame_index": frames[:, None], "episode_index": np.full((len(rows), 1), index)}
    values["timestamp"] = frames[:, None] / dataset.lerobot.fps
    for name, value in values.items():
        for one in differing_statistics(statistics.get(name, {}), value):
            yield EPISODES_DIR, f"stats/{name}/{one} of episode {index} is not that of its data"


def _equal(stored: Any, expected: Any) -> bool:
    if isinstance(expected, float):
        return isinstance(stored, float) and abs(stored - expected) <= _TOLERANCE_S
    return bool(stored == expected)
