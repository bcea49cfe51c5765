"""The metadata of a LeRobot dataset, v3.0 or v2.1, in one form."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robomme_interference_data.build_dataset.sources.tables import open_parquet
from robomme_interference_data.constants import (
    EPISODES_DIR,
    IDENTITY_PATH,
    INFO_PATH,
    TASKS_PATH,
)
from robomme_interference_data.errors import FormatError, MissingFileError, SourceError
from robomme_interference_data.files import Files, read_json
from robomme_interference_data.parquet import reading

__all__ = ["VERSIONS", "EpisodePlace", "Layout", "read_layout"]

VERSIONS = ("v3.0", "v2.1")

_V21_EPISODES = "meta/episodes.jsonl"
_V21_STATS = "meta/episodes_stats.jsonl"
_V21_TASKS = "meta/tasks.jsonl"
_DAMAGED = "The dataset is damaged or incomplete: download it again."


@dataclass(frozen=True)
class EpisodePlace:
    """Where an episode lies in its dataset; small and picklable.

    Attributes:
        index: Number of the episode in the dataset.
        length: Frames.
        data: Relative path of the parquet file with its rows.
        videos: Column to `(relative path, number of the first frame in that file)`.
    """

    index: int
    length: int
    data: str
    videos: dict[str, tuple[str, int]]


@dataclass(frozen=True)
class Layout:
    """What the files in `meta/` say.

    Attributes:
        info: `meta/info.json`.
        identity: `meta/interference.json`, if the dataset is one of this package.
        places: Episode index to place, by index.
        rows: Episode index to its other per-episode columns: `tasks`, and whatever there is.
        starts: Episode index to the value of `exec_start_idx`, for those whose statistics show
            that it is constant; so the data files need not be read for it.
    """

    info: dict[str, Any]
    identity: dict[str, Any]
    places: dict[int, EpisodePlace]
    rows: dict[int, dict[str, Any]]
    starts: dict[int, int] = field(default_factory=dict)

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """The dataset's columns with type and shape."""
        return dict(self.info["features"])

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(self.info["fps"])


def read_layout(files: Files, start_column: str = "exec_start_idx") -> Layout:
    """Read the metadata of a dataset; no data or video file is touched.

    Args:
        files: How to reach the dataset.
        start_column: The column whose statistics `Layout.starts` is read from.

    Raises:
        MissingFileError, FormatError: A file in `meta/` is missing or cannot be read.
        SourceError: The version is unknown, or the metadata is not complete or not consistent.
    """
    place = files.describe()
    try:
        info = read_json(files.path(INFO_PATH))
    except MissingFileError as error:
        raise MissingFileError(
            f"{place} is no LeRobot dataset: {INFO_PATH} is missing",
            "Point to the folder that holds meta/, data/ and videos/.",
        ) from error
    version = info.get("codebase_version")
    if version not in VERSIONS:
        raise SourceError(
            f"{place} is a LeRobot dataset of version {version!r}; this package reads "
            f"{' and '.join(VERSIONS)}",
            "Convert it with LeRobot's own scripts (lerobot.scripts.convert_dataset_v21_to_v30 "
            "and its predecessors).",
        )
    for key, kind in (("features", dict), ("fps", int | float), ("data_path", str)):
        if not isinstance(info.get(key), kind) or (key == "fps" and info[key] <= 0):
            raise SourceError(f"{place}: {INFO_PATH} has no valid {key!r}", _DAMAGED)
    listed = set(files.list("meta"))
    identity = read_json(files.path(IDENTITY_PATH)) if IDENTITY_PATH in listed else {}
    read = _read_v30 if version == "v3.0" else _read_v21
    try:
        layout = read(files, listed, info, identity, start_column)
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        if isinstance(error, SourceError | FormatError):
            raise
        raise SourceError(
            f"{place}: the metadata of its episodes is not as LeRobot {version} writes it "
            f"({type(error).__name__}: {error})",
            _DAMAGED,
        ) from error
    _check(layout, place)
    return layout


