"""Frames folders: recordings of any robot, and folders that are not as described."""

import re
import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.frames_folders import (
    DRAWER,
    FOUR,
    FRONT,
    MOVE,
    four,
    place,
    read_one,
    replace_by_video,
    write,
)
from support.messages import raises
from support.recordings import (
    Rows,
    check_recording,
    encode_image,
    rows_of,
    write_images,
    write_table,
    write_video,
)

from robomme_interference_data.build_dataset.sources import Robot
from robomme_interference_data.build_dataset.sources.frames import FramesSource
from robomme_interference_data.errors import InterferenceError, SourceError

DOCS = Path(__file__).parents[2] / "docs" / "how-to" / "your-own-recordings.md"


@pytest.mark.parametrize(
    ("codec", "pix_fmt", "declared", "exact"),
    [
        ("ffv1", "bgr0", False, False),
        ("libx264rgb", "rgb24", None, False),
        ("libx264rgb", "rgb24", True, True),
    ],
)
def test_exact(
    tmp_path: Path, codec: str, pix_fmt: str, declared: bool | None, exact: bool
) -> None:
    write_video(place(tmp_path, kind="videos"), FRONT, codec, pix_fmt)
    write_table(
        tmp_path, rows_of(DRAWER, FOUR, **({} if declared is None else {"exact": declared}))
    )
    source = FramesSource(tmp_path)
    assert source.read(source.episodes()[0], None).exact is exact


def test_rate_and_names_are_those_that_are_stated(tmp_path: Path) -> None:
    """Images have no rate, and no names are made up; a video has its own rate."""
    write(tmp_path / "images")
    assert read_one(tmp_path / "images").robot == Robot()
    names = {
        "state_names": [f"j{n}" for n in range(8)],
        "action_names": [f"v{n}" for n in range(8)],
    }
    write(
        tmp_path / "stated",
        rows_of(DRAWER, FOUR, fps=12.5, **{n: [v] * 4 for n, v in names.items()}),
    )
    expected = {"observation.state": names["state_names"], "action": names["action_names"]}
    assert read_one(tmp_path / "stated").robot == Robot(
        12.5, names={feature: tuple(values) for feature, values in expected.items()}
    )
    write_video(place(tmp_path / "video", kind="videos"), FRONT)
    write_table(tmp_path / "video", rows_of(DRAWER, FOUR))
    assert read_one(tmp_path / "video").robot == Robot(10)
    write_table(tmp_path / "video", rows_of(DRAWER, FOUR, fps=15))
    with raises(SourceError):
        read_one(tmp_path / "video")


