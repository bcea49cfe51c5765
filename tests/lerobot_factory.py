"""Small LeRobot datasets: v3.0 by lerobot's own writer, v2.1 and bare metadata by hand."""

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

SIZE = (48, 64)
EXACT_VIDEO = {
    "vcodec": "libaom-av1",
    "pix_fmt": "gbrp",
    "g": 16,
    "crf": None,
    "extra_options": {"usage": 1, "cpu-used": 8, "row-mt": 1, "aom-params": "lossless=1"},
}


@dataclass(frozen=True)
class Recording:
    """What goes into a dataset as one episode."""

    goal: str
    images: dict[str, NDArray[np.uint8]]
    state: NDArray[np.float32]
    action: NDArray[np.float32]
    demonstration: int

    def __len__(self) -> int:
        return len(self.state)


def recording(
    seed: int, length: int, goal: str, demonstration: int = 0, cameras: tuple[str, ...] = ("front",)
) -> Recording:
    """Frames that all differ: a seeded picture that moves on by a pixel a frame."""
    rng = np.random.default_rng(seed)
    height, width = SIZE
    images = {}
    for camera in cameras:
        picture = np.repeat(np.repeat(rng.integers(0, 256, (6, 8, 3)), 8, 0), 8, 1)
        images[camera] = np.stack(
            [np.roll(picture, step, axis=1) for step in range(length)]
        ).astype(np.uint8)
        images[camera][:, 0, 0, 0] = np.arange(length)
    assert images["front"].shape == (length, height, width, 3)
    return Recording(
        goal,
        images,
        rng.normal(size=(length, 8)).astype(np.float32),
        rng.normal(size=(length, 8)).astype(np.float32),
        demonstration,
    )


def write_v3(
    root: Path,
    recordings: list[Recording],
    *,
    video: dict[str, Any] | None = None,
    images: bool = False,
    marked: bool = True,
) -> None:
    """Write a v3.0 dataset with lerobot's own writer.

    Args:
        root: A folder that does not exist.
        recordings: The episodes.
        video: Encoder settings; None for lerobot's default, which is lossy.
        images: Store the images in parquet instead.
        marked: Add the columns `is_demo` and `exec_start_idx`.
    """
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets import LeRobotDataset

    kind = "image" if images else "video"
    features: dict[str, Any] = {
        f"observation.images.{camera}": {
            "dtype": kind,
            "shape": (*SIZE, 3),
            "names": ["height", "width", "channels"],
        }
        for camera in recordings[0].images
    }
    for name in ("observation.state", "action"):
        features[name] = {"dtype": "float32", "shape": (8,), "names": None}
    if marked:
        features["is_demo"] = {"dtype": "bool", "shape": (1,), "names": None}
        features["exec_start_idx"] = {"dtype": "int64", "shape": (1,), "names": None}
    encoder = {} if video is None else {"rgb_encoder": RGBEncoderConfig(**video)}
    dataset = LeRobotDataset.create(
        "test/small", 10, features, root=root, use_videos=not images, **encoder
    )
    for episode in recordings:
        for step in range(len(episode)):
            frame: dict[str, Any] = {
                f"observation.images.{camera}": frames[step]
                for camera, frames in episode.images.items()
            }
            frame |= {
                "observation.state": episode.state[step],
                "action": episode.action[step],
                "task": episode.goal,
            }
            if marked:
                frame["is_demo"] = np.array([step < episode.demonstration])
                frame["exec_start_idx"] = np.array([episode.demonstration])
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()


def write_v21(
    root: Path,
    recordings: list[Recording],
    *,
    stored: str = "png",
    marks: bool = True,
    stats: bool = True,
    rows_a_group: int = 4,
) -> None:
    """Write a v2.1 dataset as `Yinpei/robomme_data_lerobot` is laid out.

    Args:
        root: The folder.
        recordings: The episodes.
        stored: Images as `png` or `jpg` in parquet, or as `video` files (FFV1).
        marks: Write the columns `is_demo` and `exec_start_idx`.
        stats: Write `meta/episodes_stats.jsonl`.
        rows_a_group: Rows in a row group.
    """
    columns = {"front": "image", "wrist": "wrist_image"}
    (root / "meta").mkdir(parents=True)
    tasks = list(dict.fromkeys(episode.goal for episode in recordings))
    for index, episode in enumerate(recordings):
        length, chunk = len(episode), f"chunk-{index // 1000:03d}"
        table: dict[str, Any] = {
            "state": pa.array(list(episode.state), pa.list_(pa.float32(), 8)),
            "actions": pa.array(list(episode.action), pa.list_(pa.float32(), 8)),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, index),
            "task_index": np.full(length, tasks.index(episode.goal)),
        }
        if marks:
            flags = [[step < episode.demonstration] for step in range(length)]
            table["is_demo"] = pa.array(flags, pa.list_(pa.bool_()))
            table["exec_start_idx"] = pa.array([[episode.demonstration]] * length)
        for camera, frames in episode.images.items():
            if stored == "video":
                path = root / f"videos/{chunk}/{columns[camera]}/episode_{index:06d}.mkv"
                write_video(path, frames)
            else:
                cells = [{"bytes": encode(frame, stored), "path": None} for frame in frames]
                table[columns[camera]] = pa.array(
                    cells, pa.struct({"bytes": pa.binary(), "path": pa.string()})
                )
        path = root / f"data/{chunk}/episode_{index:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(table), path, row_group_size=rows_a_group)
    kind = {"dtype": "video"} if stored == "video" else {"dtype": "image"}
    info = {"video.codec": "ffv1", "video.pix_fmt": "bgr0"} if stored == "video" else {}
    features: dict[str, Any] = {
        columns[camera]: {**kind, "shape": [*SIZE, 3], "info": info}
        for camera in recordings[0].images
    }
    features |= {name: {"dtype": "float32", "shape": [8]} for name in ("state", "actions")}
    if marks:
        features |= {
            "is_demo": {"dtype": "bool", "shape": [1]},
            "exec_start_idx": {"dtype": "int32", "shape": [1]},
        }
    write_info(
        root,
        codebase_version="v2.1",
        fps=10,
        total_episodes=len(recordings),
        chunks_size=1000,
        data_path="data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        video_path="videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mkv",
        features=features,
    )
    write_lines(
        root / "meta/tasks.jsonl",
        [{"task_index": index, "task": task} for index, task in enumerate(tasks)],
    )
    write_lines(
        root / "meta/episodes.jsonl",
        [
            {"episode_index": index, "tasks": [episode.goal], "length": len(episode)}
            for index, episode in enumerate(recordings)
        ],
    )
    if stats:
        write_lines(
            root / "meta/episodes_stats.jsonl",
            [
                {
                    "episode_index": index,
                    "stats": {
                        "exec_start_idx": {
                            "min": [episode.demonstration],
                            "max": [episode.demonstration],
                        }
                    },
                }
                for index, episode in enumerate(recordings)
            ],
        )