def _read_v30(
    files: Files, listed: set[str], info: dict[str, Any], identity: dict[str, Any], start: str
) -> Layout:
    places, rows, starts = {}, {}, {}
    bounds = [f"stats/{start}/{bound}" for bound in ("min", "max")]
    paths = sorted(p for p in listed if p.startswith(EPISODES_DIR) and p.endswith(".parquet"))
    if not paths:
        raise MissingFileError(
            f"{EPISODES_DIR} holds no parquet file in {files.describe()}", _DAMAGED
        )
    videos = [name for name, f in info["features"].items() if f["dtype"] == "video"]
    for path in paths:
        for row in _parquet_rows(files.path(path), keep=bounds):
            index = row.pop("episode_index")
            if index in places:
                raise SourceError(
                    f"{files.describe()}: {EPISODES_DIR} lists episode {index} twice", _DAMAGED
                )
            places[index] = EpisodePlace(
                index,
                row.pop("length"),
                info["data_path"].format(
                    chunk_index=row.pop("data/chunk_index"),
                    file_index=row.pop("data/file_index"),
                ),
                {
                    name: (
                        info["video_path"].format(
                            video_key=name,
                            chunk_index=row.pop(f"videos/{name}/chunk_index"),
                            file_index=row.pop(f"videos/{name}/file_index"),
                        ),
                        round(row.pop(f"videos/{name}/from_timestamp") * info["fps"]),
                    )
                    for name in videos
                },
            )
            constant = _constant(*(row.pop(name, None) for name in bounds))
            if constant is not None:
                starts[index] = constant
            rows[index] = row
    known = {
        row.get("task", row.get("__index_level_0__"))
        for row in _parquet_rows(files.path(TASKS_PATH))
    }
    _check_tasks(rows, known, TASKS_PATH, files.describe())
    return _sorted(Layout(info, identity, places, rows, starts))


def _read_v21(
    files: Files, listed: set[str], info: dict[str, Any], identity: dict[str, Any], start: str
) -> Layout:
    places, rows, starts = {}, {}, {}
    videos = [name for name, f in info["features"].items() if f["dtype"] == "video"]
    for row in _json_lines(files.path(_V21_EPISODES)):
        index = row.pop("episode_index")
        if index in places:
            raise SourceError(
                f"{files.describe()}: {_V21_EPISODES} lists episode {index} twice", _DAMAGED
            )
        named = {
            "episode_chunk": index // info.get("chunks_size", 1000),
            "episode_index": index,
        }
        places[index] = EpisodePlace(
            index,
            row.pop("length"),
            info["data_path"].format(**named),
            {name: (info["video_path"].format(video_key=name, **named), 0) for name in videos},
        )
        rows[index] = row
    if _V21_STATS in listed:
        for row in _json_lines(files.path(_V21_STATS)):
            bounds = row["stats"].get(start, {})
            constant = _constant(bounds.get("min"), bounds.get("max"))
            if constant is not None:
                starts[row["episode_index"]] = constant
    known = {row["task"] for row in _json_lines(files.path(_V21_TASKS))}
    _check_tasks(rows, known, _V21_TASKS, files.describe())
    return _sorted(Layout(info, identity, places, rows, starts))


def _check(layout: Layout, place: str) -> None:
    total = layout.info.get("total_episodes")
    if len(layout.places) != total:
        raise SourceError(
            f"{place}: meta/ lists {len(layout.places)} episodes; info.json says {total}",
            f"{_DAMAGED} Offline, only files that were downloaded before are seen.",
        )
    for index, episode in layout.places.items():
        if not isinstance(index, int) or not isinstance(episode.length, int) or episode.length < 1:
            raise SourceError(
                f"{place}: episode {index!r} has the length {episode.length!r}", _DAMAGED
            )


def _check_tasks(rows: dict[int, dict[str, Any]], known: set[Any], path: str, place: str) -> None:
    for index, row in rows.items():
        tasks = row.get("tasks")
        if not tasks or not all(isinstance(task, str) and task for task in tasks):
            raise SourceError(f"{place}: episode {index} has no task text", _DAMAGED)
        unknown = [task for task in tasks if task not in known]
        if unknown:
            raise SourceError(
                f"{place}: episode {index} has the task {unknown[0]!r}, which {path} does not list",
                _DAMAGED,
            )


def _sorted(layout: Layout) -> Layout:
    order = sorted(layout.places)
    return Layout(
        layout.info,
        layout.identity,
        {index: layout.places[index] for index in order},
        {index: layout.rows[index] for index in order},
        layout.starts,
    )


def _constant(low: Any, high: Any) -> int | None:
    """Return the value whose minimum and maximum are equal; statistics are lists of one."""
    low, high = (bound[0] if isinstance(bound, list) and bound else bound for bound in (low, high))
    return int(low) if low is not None and low == high and low == int(low) else None


def _parquet_rows(path: Path, keep: list[str] | None = None) -> Iterator[dict[str, Any]]:
    """Yield the rows of a file in meta/, without statistics but those to keep."""
    file = open_parquet(path)
    names = [
        name
        for name in file.schema_arrow.names
        if not name.startswith("stats/") or name in (keep or ())
    ]
    with reading(path):
        yield from file.read(columns=names).to_pylist()


def _json_lines(path: Path) -> Iterator[dict[str, Any]]:
    with path.open(encoding="utf-8") as lines:
        for number, line in enumerate(lines, 1):
            if line.strip():
                try:
                    yield json.loads(line)
                except ValueError as error:
                    raise SourceError(
                        f"{path}, line {number} is not JSON: {error}", _DAMAGED
                    ) from None