@pytest.mark.parametrize("rate", [12.5, 15, Fraction(30000, 1001)])
def test_the_rate_of_a_video(tmp_path: Path, rate: Any) -> None:
    path = place(tmp_path, kind="videos")
    path.parent.mkdir(parents=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", Fraction(rate), width=24, height=16, pix_fmt="bgr0")
        for image in FRONT:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    write_table(tmp_path, rows_of(DRAWER, FOUR))
    recording = read_one(tmp_path)
    assert recording.robot.fps == float(rate)
    check_recording(recording, FOUR, marked=False)


def test_the_example_in_the_docs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = re.search(r"<!-- example: frames -->\n```python\n(.*?)```", DOCS.read_text(), re.S)
    assert found is not None
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(found[1], names)
    source = FramesSource(tmp_path / "my_robot")
    drawer, cups = source.episodes()
    recording = source.read(drawer, None)
    assert (str(drawer.id), str(cups.id)) == ("OpenDrawer/test/0", "StackCups/train/0")
    assert recording.exact
    rng, frames = np.random.default_rng(0), list(recording.frames)  # as in the example
    assert [frame.is_demonstration for frame in frames] == [True] * 40 + [False] * 20
    for frame in frames:
        image = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        np.testing.assert_array_equal(frame.images["front"], image)


def refused(folder: Path) -> str:
    """Return the error when all episodes are listed and read."""
    with pytest.raises(InterferenceError) as caught:
        source = FramesSource(folder)
        for episode in source.episodes():
            list(source.read(episode, None).frames)
    return str(caught.value)


def changed(row: int, **values: Any) -> Rows:
    rows = four()
    rows[row].update(values)
    return rows


TABLES: list[tuple[Callable[[], Rows], str]] = [
    (lambda: four(is_demos=True), "unknown column 'is_demos'(.|\n)*'is_demo'"),
    (lambda: four(state="low"), "column 'state' holds string; expected lists of"),
    (lambda: changed(2, goal=None), "column 'goal' has no value in row 2"),
    (
        lambda: changed(1, state=[np.float32(1)]),
        r"frame 1 \(row 1\) has 1 value, those before it 8",
    ),
    (lambda: changed(2, frame_index=3), f"{DRAWER}: frame_index in row 2 is 3; expected 2"),
    (lambda: four()[:2] + rows_of(MOVE, FOUR)[:1] + four()[2:], "not together: row 3"),
    (lambda: rows_of("OpenDrawer", FOUR), "row 0: 'OpenDrawer' is not an episode id"),
    (lambda: changed(3, goal="shut it"), f"{DRAWER} has several values of 'goal'"),
    (lambda: four(fps=1e-9), f"{DRAWER}: fps is 1e-09; expected 0.001 to 10,000"),
    (lambda: four(is_demo=[False, True, True, False]), f"{DRAWER}: is_demo is true in 2 frames"),
]


@pytest.mark.parametrize(("rows", "message"), TABLES)
def test_broken_tables(tmp_path: Path, rows: Callable[[], Rows], message: str) -> None:
    write(tmp_path, rows())
    text = refused(tmp_path)
    assert re.search(message, text)
    assert "\n" in text  # says what to do


def retyped(**kinds: Any) -> Callable[[pa.Table], pa.Table]:
    """Return a change of the types of columns."""

    def change(table: pa.Table) -> pa.Table:
        for name, kind in kinds.items():
            column = table[name].cast(kind)
            table = table.set_column(table.column_names.index(name), name, column)
        return table

    return change


def with_column(name: str, values: list[Any]) -> Callable[[pa.Table], pa.Table]:
    return lambda table: table.append_column(name, pa.array(values))


CATEGORY = pa.dictionary(pa.int8(), pa.string())
AS_OTHERS_WRITE = [
    retyped(episode_id=CATEGORY, goal=pa.large_string()),
    retyped(episode_id=pa.large_string(), goal=CATEGORY, frame_index=pa.uint8()),
    retyped(episode_id=pa.string_view(), frame_index=pa.float64()),
    retyped(state=pa.large_list(pa.float64()), action=pa.list_(pa.float32(), 8)),
]


@pytest.mark.parametrize("change", AS_OTHERS_WRITE)
def test_tables_of_other_programs(tmp_path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    write(tmp_path)
    path = tmp_path / "frames.parquet"
    pq.write_table(change(pq.read_table(path)), path)
    check_recording(read_one(tmp_path), FOUR, marked=False)


@pytest.mark.parametrize("kind", [pa.float16(), pa.float64(), pa.int8(), pa.decimal128(23, 2)])
@pytest.mark.parametrize("size", [1, 3])
def test_states_of_any_number_type(tmp_path: Path, kind: pa.DataType, size: int) -> None:
    write(tmp_path)
    path = tmp_path / "frames.parquet"
    values = np.arange(4 * size).reshape(4, size) - 5
    flat = pa.array(values.ravel()).cast(kind)
    column = flat if size == 1 else pa.FixedSizeListArray.from_arrays(flat, size)
    table = pq.read_table(path).drop_columns("state").append_column("state", column)
    pq.write_table(table, path)
    states = [frame.state for frame in read_one(tmp_path).frames]
    np.testing.assert_array_equal(states, values.astype(np.float32))


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"seed": [7.0] * 4}, {"seed": 7}),
        ({"seed": ["7"] * 4}, {"seed": 7}),
        ({"seed": [float("nan")] * 4}, {"seed": None}),
        ({"seed": [None] * 4, "difficulty": [None] * 4}, {"seed": None, "difficulty": None}),
        ({"difficulty": [""] * 4, "simulator": [""] * 4}, {"difficulty": None, "simulator": None}),
        ({"exact": [0] * 4}, {"exact": False}),
        ({"exact": ["False"] * 4}, {"exact": False}),
        ({"exact": [1.0] * 4}, {"exact": True}),
    ],
)
def test_values_as_other_programs_store_them(
    tmp_path: Path, values: dict[str, list[Any]], expected: dict[str, Any]
) -> None:
    write(tmp_path)
    for name, column in values.items():
        table = with_column(name, column)(pq.read_table(tmp_path / "frames.parquet"))
        pq.write_table(table, tmp_path / "frames.parquet")
    recording = read_one(tmp_path)
    assert {name: getattr(recording, name) for name in expected} == expected


@pytest.mark.parametrize(
    "flags",
    [
        [True, True, False, False],
        [1, 1, 0, 0],
        [1.0, 1.0, 0.0, 0.0],
        ["True", "true", "False", "FALSE"],
        ["1", "1", "0", "0"],
    ],
)
def test_marks_of_any_type(tmp_path: Path, flags: list[Any]) -> None:
    write(tmp_path, four(is_demo=flags))
    shown = [frame.is_demonstration for frame in read_one(tmp_path).frames]
    assert shown == [True, True, False, False]


