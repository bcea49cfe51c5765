"""Frames folders that are not as described: each is refused with one clear error."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from frames_factory import frames_of, rows_of, write_camera_video, write_images, write_table

from robomme_interference_data.build_dataset.sources.frames import FramesSource
from robomme_interference_data.errors import SourceError

DRAWER, MOVE = "OpenDrawer/train/0", "MoveCube/val/2"


def refused(folder: Path) -> str:
    """Message of the refusal when all episodes are listed and read."""
    with pytest.raises(SourceError) as caught:
        source = FramesSource(folder)
        for episode in source.episodes():
            list(source.read(episode))
    return str(caught.value)


def write_one(folder: Path, rows: list[dict[str, Any]] | None = None, length: int = 4) -> Path:
    write_table(folder, rows_of(DRAWER, 4) if rows is None else rows)
    return write_images(folder, "front", DRAWER, frames_of(0, length))


def changed(row: int, **values: Any) -> list[dict[str, Any]]:
    rows = rows_of(DRAWER, 4)
    rows[row].update(values)
    return rows


def without(name: str) -> list[dict[str, Any]]:
    return [{key: v for key, v in row.items() if key != name} for row in rows_of(DRAWER, 4)]


BROKEN_TABLES: list[tuple[Callable[[], list[dict[str, Any]]], str]] = [
    (lambda: without("state"), "column 'state' is missing"),
    (lambda: without("goal"), "column 'goal' is missing"),
    (lambda: rows_of(DRAWER, 4, is_demos=True), "unknown column 'is_demos'(.|\n)*'is_demo'"),
    (lambda: rows_of(DRAWER, 4, state="low"), "column 'state' holds string; expected lists of"),
    (lambda: rows_of(DRAWER, 4, seed="7"), "column 'seed' holds string; expected whole numbers"),
    (lambda: rows_of(DRAWER, 4, is_demo=1), "column 'is_demo' holds int64; expected true or"),
    (lambda: rows_of(DRAWER, 4, action=[[1]] * 4), "column 'action' holds list<.*int64>; expec"),
    (lambda: changed(2, goal=None), "column 'goal' has no value in row 2"),
    (lambda: changed(1, action=None), "column 'action' has no value in row 1"),
    (lambda: changed(1, state=[1.0]), f"row 1: state of {DRAWER} has 1 values; the first row has"),
    (lambda: rows_of(DRAWER, 4, action=[[0.0], [], [], []]), "action of .* has 0 values; the fi"),
    (lambda: changed(1, action=[1.0, None]), "column 'action' has vectors with empty values"),
    (lambda: changed(2, frame_index=3), f"row 2: frame_index of {DRAWER} is 3; expected 2"),
    (lambda: rows_of(DRAWER, 4)[1:], f"row 0: frame_index of {DRAWER} is 1; expected 0"),
    (
        lambda: rows_of(DRAWER, 2) + rows_of(MOVE, 1) + rows_of(DRAWER, 4)[2:],
        f"the rows of {DRAWER} are not together: they go on in row 3",
    ),
    (lambda: rows_of("OpenDrawer", 4), "row 0: 'OpenDrawer' is not an episode id"),
    (lambda: rows_of("A/trian/0", 4), "row 0: 'trian' is not a split"),
    (lambda: changed(3, goal="shut it"), f"{DRAWER} has several values of 'goal': 'open .*', 'sh"),
    (lambda: rows_of(DRAWER, 4, seed=[1, 1, 2, 1]), "several values of 'seed': 1, 2"),
    (lambda: rows_of(DRAWER, 4, goal=" "), "the goal of .* is empty"),
    (lambda: rows_of(DRAWER, 4, difficulty="hrd"), "difficulty of .* is 'hrd'(.|\n)*'hard'"),
    (
        lambda: rows_of(DRAWER, 4, is_demo=[False, True, True, False]),
        f"is_demo of {DRAWER} is true in 2 frames, not all of them at the beginning",
    ),
]


@pytest.mark.parametrize(("rows", "message"), BROKEN_TABLES)
def test_broken_tables(
    tmp_path: Path, rows: Callable[[], list[dict[str, Any]]], message: str
) -> None:
    write_one(tmp_path, rows())
    text = refused(tmp_path)
    assert re.search(message, text)
    assert "frames.parquet" in text
    assert "\n" in text  # says what to do


def test_no_table(tmp_path: Path) -> None:
    assert "is no frames folder: frames.parquet is missing" in refused(tmp_path)


def test_table_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "frames.parquet").write_bytes(b"episode_id,frame_index\n")
    assert "frames.parquet cannot be read" in refused(tmp_path)


def test_empty_table(tmp_path: Path) -> None:
    write_table(tmp_path, rows_of(DRAWER, 1))
    path = tmp_path / "frames.parquet"
    pq.write_table(pq.read_table(path).slice(0, 0), path)
    assert "has no rows" in refused(tmp_path)


@pytest.mark.parametrize("frames", [3, 6])
@pytest.mark.parametrize("camera", ["front", "wrist"])
def test_video_with_more_or_fewer_frames_than_rows(
    tmp_path: Path, frames: int, camera: str
) -> None:
    write_table(tmp_path, rows_of(DRAWER, 4))
    for name in ("front", "wrist"):
        length = frames if name == camera else 4
        write_camera_video(tmp_path, name, DRAWER, frames_of(0, length))
    text = refused(tmp_path)
    assert f"{camera}/{DRAWER}.mkv holds {frames} frames; frames.parquet has 4 rows" in text


def test_image_that_is_missing_or_too_many(tmp_path: Path) -> None:
    folder = write_one(tmp_path)
    (folder / "000002.png").rename(folder / "000004.png")
    assert f"{DRAWER}: {folder} lacks 000002.png; frames.parquet has 4 rows" in refused(tmp_path)
    shutil.copy(folder / "000001.png", folder / "000002.png")
    assert f"{folder} holds 000004.png" in refused(tmp_path)


def test_images_of_several_sizes(tmp_path: Path) -> None:
    folder = write_one(tmp_path)
    smaller = write_images(tmp_path / "other", "front", DRAWER, frames_of(0, 1)[:, :40])
    (smaller / "000000.png").replace(folder / "000002.png")
    text = refused(tmp_path)
    assert f"{DRAWER}: frame 2 of camera 'front' is 64×40 pixels; the first one is 64×48" in text


def test_image_that_is_damaged(tmp_path: Path) -> None:
    folder = write_one(tmp_path)
    path = folder / "000001.png"
    path.write_bytes(path.read_bytes()[:-30])
    assert f"{DRAWER}: {path}: an image is damaged" in refused(tmp_path)


def test_first_image_that_is_no_png(tmp_path: Path) -> None:
    write_table(tmp_path, rows_of(DRAWER, 4))
    write_images(tmp_path, "front", DRAWER, frames_of(0, 4), kind="jpg")
    assert f"{DRAWER}: not a PNG image" in refused(tmp_path)


def test_videos_and_images_of_one_camera(tmp_path: Path) -> None:
    write_one(tmp_path)
    write_camera_video(tmp_path, "front", DRAWER, frames_of(0, 4))
    assert f"camera 'front' of {DRAWER} is there twice" in refused(tmp_path)


def test_two_videos_of_one_episode(tmp_path: Path) -> None:
    write_table(tmp_path, rows_of(DRAWER, 4))
    write_camera_video(tmp_path, "front", DRAWER, frames_of(0, 4))
    write_camera_video(tmp_path, "front", DRAWER, frames_of(0, 4), suffix=".avi")
    assert f"camera 'front' of {DRAWER} is there twice" in refused(tmp_path)


def test_cameras_that_differ(tmp_path: Path) -> None:
    write_table(tmp_path, rows_of(DRAWER, 4) + rows_of(MOVE, 4))
    for episode in (DRAWER, MOVE):
        write_images(tmp_path, "front", episode, frames_of(0, 4))
    write_images(tmp_path, "wrist", MOVE, frames_of(1, 4))
    text = refused(tmp_path)
    assert f"{DRAWER} has no images of camera 'wrist'" in text
    assert f"videos/wrist/{DRAWER}.mkv" in text


def test_no_front_camera(tmp_path: Path) -> None:
    write_table(tmp_path, rows_of(DRAWER, 4))
    write_images(tmp_path, "top", DRAWER, frames_of(0, 4))
    assert f"{DRAWER} has no images of camera 'front'" in refused(tmp_path)


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("videos/front/OpenDrawer/train/3.mkv", "belongs to OpenDrawer/train/3, which frames.par"),
        ("videos/front/OpenDrawer/train/007.mkv", "'OpenDrawer/train/007' is not an episode id"),
        ("videos/front/OpenDrawer/train/notes.txt", "is no video file; expected one of .mkv"),
        ("images/front/OpenDrawer/train/1", "is a file; expected a folder"),
    ],
)
def test_files_that_do_not_belong(tmp_path: Path, place: str, message: str) -> None:
    write_one(tmp_path)
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / place).write_bytes(b"")
    text = refused(tmp_path)
    assert message in text
    assert place in text


def test_hidden_files_are_passed_over(tmp_path: Path) -> None:
    folder = write_one(tmp_path)
    (folder / ".DS_Store").write_bytes(b"")
    (folder.parent / ".DS_Store").write_bytes(b"")
    assert len(FramesSource(tmp_path).episodes()) == 1


def test_video_that_is_none(tmp_path: Path) -> None:
    write_table(tmp_path, rows_of(DRAWER, 4))
    path = tmp_path / "videos/front" / f"{DRAWER}.mkv"
    path.parent.mkdir(parents=True)
    path.write_bytes(b"nothing")
    assert f"{DRAWER}: {path} is not a readable video" in refused(tmp_path)
