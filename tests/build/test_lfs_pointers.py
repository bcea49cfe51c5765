"""Clones without Git LFS: short texts in place of tables, videos, images and recordings."""

import hashlib
from pathlib import Path

import pytest
from support.buffer_sets import copy_buffer_set
from support.lerobot_layouts import write_lerobot
from support.messages import raises
from support.recordings import EPISODES, write_frames, write_h5

from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.data.loading import load_buffer
from robomme_interference_data.errors import MissingFileError
from robomme_interference_data.storage.text import check_not_pointer


def make_pointer(path: Path) -> None:
    """Put in the place of a file what a clone without Git LFS has there."""
    data = path.read_bytes()
    path.write_text(
        "version https://git-lfs.github.com/spec/v1\n"
        f"oid sha256:{hashlib.sha256(data).hexdigest()}\nsize {len(data)}\n"
    )


def test_the_hint_names_the_clone(tmp_path: Path) -> None:
    path = tmp_path / "clone" / "data" / "a.parquet"
    path.parent.mkdir(parents=True)
    path.write_bytes(b"data")
    check_not_pointer(path)
    make_pointer(path)
    with raises(MissingFileError) as caught:
        check_not_pointer(path)
    assert str(caught.value.hint).endswith(f" {path.parent}")
    (tmp_path / "clone" / ".git").mkdir()
    with raises(MissingFileError) as caught:
        check_not_pointer(path)
    assert str(caught.value.hint).endswith(f" {tmp_path / 'clone'}")


@pytest.mark.parametrize(
    ("kind", "pattern"),
    [
        ("lerobot", "meta/info.json"),
        ("lerobot", "meta/tasks.parquet"),
        ("lerobot", "meta/episodes/*/*.parquet"),
        ("lerobot", "data/*/*.parquet"),
        ("lerobot", "videos/*/*/*.mkv"),
        ("lerobot-v2.1", "meta/episodes.jsonl"),
        ("lerobot-v2.1", "meta/tasks.jsonl"),
        ("frames", "frames.parquet"),
        ("frames", "videos/*/*/*/*"),
        ("frames", "images/*/*/*/*/*.png"),
        ("robomme-h5", "*.h5"),
    ],
)
def test_sources(tmp_path: Path, kind: str, pattern: str) -> None:
    name, _, version = kind.partition("-v")
    if name == "frames":
        write_frames(tmp_path, EPISODES)
    elif name == "robomme-h5":
        pytest.importorskip("h5py")
        write_h5(tmp_path, EPISODES)
    else:
        write_lerobot(tmp_path, stored="video", version=f"v{version or '3.0'}")
    paths = sorted(tmp_path.glob(pattern))
    assert paths
    for path in paths:
        make_pointer(path)
    with raises(MissingFileError) as caught:
        source = open_source(f"{name}:{tmp_path}")
        for _ in source.read(source.episodes()[0], None).frames:
            pass
    assert "git lfs pull" in str(caught.value.hint)


@pytest.mark.parametrize(
    "pattern",
    [
        "demonstrations/meta/info.json",
        "demonstrations/data/*/*.parquet",
        "demonstrations/videos/*/*/*",
        "manifests/buffers.parquet",
    ],
)
def test_buffer_sets(tmp_path: Path, pattern: str) -> None:
    copy_buffer_set(tmp_path / "set")
    for path in sorted((tmp_path / "set").glob(pattern)):
        make_pointer(path)
    with raises(MissingFileError) as caught:
        buffer = load_buffer("PatternLock/test/0", "k1", buffer_set=tmp_path / "set")
        buffer.frames("front")
        _ = buffer.states
    assert "git lfs pull" in str(caught.value.hint)
