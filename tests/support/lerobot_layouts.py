"""Small LeRobot datasets, v3.0, v2.1 and v2.0, written without lerobot: importing it takes 10 s."""

import json
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from support.recordings import EPISODES, SIZE, Episode, encode_image, write_video

_OLDER = {"front": "image", "wrist": "wrist_image", "state": "state", "action": "actions"}
NAMES = {
    "v2.0": _OLDER,
    "v2.1": _OLDER,
    "v3.0": {
        "front": "observation.images.front",
        "wrist": "observation.images.wrist",
        "left": "observation.images.left",
        "right": "observation.images.right",
        "state": "observation.state",
        "action": "action",
    },
}
TABLE = "meta/episodes/chunk-000/file-000.parquet"
DATA = "data/chunk-000/file-000.parquet"


def write_lerobot(
    root: Path,
    episodes: dict[str, Episode] = EPISODES,
    *,
    version: str = "v3.0",
    stored: str | None = "png",
    marked: bool = True,
    rows_a_group: int = 4,
    **columns: list[Any] | None,
) -> Path:
    """Write a dataset; in v3.0 all episodes share their files, in v2 each has its own.

    That of v2.0 declares its images with the channels first.

    Args:
        root: The folder.
        episodes: What it holds, by id.
        version: `v3.0`, `v2.1` or `v2.0`.
        stored: Images as `png` or `jpg` in parquet, or as `video` files (FFV1); None for
            metadata alone.
        marked: Write the columns `is_demo` and `exec_start_idx`.
        rows_a_group: Rows in a row group.
        **columns: Further per-episode columns; `episode_id=None` leaves the ids out.
    """
    names, listed = NAMES[version], list(episodes.values())
    cameras = [*listed[0].images] if stored else []
    tasks = list(dict.fromkeys(one.goal for one in listed))
    zeros = [0] * len(listed)
    per_episode = {
        "episode_index": list(range(len(listed))),
        "length": [len(one) for one in listed],
        "tasks": [[one.goal] for one in listed],
        "episode_id": list(episodes),
    }
    groups = [range(len(listed))]
    if version != "v3.0":
        groups = [range(index, index + 1) for index in range(len(listed))]
    else:
        per_episode |= {"data/chunk_index": zeros, "data/file_index": zeros}
        for key in (f"videos/{names[camera]}" for camera in cameras if stored == "video"):
            starts = [0, *accumulate(map(len, listed))]
            per_episode |= {f"{key}/chunk_index": zeros, f"{key}/file_index": zeros}
            per_episode[f"{key}/from_timestamp"] = [start / 10 for start in starts[:-1]]
    for group in groups if stored else ():
        rows = [_rows(listed[i], i, tasks, names, stored, marked) for i in group]
        file = "file-000" if version == "v3.0" else f"episode_{group[0]:06d}"
        path = root / f"data/chunk-000/{file}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.concat_tables(rows), path, row_group_size=rows_a_group)
        for camera in cameras if stored == "video" else ():
            frames = np.concatenate([listed[i].images[camera] for i in group])
            write_video(root / f"videos/{names[camera]}/chunk-000/{file}.mkv", frames)
    table = {name: values for name, values in (per_episode | columns).items() if values is not None}
    _write_metadata(root / "meta", version, tasks, table)
    v2 = version != "v3.0"
    file = "episode_{episode_index:06d}" if v2 else "file-{file_index:03d}"
    chunk = "chunk-{episode_chunk:03d}" if v2 else "chunk-{chunk_index:03d}"
    features = _features(listed[0], names, stored, marked)
    if version == "v2.0":
        for feature in features.values():
            if len(feature["shape"]) == 3:
                feature |= {"shape": [3, *SIZE], "names": ["channel", "height", "width"]}
    info = {
        "codebase_version": version,
        "fps": 10,
        "total_episodes": len(listed),
        "chunks_size": 1000,
        "data_path": f"data/{chunk}/{file}.parquet",
        "video_path": f"videos/{{video_key}}/{chunk}/{file}.mkv",
        "features": features,
    }
    (root / "meta/info.json").write_text(json.dumps(info))
    return root


