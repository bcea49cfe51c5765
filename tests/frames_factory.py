"""Small frames folders: recordings of any robot."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot_factory import encode, recording, write_video
from numpy.typing import NDArray

GOAL = "open the upper drawer"


def frames_of(seed: int, length: int) -> NDArray[np.uint8]:
    """Frames `(T, 48, 64, 3) uint8` that all differ."""
    return recording(seed, length, GOAL).images["front"]


def rows_of(episode: str, length: int, **values: Any) -> list[dict[str, Any]]:
    """Rows of an episode; a value may be a list with one value for each row."""
    return [
        {
            "episode_id": episode,
            "frame_index": step,
            "state": [0.5 * step, 1.0, -1.0],
            "action": [0.25 * step, 2.0],
            "goal": GOAL,
            **{name: v[step] if isinstance(v, list) else v for name, v in values.items()},
        }
        for step in range(length)
    ]


def write_table(folder: Path, rows: list[dict[str, Any]]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(rows), folder / "frames.parquet")


def write_images(
    folder: Path, camera: str, episode: str, frames: NDArray[np.uint8], kind: str = "png"
) -> Path:
    """Write frames as images; returns their folder."""
    target = folder / "images" / camera / episode
    target.mkdir(parents=True)
    for number, frame in enumerate(frames):
        (target / f"{number:06d}.png").write_bytes(encode(frame, kind))
    return target


def write_camera_video(
    folder: Path,
    camera: str,
    episode: str,
    frames: NDArray[np.uint8],
    codec: str = "ffv1",
    pix_fmt: str = "bgr0",
    suffix: str = ".mkv",
) -> Path:
    """Write frames as a video; returns its path."""
    path = folder / "videos" / camera / f"{episode}{suffix}"
    write_video(path, frames, codec, pix_fmt)
    return path