def write_v3_metadata(root: Path, tasks: list[str], **columns: list[Any]) -> None:
    """Write the metadata of a v3.0 dataset with one-frame episodes, and its small data file."""
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    (root / "data/chunk-000").mkdir(parents=True)
    count = len(tasks)
    write_info(
        root,
        codebase_version="v3.0",
        fps=10,
        total_episodes=count,
        data_path="data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        video_path="videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        features={
            "image": {
                "dtype": "video",
                "shape": [256, 256, 3],
                "info": {"video.codec": "av1", "video.pix_fmt": "yuv420p"},
            },
            "state": {"dtype": "float32", "shape": [8]},
            "actions": {"dtype": "float32", "shape": [8]},
        },
    )
    indices = np.arange(count)
    episodes = {
        "episode_index": indices,
        "length": np.ones(count, np.int64),
        "tasks": [[task] for task in tasks],
        "data/chunk_index": np.zeros(count, np.int64),
        "data/file_index": np.zeros(count, np.int64),
        "videos/image/chunk_index": np.zeros(count, np.int64),
        "videos/image/file_index": np.zeros(count, np.int64),
        "videos/image/from_timestamp": indices / 10,
        "stats/state/mean": [[0.0] * 8] * count,
        **columns,
    }
    pq.write_table(pa.table(episodes), root / "meta/episodes/chunk-000/file-000.parquet")
    known = list(dict.fromkeys(tasks))
    pq.write_table(
        pa.table({"task_index": np.arange(len(known)), "task": known}), root / "meta/tasks.parquet"
    )
    vector = pa.array([[0.0] * 8] * count, pa.list_(pa.float32()))
    pq.write_table(
        pa.table(
            {
                "episode_index": indices,
                "frame_index": np.zeros(count, np.int64),
                "state": vector,
                "actions": vector,
            }
        ),
        root / "data/chunk-000/file-000.parquet",
    )


def write_info(root: Path, **values: Any) -> None:
    (root / "meta/info.json").write_text(json.dumps(values))


def write_lines(path: Path, rows: list[dict[str, Any]]) -> None:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def encode(image: NDArray[np.uint8], kind: str) -> bytes:
    """Encode an image as `png` or `jpg`."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(image).save(out, {"png": "PNG", "jpg": "JPEG"}[kind])
    return out.getvalue()


def write_video(
    path: Path, frames: NDArray[np.uint8], codec: str = "ffv1", pix_fmt: str = "bgr0"
) -> None:
    """Write frames `(T, H, W, 3) uint8` as a video of 10 frames per second."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        height, width = frames.shape[1:3]
        stream = container.add_stream(codec, 10, width=width, height=height, pix_fmt=pix_fmt)
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode(None))


def write_small_families(folder: Path) -> Path:
    """Write the families file of a dataset made of `SMALL`."""
    path = folder / "families.csv"
    path.write_text("episode_index,family\n0,MoveCube\n1,InsertPeg\n2,MoveCube\n")
    return path


def change_info(root: Path, **changes: Any) -> None:
    """Change values of a dataset's info.json."""
    write_info(root, **json.loads((root / "meta/info.json").read_text()) | changes)


def change_column(path: Path, name: str, values: list[Any]) -> None:
    """Put other values of the same type into a column of a parquet file."""
    table = pq.read_table(path)
    column = pa.array(values, table.schema.field(name).type)
    pq.write_table(table.set_column(table.column_names.index(name), name, column), path)


MOVE = "see the video and move the cube in the same manner"
PEG = "see the video and insert the same peg at the same end"
SMALL = [
    recording(1, 12, MOVE, 5, ("front", "wrist")),
    recording(2, 9, PEG, 9, ("front", "wrist")),
    recording(3, 7, MOVE, 0, ("front", "wrist")),
]
SMALL_IDS = ["MoveCube/train/0", "MoveCube/train/1", "InsertPeg/train/0"]
"""Ids of the episodes of SMALL in canonical order, by the small families file."""

SMALL_ORDER = [0, 2, 1]
"""Place in SMALL of each of these."""
