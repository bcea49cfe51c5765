"""Recordings of any robot, out of a frames folder."""

import os
import pickle
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from frames_factory import (
    GOAL,
    frames_of,
    rows_of,
    write_camera_video,
    write_images,
    write_table,
)
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.build_dataset.sources import frames as frames_module
from robomme_interference_data.build_dataset.sources.frames import FramesSource
from robomme_interference_data.build_dataset.sources.tables import RowSpan
from robomme_interference_data.errors import SourceError

DRAWER, MOVE, LATER = "OpenDrawer/train/0", "MoveCube/val/2", "OpenDrawer/train/10"
LENGTHS = {DRAWER: 6, LATER: 4, MOVE: 5}
DOCS = Path(__file__).parent.parent / "docs" / "sources.md"


def write_mixed(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Three episodes with two cameras: front as video, wrist as images."""
    content = {}
    rows = []
    for seed, (episode, length) in enumerate(LENGTHS.items()):
        cameras = {"front": frames_of(seed, length), "wrist": frames_of(10 + seed, length)}
        write_camera_video(folder, "front", episode, cameras["front"])
        write_images(folder, "wrist", episode, cameras["wrist"])
        content[episode] = cameras
        shown = [step < 2 for step in range(length)]
        rows += rows_of(episode, length, is_demo=shown, seed=seed, difficulty="easy")
    write_table(folder, rows)
    return content


def test_episodes_and_frames(tmp_path: Path) -> None:
    content = write_mixed(tmp_path)
    source = FramesSource(tmp_path)
    assert source.kind == "frames"
    assert source.provenance == {"kind": "frames"}
    episodes = source.episodes()
    assert [str(episode.id) for episode in episodes] == [MOVE, DRAWER, LATER]
    assert [episode.seed for episode in episodes] == [2, 0, 1]
    assert [episode.key.start for episode in episodes] == [10, 0, 6]
    for episode in episodes:
        name = str(episode.id)
        assert episode.raw_length == LENGTHS[name]
        assert episode.demonstration_length == 2
        assert (episode.goals, episode.difficulty, episode.simulator) == ((GOAL,), "easy", None)
        assert (episode.state_size, episode.action_size) == (3, 2)
        assert episode.cameras == {"front": (48, 64), "wrist": (48, 64)}
        assert episode.exact
        frames = list(source.read(episode))
        assert len(frames) == LENGTHS[name]
        for step, frame in enumerate(frames):
            assert list(frame.images) == ["front", "wrist"]
            for camera, image in frame.images.items():
                np.testing.assert_array_equal(image, content[name][camera][step])
            assert frame.state.dtype == np.float32
            assert frame.state.tolist() == [0.5 * step, 1.0, -1.0]
            assert frame.action is not None
            assert frame.action.tolist() == [0.25 * step, 2.0]
            assert frame.is_demonstration is (step < 2)


def test_only_the_cameras_asked_for_are_read(tmp_path: Path) -> None:
    content = write_mixed(tmp_path)
    source = FramesSource(tmp_path)
    episode = replace(source.episodes()[0], cameras={"front": (48, 64)})
    (tmp_path / "images" / "wrist" / str(episode.id) / "000000.png").write_bytes(b"no PNG")
    frames = list(source.read(episode))
    assert [list(frame.images) for frame in frames] == [["front"]] * LENGTHS[MOVE]
    np.testing.assert_array_equal(frames[-1].images["front"], content[MOVE]["front"][-1])


def test_actions_may_be_missing(tmp_path: Path) -> None:
    rows = [{k: v for k, v in row.items() if k != "action"} for row in rows_of(DRAWER, 3)]
    write_table(tmp_path, rows)
    write_images(tmp_path, "front", DRAWER, frames_of(0, 3))
    source = FramesSource(tmp_path)
    (episode,) = source.episodes()
    assert episode.action_size is None
    assert [frame.action for frame in source.read(episode)] == [None] * 3


def test_real_lessons(tmp_path: Path, shared_data: Path) -> None:
    rows: list[dict[str, Any]] = []
    for family in ("PatternLock", "VideoUnmask"):
        name = f"{family}/test/0"
        with np.load(shared_data / f"lessons/{family}_test_0.npz") as lesson:
            length, states = len(lesson["state"]), lesson["state"].tolist()
            start, goal = int(lesson["exec_start_idx"]), str(lesson["task_goal"][0])
        shown = [step < start for step in range(length)]
        more = {"goal": goal, "is_demo": shown, "exact": True, "simulator": "robomme"}
        rows += [
            {"episode_id": name, "frame_index": step, "state": state}
            | {key: v[step] if isinstance(v, list) else v for key, v in more.items()}
            for step, state in enumerate(states)
        ]
        target = tmp_path / f"videos/front/{name}.mkv"
        target.parent.mkdir(parents=True)
        target.symlink_to(shared_data / f"lessons/{family}_test_0_front.mkv")
    write_table(tmp_path, rows)
    source = FramesSource(tmp_path)
    unmask, pattern = source.episodes()
    assert (unmask.raw_length, unmask.demonstration_length) == (67, 66)
    assert (pattern.raw_length, pattern.demonstration_length) == (87, 86)
    assert pattern.cameras == {"front": (256, 256)}
    with av.open(str(shared_data / "lessons/PatternLock_test_0_front.mkv")) as video:
        for frame, plain in zip(source.read(pattern), video.decode(video=0), strict=True):
            np.testing.assert_array_equal(frame.images["front"], plain.to_ndarray(format="rgb24"))


def test_copies_read_the_same(tmp_path: Path) -> None:
    content = write_mixed(tmp_path)
    source = FramesSource(tmp_path)
    copy, episodes = pickle.loads(pickle.dumps((source, source.episodes())))
    first = next(copy.read(episodes[0]))
    np.testing.assert_array_equal(first.images["front"], content[MOVE]["front"][0])


def test_images_are_decoded_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_mixed(tmp_path)
    decoded = []
    decode = frames_module.decode_image
    monkeypatch.setattr(
        frames_module, "decode_image", lambda data: decoded.append(1) or decode(data)
    )
    source = FramesSource(tmp_path)
    stream = source.read(source.episodes()[0])
    assert not decoded
    next(stream)
    next(stream)
    assert len(decoded) == 2
    stream.close()


def test_the_example_in_the_docs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = re.search(r"<!-- example: frames -->\n```python\n(.*?)```", DOCS.read_text(), re.S)
    assert found is not None
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(found[1], names)
    source = FramesSource(tmp_path / "my_robot")
    (episode,) = source.episodes()
    assert (str(episode.id), episode.exact, episode.demonstration_length) == (DRAWER, True, None)
    for frame, image in zip(source.read(episode), names["frames"], strict=True):
        np.testing.assert_array_equal(frame.images["front"], image)
        assert frame.is_demonstration is None


@pytest.mark.parametrize(
    ("codec", "pix_fmt", "declared", "exact"),
    [
        ("ffv1", "bgr0", None, True),
        ("ffv1", "bgr0", False, False),
        ("ffv1", "yuv420p", None, False),
        ("mpeg4", "yuv420p", None, False),
        ("libx264rgb", "rgb24", None, False),
        ("libx264rgb", "rgb24", True, True),
    ],
)
def test_exact(
    tmp_path: Path, codec: str, pix_fmt: str, declared: bool | None, exact: bool
) -> None:
    write_camera_video(tmp_path, "front", DRAWER, frames_of(0, 4), codec, pix_fmt)
    more = {} if declared is None else {"exact": declared}
    write_table(tmp_path, rows_of(DRAWER, 4, **more))
    source = FramesSource(tmp_path)
    (episode,) = source.episodes()
    assert episode.exact is exact
    assert len(list(source.read(episode))) == 4


def test_key_tells_when_a_file_changes(tmp_path: Path) -> None:
    write_mixed(tmp_path)
    before = FramesSource(tmp_path).episodes()
    assert [e.key for e in FramesSource(tmp_path).episodes()] == [e.key for e in before]
    os.utime(tmp_path / f"images/wrist/{MOVE}/000003.png", (4e9, 4e9))
    after = FramesSource(tmp_path).episodes()
    assert [a.key == b.key for a, b in zip(after, before, strict=True)] == [False, True, True]


def test_table_that_changes_meanwhile(tmp_path: Path) -> None:
    write_mixed(tmp_path)
    source = FramesSource(tmp_path)
    episode = source.episodes()[0]
    write_table(tmp_path, rows_of(DRAWER, 6))
    with pytest.raises(SourceError, match=f"{MOVE}: frames.parquet has changed"):
        next(source.read(episode))


@given(st.lists(st.integers(1, 9), min_size=1, max_size=6), st.integers(1, 7), st.data())
def test_any_span_of_rows(tmp_path_factory, lengths, rows_a_group, data) -> None:
    total = sum(lengths)
    path = tmp_path_factory.mktemp("rows") / "table.parquet"
    values = np.arange(2.0 * total, dtype=np.float32).reshape(total, 2)
    cells = [{"bytes": bytes([row]), "path": None} for row in range(total)]
    table = pa.table({"number": range(total), "vector": list(values), "image": cells})
    pq.write_table(table, path, row_group_size=rows_a_group)
    start = data.draw(st.integers(0, total - 1))
    stop = data.draw(st.integers(start + 1, total))
    span = RowSpan(path, start, stop)
    assert span.scalars("number").tolist() == list(range(start, stop))
    np.testing.assert_array_equal(span.vectors("vector"), values[start:stop])
    assert [image[0] for image in span.images("image")] == list(range(start, stop))