def edit_info(root: Path, change: Callable[[dict[str, Any]], Any] | None = None, **to: Any) -> None:
    """Change values of a dataset's info.json."""
    path = root / "meta/info.json"
    info = json.loads(path.read_text()) | to
    if change is not None:
        change(info)
    path.write_text(json.dumps(info))


def edit_columns(path: Path, **columns: Any) -> None:
    """Put other columns into a parquet file; None removes one, an array brings its own type."""
    table = pq.read_table(path)
    for name, values in columns.items():
        kind = None
        if name in table.column_names:
            kind = table.schema.field(name).type
            table = table.drop_columns(name)
        if values is not None:
            given = values if isinstance(values, pa.Array) else pa.array(values, kind)
            table = table.append_column(name, given)
    pq.write_table(table, path)


def _rows(
    episode: Episode,
    index: int,
    tasks: list[str],
    names: dict[str, str],
    stored: str | None,
    marked: bool,
) -> pa.Table:
    length = len(episode)
    table: dict[str, Any] = {
        names["state"]: pa.array(list(episode.state), pa.list_(pa.float32(), 8)),
        "frame_index": np.arange(length),
        "episode_index": np.full(length, index),
        "task_index": np.full(length, tasks.index(episode.goal)),
    }
    if episode.action is not None:
        table[names["action"]] = pa.array(list(episode.action), pa.list_(pa.float32()))
    if marked:  # as lists, which LeRobot's older writers made of numbers
        flags = [[step < episode.lesson] for step in range(length)]
        table["is_demo"] = pa.array(flags, pa.list_(pa.bool_()))
        table["exec_start_idx"] = pa.array([[episode.lesson]] * length, pa.list_(pa.int32()))
    for camera, frames in episode.images.items() if stored in ("png", "jpg") else ():
        cells = [{"bytes": encode_image(frame, str(stored)), "path": None} for frame in frames]
        kind = pa.struct({"bytes": pa.binary(), "path": pa.string()})
        table[names[camera]] = pa.array(cells, kind)
    return pa.table(table)


def _features(
    episode: Episode, names: dict[str, str], stored: str | None, marked: bool
) -> dict[str, Any]:
    image: dict[str, Any] = {"dtype": "image", "shape": [*SIZE, 3]}
    if stored == "video":
        described = {"video.codec": "ffv1", "video.pix_fmt": "bgr0"}
        image |= {"dtype": "video", "info": described}
    features = {names[camera]: dict(image) for camera in episode.images}
    for name in ("state", "action") if episode.action is not None else ("state",):
        features[names[name]] = {"dtype": "float32", "shape": [8]}
    if marked:
        features["is_demo"] = {"dtype": "bool", "shape": [1]}
        features["exec_start_idx"] = {"dtype": "int32", "shape": [1]}
    return features


def _write_metadata(
    meta: Path, version: str, tasks: list[str], table: dict[str, list[Any]]
) -> None:
    numbered = [{"task_index": number, "task": task} for number, task in enumerate(tasks)]
    (meta / "episodes/chunk-000").mkdir(parents=True)
    if version == "v3.0":
        pq.write_table(pa.table(table), meta.parent / TABLE)
        pq.write_table(pa.Table.from_pylist(numbered), meta / "tasks.parquet")
        return
    rows = [dict(zip(table, values, strict=True)) for values in zip(*table.values(), strict=True)]
    for name, lines in (("episodes", rows), ("tasks", numbered)):
        text = "".join(json.dumps(line) + "\n" for line in lines)
        (meta / f"{name}.jsonl").write_text(text)
    statistics = "stats.json" if version == "v2.0" else "episodes_stats.jsonl"
    (meta / statistics).write_text("{}\n")
