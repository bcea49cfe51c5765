"""Frames folders of one episode of four frames, for the tests of that source."""

import shutil
from pathlib import Path
from typing import Any

from robomme_interference_data.build_dataset.sources import Recording
from robomme_interference_data.build_dataset.sources.frames import FramesSource

from .recordings import Rows, make_episode, rows_of, write_images, write_table, write_video

DRAWER, MOVE = "OpenDrawer/train/0", "MoveCube/val/2"
FOUR = make_episode(4, 4, "open it", cameras=("front",))
FRONT = FOUR.images["front"]


def place(folder: Path, name: str = DRAWER, kind: str = "images", camera: str = "front") -> Path:
    return folder / kind / camera / (f"{name}.mkv" if kind == "videos" else name)


def write(folder: Path, rows: Rows | None = None) -> Path:
    """Write a folder with one episode of four images; returns the folder of the images."""
    write_table(folder, rows_of(DRAWER, FOUR) if rows is None else rows)
    return write_images(place(folder), FRONT)


def read_one(folder: Path) -> Recording:
    source = FramesSource(folder)
    return source.read(source.episodes()[0], None)


def four(**values: Any) -> Rows:
    return rows_of(DRAWER, FOUR, **values)


def replace_by_video(folder: Path, frames: int) -> None:
    shutil.rmtree(folder / "images", ignore_errors=True)
    shown = make_episode(0, frames).images["front"]
    write_video(place(folder, kind="videos"), shown)
