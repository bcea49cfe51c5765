"""Small LeRobot datasets, v3.0 and v2.1, written without lerobot: importing it takes 10 s."""

import json
from collections.abc import Callable, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from support.episodes import MOVE, PEG, SIZE, Episode, encode_image, make_episode, write_video

EPISODES = [make_episode(1, 12, MOVE, 5), make_episode(2, 9, PEG, 9), make_episode(3, 7, MOVE, 0)]
IDS = {"MoveCube/train/0": 0, "MoveCube/train/1": 2, "InsertPeg/train/0": 1}
"""Ids of `EPISODES` by the families file, in canonical order, and their places."""

V21_NAMES = {"front": "image", "wrist": "wrist_image", "state": "state", "action": "actions"}
V30_NAMES = {
    "front": "observation.images.front",
    "wrist": "observation.images.wrist",
    "state": "observation.state",
    "action": "action",
}
FAMILIES = "episode_index,family\n0,MoveCube\n1,InsertPeg\n2,MoveCube\n"


def write_families(folder: Path) -> Path:
    """Write the families file of `EPISODES`, or of the first of them."""
    path = folder / "families.csv"
    path.write_text(FAMILIES)
    return path


def write_lerobot(
    root: Path,
    episodes: Sequence[Episode] = EPISODES,
    *,
    version: str = "v3.0",
    stored: str | None = "png",
    marked: bool = True,
    rows_a_group: int = 4,
    **columns: list[Any],
) -> Path:
    """Write a dataset; in v3.0, all episodes share their files.

    Args:
        root: The folder.
        episodes: What it holds.
        version: `v3.0`, or `v2.1` as `Yinpei/robomme_data_lerobot` is laid out.
        stored: Images as `png` or `jpg` in parquet, as `video` files (FFV1), or None for none.
        marked: Write the columns `is_demo` and `exec_start_idx`.
        rows_a_group: Rows in a row group.
        **columns: Further per-episode columns.
    """
    v21 = version == "v2.1"
    names = V21_NAMES if v21 else V30_NAMES
    tasks = list(dict.fromkeys(episode.goal for episode in episodes))
    starts = [0, *accumulate(map(len, episodes))]
    cameras = list(episodes[0].images) if episodes else []
    for index in range(len(episodes)):
        chosen = episodes[index : index + 1] if v21 else episodes
        tables = [
            _rows(one, i, tasks, names, stored if stored != "video" else None, marked)
            for i, one in enumerate(chosen, index)
        ]
        path = root / f"data/chunk-000/{_file(v21, index)}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.concat_tables(tables), path, row_group_size=rows_a_group)
        for camera in cameras if stored == "video" else ():
            place = (
                f"chunk-000/{names[camera]}/{_file(v21, index)}"
                if v21
                else f"{names[camera]}/chunk-000/{_file(v21, index)}"
            )
            frames = np.concatenate([one.images[camera] for one in chosen])
            write_video(root / f"videos/{place}.mkv", frames)
        if not v21:
            break
    per_episode: dict[str, Any] = {
        "episode_index": range(len(episodes)),
        "length": [len(one) for one in episodes],
        "tasks": [[one.goal] for one in episodes],
        **columns,
    }
    if not v21:
        zeros = [0] * len(episodes)
        per_episode |= {"data/chunk_index": zeros, "data/file_index": zeros}
        for camera in cameras if stored == "video" else ():
            key = f"videos/{names[camera]}/"
            per_episode |= {key + "chunk_index": zeros, key + "file_index": zeros}
            per_episode[key + "from_timestamp"] = [start / 10 for start in starts[:-1]]
    _write_metadata(root, version, tasks, per_episode)
    kind = {"dtype": "video", "info": {"video.codec": "ffv1", "video.pix_fmt": "bgr0"}}
    features: dict[str, Any] = {
        names[camera]: {**(kind if stored == "video" else {"dtype": "image"}), "shape": [*SIZE, 3]}
        for camera in cameras
    }
    features[names["state"]] = {"dtype": "float32", "shape": [8]}
    if episodes and episodes[0].action is not None:
        features[names["action"]] = {"dtype": "float32", "shape": [8]}
    if marked:
        features["is_demo"] = {"dtype": "bool", "shape": [1]}
        features["exec_start_idx"] = {"dtype": "int32", "shape": [1]}
    file = "episode_{episode_index:06d}" if v21 else "file-{file_index:03d}"
    chunk = "chunk-{episode_chunk:03d}" if v21 else "chunk-{chunk_index:03d}"
    videos = f"{chunk}/{{video_key}}" if v21 else f"{{video_key}}/{chunk}"
    info = {
        "codebase_version": version,
        "fps": 10,
        "total_episodes": len(episodes),
        "data_path": f"data/{chunk}/{file}.parquet",
        "video_path": f"videos/{videos}/{file}.mkv",
        "features": features,
        **({"chunks_size": 1000} if v21 else {}),
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
    """Put other columns into a parquet file, or other values into them; None removes one."""
    table = pq.read_table(path)
    for name, values in columns.items():
        place = table.column_names.index(name) if name in table.column_names else None
        kind = None if place is None else table.schema.field(name).type
        if place is not None:
            table = table.remove_column(place)
        if values is not None:
            given = values if isinstance(values, pa.Array) else pa.array(values, kind)
            table = table.append_column(name, given)
    pq.write_table(table, path)


def _file(v21: bool, index: int) -> str:
    return f"episode_{index:06d}" if v21 else "file-000"


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
    if marked:
        flags = [[step < episode.lesson] for step in range(length)]
        table["is_demo"] = pa.array(flags, pa.list_(pa.bool_()))
        table["exec_start_idx"] = pa.array([[episode.lesson]] * length, pa.list_(pa.int32()))
    kind = pa.struct({"bytes": pa.binary(), "path": pa.string()})
    for camera, frames in episode.images.items() if stored else ():
        cells = [{"bytes": encode_image(frame, str(stored)), "path": None} for frame in frames]
        table[names[camera]] = pa.array(cells, kind)
    return pa.table(table)


def _write_metadata(
    root: Path, version: str, tasks: list[str], per_episode: dict[str, Sequence[Any]]
) -> None:
    meta = root / "meta"
    meta.mkdir(parents=True, exist_ok=True)
    if version == "v3.0":
        (meta / "episodes/chunk-000").mkdir(parents=True)
        table = pa.table({name: pa.array(list(v)) for name, v in per_episode.items()})
        pq.write_table(table, meta / "episodes/chunk-000/file-000.parquet")
        numbered = pa.table({"task_index": range(len(tasks)), "task": tasks})
        pq.write_table(numbered, meta / "tasks.parquet")
        return
    columns = zip(*per_episode.values(), strict=True)
    rows = [dict(zip(per_episode, values, strict=True)) for values in columns]
    write_lines(meta / "episodes.jsonl", rows)
    write_lines(meta / "tasks.jsonl", [{"task_index": i, "task": t} for i, t in enumerate(tasks)])


def write_lines(path: Path, rows: list[dict[str, Any]]) -> None:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
