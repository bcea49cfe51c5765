"""Read what a dataset says of itself under `meta/`, and refuse what this package cannot read."""

from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from robomme_interference_data import parquet
from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    EPISODES_DIR,
    FORMAT_VERSION,
    IDENTITY_PATH,
    INFO_PATH,
)
from robomme_interference_data.errors import FormatError, MissingFileError
from robomme_interference_data.files import Files, check_names, read_json

__all__ = ["LESSON_SHA", "SHA", "read_episodes", "read_identity", "read_info"]

SHA = "sha256/"
LESSON_SHA = "lesson_sha256/"
"""Prefixes of the columns that hold the digests of an episode and of its lesson, by feature."""

# What is read of each file; one that lacks any of it is refused at once.
_INFO_KEYS = ("features", "fps", "total_episodes", "data_path", "video_path")
_IDENTITY_KEYS = ("kind", "revision")
_EPISODE_COLUMNS = (
    "episode_index",
    "length",
    "data/chunk_index",
    "data/file_index",
    "episode_id",
    "goals",
    "seed",
    "difficulty",
    "simulator",
    "raw_length",
    "exec_start_idx",
    "exact",
    "sha256",
    "lesson_sha256",
)
_VIDEO_COLUMNS = ("chunk_index", "file_index", "from_timestamp")


def read_info(files: Files) -> dict[str, Any]:
    """Read `meta/info.json`.

    Raises:
        MissingFileError: It is missing.
        FormatError: It is not of LeRobot v3.0, or lacks what is read of it.
    """
    path = files.path(INFO_PATH)
    info = read_json(path)
    version = info.get("codebase_version")
    if version != "v3.0":
        raise FormatError(
            f"{files.describe()} is a LeRobot dataset of version {version!r}; this package "
            "reads v3.0"
        )
    check_names(path, info, _INFO_KEYS)
    return info


def read_identity(files: Files) -> dict[str, Any]:
    """Read `meta/interference.json`.

    Raises:
        MissingFileError: It is missing.
        FormatError: It is of another format version, or lacks what is read of it.
    """
    try:
        path = files.path(IDENTITY_PATH)
    except MissingFileError:
        raise MissingFileError(
            f"{files.describe()} is a LeRobot dataset, but not one of history sessions: "
            f"{IDENTITY_PATH} is missing",
            f"Build one from it: robomme-interference build distractors "
            f"--source lerobot:{files.describe()} --out DIR",
        ) from None
    identity = read_json(path)
    if identity.get("format_version") != FORMAT_VERSION:
        raise FormatError(
            f"{files.describe()} has format version "
            f"{identity.get('format_version')!r}; this package reads {FORMAT_VERSION}",
            "Install the version of robomme-interference-data that wrote it, or build it again.",
        )
    check_names(path, identity, _IDENTITY_KEYS)
    return identity


def read_episodes(files: Files, features: list[str], total: int) -> pa.Table:
    """Read the table of `meta/episodes`, by episode index; statistics are left out.

    Args:
        files: The dataset's files.
        features: Names of the features, whose digests and, of cameras, video places are read.
        total: Number of episodes.

    Raises:
        MissingFileError: There is no such file.
        FormatError: A column is missing, or the rows are not the episodes 0 to `total` - 1.
    """
    paths = files.list(EPISODES_DIR, ".parquet")
    if not paths:
        raise MissingFileError(
            f"{EPISODES_DIR} holds no parquet file in {files.describe()}",
            "The dataset is not complete: download or build it again.",
        )
    expected = [*_EPISODE_COLUMNS, *(SHA + name for name in features)]
    for camera in (name for name in features if name.startswith(CAMERA_PREFIX)):
        expected += [f"videos/{camera}/{name}" for name in _VIDEO_COLUMNS]
    tables = []
    for path in map(files.path, paths):
        with parquet.reading(path):
            file = pq.ParquetFile(path)
            names = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
            check_names(path, names, expected)
            tables.append(file.read(columns=names))
    with parquet.reading(files.path(paths[0])):  # files with columns of different types
        table = pa.concat_tables(tables)
    indices = table["episode_index"].to_numpy()
    if not np.array_equal(indices, np.arange(total)):
        raise FormatError(
            f"{files.describe()}: {EPISODES_DIR} does not list the episodes 0 to "
            f"{total - 1}, one row each and in order",
            "The dataset is damaged: download or build it again.",
        )
    return table