@pytest.mark.parametrize(
    "change",
    [
        with_column("is_demo", ["yes", "no", "no", "no"]),
        with_column("is_demo", [1.0, float("nan"), 0.0, 0.0]),
        with_column("is_demo", [2, 1, 0, 0]),
        with_column("is_demo", [True, None, False, False]),
        with_column("seed", [7.5] * 4),
        with_column("seed", ["x"] * 4),
        with_column("exact", ["maybe"] * 4),
        with_column("difficulty", [0] * 4),
        with_column("__index_level_0__", [0, 1, 2, 3]),
        with_column("frame_index_2", [0, 1, 2, 3]),
    ],
)
def test_values_without_one_meaning(tmp_path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    write(tmp_path)
    path = tmp_path / "frames.parquet"
    pq.write_table(change(pq.read_table(path)), path)
    with raises(SourceError):
        read_one(tmp_path)


@pytest.mark.parametrize(
    "file",
    [
        f"videos/front/{DRAWER.rpartition('/')[0]}/._0.mkv",
        "videos/.ipynb_checkpoints/OpenDrawer/train/0.mkv",
        "images/front/.ipynb_checkpoints/train/0/000000.png",
        f"images/front/{DRAWER}/._000000.png",
        "._frames.parquet",
    ],
)
def test_hidden_files_are_no_recordings(tmp_path: Path, file: str) -> None:
    write(tmp_path)
    misplaced(file)(tmp_path)
    check_recording(read_one(tmp_path), FOUR, marked=False)


def empty(folder: Path) -> None:
    table = pq.read_table(folder / "frames.parquet").slice(0, 0)
    pq.write_table(table, folder / "frames.parquet")


def image(number: int) -> str:
    return f"images/front/{DRAWER}/00000{number}.png"


def misplaced(file: str) -> Callable[[Path], Any]:
    def write(folder: Path) -> None:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(b"")

    return write


HARMS: list[tuple[Callable[[Path], Any], str]] = [
    (lambda f: (f / "frames.parquet").unlink(), "no frames folder: frames.parquet is missing"),
    (lambda f: (f / "frames.parquet").write_bytes(b"id,goal"), "frames.parquet: cannot be read"),
    (empty, "has no rows"),
    (lambda f: replace_by_video(f, 3), "0.mkv holds 3 frames; frames.parquet has 4 rows"),
    (lambda f: (f / image(2)).unlink(), "0 lacks 000002.png; frames.parquet has 4 rows"),
    (misplaced(image(4)), "0 holds 000004.png"),
    (lambda f: (f / image(1)).write_bytes(encode_image(FRONT[1])[:-30]), "1.png: .*is damaged"),
    (
        # which would not be exact
        lambda f: (f / image(1)).write_bytes(encode_image(FRONT[1], "jpg")),
        "000001.png: a JPEG image",
    ),
    (
        lambda f: write_video(place(f, kind="videos"), FRONT),
        f"camera 'front' of {DRAWER} has two recordings: .*videos.* and .*images",
    ),
    (
        lambda f: shutil.rmtree(f / "images"),
        f"neither videos nor images(.|\n)*videos/CAMERA/{DRAWER}.mkv(.|\n)*`cameras` to none",
    ),
    (misplaced(f"videos/wrist/{DRAWER}.mkv"), "0.mkv: the file is empty"),
    (misplaced("videos/front/A/train/3.mkv"), "3.mkv belongs to A/train/3, which frames.parq"),
    (misplaced("images/front/A/train/1"), "train/1 is not an episode's image folder"),
]


@pytest.mark.parametrize(("harm", "message"), HARMS)
def test_broken_folders(tmp_path: Path, harm: Callable[[Path], Any], message: str) -> None:
    write(tmp_path)
    harm(tmp_path)
    assert re.search(message, refused(tmp_path))


def test_a_folder_without_images_holds_states(tmp_path: Path) -> None:
    write_table(tmp_path, four(fps=30))
    source = FramesSource(tmp_path)
    recording = source.read(source.episodes()[0], ())
    assert recording.robot == Robot(30)
    assert [frame.images for frame in recording.frames] == [{}] * 4


def test_cameras_that_differ(tmp_path: Path) -> None:
    write(tmp_path, four() + rows_of(MOVE, FOUR))
    write_images(place(tmp_path, MOVE), FRONT)
    write_images(place(tmp_path, MOVE, camera="wrist"), FRONT)
    source = FramesSource(tmp_path)
    drawer = next(episode for episode in source.episodes() if str(episode.id) == DRAWER)
    with raises(SourceError):
        source.read(drawer, None)
    assert len(list(source.read(drawer, ("front",)).frames)) == 4
