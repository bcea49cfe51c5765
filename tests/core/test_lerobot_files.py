"""The one reader of LeRobot datasets: all layouts, and what may be wrong with them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.lerobot_layouts import DATA, NAMES, TABLE, edit_columns, edit_info, write_lerobot
from support.messages import raises
from support.recordings import EPISODES, MOVE, PEG

from robomme_interference_data.errors import FormatError, MissingFileError, UnknownNameError
from robomme_interference_data.storage.files import LocalFiles
from robomme_interference_data.storage.lerobot.dataset import LeRobotFiles
from robomme_interference_data.storage.lerobot.location import VideoLocation, fill_template

VIDEO = "videos/observation.images.front/"
V2 = "chunk-000/episode_000002"
V2_LOCATION = (9, f"data/{V2}.parquet", (f"videos/image/{V2}.mkv", 0))
LOCATIONS = {  # of the third episode, which begins with frame 19 of the common files of v3.0
    "v3.0": (9, DATA, (VIDEO + "chunk-000/file-000.mkv", 19)),
    "v2.1": V2_LOCATION,
    "v2.0": V2_LOCATION,
}


def opened(root: Path) -> LeRobotFiles:
    return LeRobotFiles(LocalFiles(root))


def read_all(root: Path) -> None:
    """Read everything, as sources and datasets do."""
    lerobot = opened(root)
    assert lerobot.task_texts
    for index in range(len(lerobot)):
        for name, feature in lerobot.features.items():
            if feature["dtype"] == "video":
                list(lerobot.iter_frames(index, name, 0, lerobot.locate(index).length))
            elif feature["dtype"] == "float32":
                lerobot.vectors(index, name)


@pytest.fixture(params=["v3.0", "v2.1", "v2.0"])
def root(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A dataset of videos of each version."""
    return write_lerobot(tmp_path / "dataset", version=request.param, stored="video")


@pytest.fixture
def v30(tmp_path: Path) -> Path:
    return write_lerobot(tmp_path / "dataset", stored="video", rows_a_group=10)


# --- what is read --------------------------------------------------------------------------------


def test_values_frames_and_locations(root: Path) -> None:
    lerobot = opened(root)
    front = NAMES[str(lerobot.version)]["front"]
    assert (len(lerobot), lerobot.fps, lerobot.shape(front)) == (3, 10.0, (16, 24, 3))
    assert set(lerobot.task_texts.values()) == {episode.goal for episode in EPISODES.values()}
    for index, episode in enumerate(EPISODES.values()):
        frames = episode.images["front"]
        found = np.stack(list(lerobot.iter_frames(index, front, 2, 6)))
        np.testing.assert_array_equal(found, frames[2:6])
    location = lerobot.locate(2)
    expected = LOCATIONS[str(lerobot.version)]
    assert (location.length, location.data) == expected[:2]
    assert lerobot.locate_video(2, front) == VideoLocation(*expected[2])
    with raises(UnknownNameError):
        lerobot.row(3)
    with raises(FormatError):
        lerobot.iter_frames(1, front, 4, 8)


def test_several_files_statistics_and_tasks_as_pandas_writes_them(v30: Path) -> None:
    edit_columns(v30 / TABLE, **{"stats/state/mean": [[0.0]] * 3})
    whole = pq.read_table(v30 / TABLE)
    pq.write_table(whole.slice(0, 1), v30 / TABLE)
    pq.write_table(whole.slice(1), (v30 / TABLE).with_name("file-001.parquet"))
    tasks = pa.table({"task_index": [0, 1], "__index_level_0__": ["one", "two"]})
    pq.write_table(tasks, v30 / "meta/tasks.parquet")
    lerobot = opened(v30)
    assert lerobot.table["episode_index"].to_pylist() == [0, 1, 2]
    assert "stats/state/mean" not in lerobot.row(2)  # statistics are never read
    assert set(lerobot.task_texts.values()) == {"one", "two"}


def _retype(name: str, kind: pa.DataType) -> Callable[[pa.Table], pa.Table]:
    """Return a change of a column's type."""

    def change(table: pa.Table) -> pa.Table:
        place = table.column_names.index(name)
        return table.set_column(place, name, table[name].cast(kind))

    return change


@pytest.mark.parametrize(
    "change",
    [
        lambda table: table.select(table.column_names[::-1]),
        lambda table: table.cast(pa.schema([f.with_nullable(False) for f in table.schema])),
        lambda table: table.append_column("operator", pa.array(["x"] * len(table))),
        _retype("length", pa.int16()),
        _retype("length", pa.float64()),
        _retype("data/file_index", pa.uint32()),
        _retype("episode_id", pa.large_string()),
        _retype("episode_id", pa.dictionary(pa.int8(), pa.string())),
        _retype("tasks", pa.large_list(pa.large_string())),
        _retype("tasks", pa.list_(pa.string(), 1)),
        _retype(VIDEO + "from_timestamp", pa.float32()),
    ],
)
def test_episode_tables_that_differ(v30: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """As merged datasets have them; the types of one table are those of another program."""
    expected = opened(v30)
    whole = pq.read_table(v30 / TABLE)
    pq.write_table(whole.slice(0, 1), v30 / TABLE)
    pq.write_table(change(whole.slice(1)), (v30 / TABLE).with_name("file-001.parquet"))
    found = opened(v30)
    for index in range(3):
        assert found.row(index).items() >= expected.row(index).items()
        assert found.locate(index) == expected.locate(index)


def test_a_column_that_only_one_table_has(v30: Path) -> None:
    whole = pq.read_table(v30 / TABLE)
    pq.write_table(whole.slice(0, 2), v30 / TABLE)
    other = (v30 / TABLE).with_name("file-001.parquet")
    pq.write_table(whole.slice(2).drop_columns("episode_id"), other)
    ids = [row["episode_id"] for row in opened(v30).table.to_pylist()]
    assert ids == ["MoveCube/train/0", "MoveCube/train/1", None]


def test_a_column_that_is_text_in_one_table_and_a_number_in_another(v30: Path) -> None:
    whole = pq.read_table(v30 / TABLE)
    pq.write_table(whole.slice(0, 1).append_column("seed", pa.array(["x"])), v30 / TABLE)
    other = (v30 / TABLE).with_name("file-001.parquet")
    pq.write_table(whole.slice(1).append_column("seed", pa.array([1, 2])), other)
    with raises(FormatError):
        _ = opened(v30).table


@pytest.mark.parametrize("folder", [".ipynb_checkpoints/", ""])
def test_hidden_files_are_no_tables(v30: Path, folder: str) -> None:
    """macOS, editors and interrupted downloads leave them beside the tables."""
    hidden = v30 / "meta/episodes/chunk-000" / folder / "._file-000.parquet"
    hidden.parent.mkdir(exist_ok=True)
    hidden.write_bytes(b"Mac OS X")
    assert opened(v30).table["length"].to_pylist() == [12, 7, 9]


@pytest.mark.parametrize(
    "tasks",
    [
        {"task_index": [1, 0], "task": ["b", "a"]},
        {"task_index": [0, 2], "task": ["a", "b"]},
        {"task_index": [0, 0], "task": ["a", "b"]},
        {"task_index": [0, None], "task": ["a", "b"]},
        {"task_index": [0, 1], "task": ["a", None]},
        {"task_index": [0, 1], "text": ["a", "b"]},
    ],
)
def test_tasks_that_are_not_clear(v30: Path, tasks: dict[str, Any]) -> None:
    pq.write_table(pa.table(tasks), v30 / "meta/tasks.parquet")
    with raises(FormatError):
        _ = opened(v30).task_texts


def test_tasks_of_the_frames(root: Path) -> None:
    lerobot = opened(root)
    assert [lerobot.tasks_of(index) for index in range(3)] == [(MOVE,), (MOVE,), (PEG,)]


def test_several_tasks_of_frames_come_in_their_order(v30: Path) -> None:
    edit_columns(v30 / DATA, task_index=[1] * 5 + [0] * 7 + [0] * 7 + [1] * 9)
    assert opened(v30).tasks_of(0) == (PEG, MOVE)
    edit_columns(v30 / DATA, task_index=[2] * 12 + [0] * 16)
    with raises(FormatError):
        opened(v30).tasks_of(0)
    edit_columns(v30 / DATA, task_index=None)
    assert opened(v30).tasks_of(0) == ()


def test_episodes_out_of_order(v30: Path) -> None:
    """LeRobot finds an episode by its place in all files."""
    whole = pq.read_table(v30 / TABLE)
    pq.write_table(whole.slice(1), v30 / TABLE)
    pq.write_table(whole.slice(0, 1), (v30 / TABLE).with_name("file-001.parquet"))
    with raises(FormatError):
        _ = opened(v30).table


# --- paths ---------------------------------------------------------------------------------------

VALUES: dict[str, Any] = {"chunk_index": 3, "file_index": 12, "video_key": "a.b"}
PARTS = ("{chunk_index:03d}", "{file_index:06d}", "{file_index}", "{video_key}", "data/", ".mp4é ")


@given(st.lists(st.sampled_from(PARTS), max_size=8))
def test_templates_are_filled_as_python_does(parts: list[str]) -> None:
    template = "".join(parts)
    assert fill_template(template, "here", **VALUES) == template.format(**VALUES)


@given(st.text(alphabet="abdz{}_.!:[]0", max_size=25))
def test_any_template_is_filled_or_one_clear_error(template: str) -> None:
    try:
        assert "{" not in fill_template(template, "here", d="x", a=7)
    except FormatError as error:
        assert "path template" in error.message


@pytest.mark.parametrize(
    "path",
    [
        "{video_key.__class__}/{file_index}",
        "{file_index:999999999d}",
        "data/{chunk_index:03d/file.parquet",
        "{nothing}",
        "videos/../../outside.mkv",
        "{file_index}" * 500,
        "linked.mkv",
    ],
)
@pytest.mark.parametrize("which", ["data_path", "video_path"])
def test_invalid_paths(root: Path, which: str, path: str) -> None:
    outside = root.parent / "outside.mkv"
    outside.write_bytes(b"secret")
    (root / "linked.mkv").symlink_to(outside)
    edit_info(root, **{which: path})
    with raises(FormatError):
        read_all(root)


# --- damage --------------------------------------------------------------------------------------


INFO = {
    "codebase_version": ("v1.6", ["v3.0"]),
    "features": (None, {"state": "float32"}),
    "fps": ("10", float("nan"), None, 1e-300, 1e300),
    "total_episodes": ("3", -1, 2, 10**12),
    "chunks_size": (0, 10**30),
    "data_path": (None, "{file_index}" * 500),
    "video_path": (7, "{video_key}" * 500),
}
FEATURE = {
    "dtype": (None,),
    "shape": (
        None,
        [10**4000] * 1000,
        [1] * 10**6,
        [100_000, 100_000, 3],
        [-16, 24, 3],
        [32, 24, 1],
    ),
    "info": ("ffv1",),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of_feature", "name", "value"),
    [
        (known is FEATURE, name, value)
        for known in (INFO, FEATURE)
        for name, values in known.items()
        for value in values
    ],
)
def test_info_that_is_wrong(root: Path, of_feature: bool, name: str, value: Any) -> None:
    def change(info: dict[str, Any]) -> None:
        (next(iter(info["features"].values())) if of_feature else info)[name] = value

    edit_info(root, change)
    with pytest.raises(FormatError) as caught:
        read_all(root)
    assert str(root) in caught.value.message


LINE: dict[str, Any] = {"episode_index": 0, "length": 12, "tasks": ["x"]}
GOOD = json.dumps(LINE) + "\n"


@pytest.mark.parametrize(
    "text",
    [
        "[0, 1]\n",
        GOOD + "[" * 100_000,
        GOOD * 3,
        "",
        GOOD + '{"episode_index": 1}\n',
        json.dumps(LINE | {"length": 10**30}),
        GOOD + json.dumps(LINE | {"tasks": 7}),
    ],
)
def test_lines_that_are_wrong(tmp_path: Path, text: str) -> None:
    root = write_lerobot(tmp_path, version="v2.1", stored=None)
    (root / "meta/episodes.jsonl").write_text(text)
    with raises(FormatError):
        _ = opened(root).table


def test_nan_in_json_is_no_value(tmp_path: Path) -> None:
    """Python and pandas write it for missing values."""
    root = write_lerobot(tmp_path, version="v2.1", stored=None, seed=[1, float("nan"), 2])
    assert "NaN" in (root / "meta/episodes.jsonl").read_text()
    edit_info(root, quality=float("nan"))
    lerobot = opened(root)
    assert [lerobot.row(index)["seed"] for index in range(3)] == [1, None, 2]
    assert lerobot.info["quality"] is None


@pytest.mark.parametrize(
    "columns",
    [
        {"length": None},
        {"length": [12, None, 9]},
        {"length": [12, 8, 9]},
        {"length": pa.array([12.0, 7.5, 9.0])},
        {"episode_index": [0, 1, 1]},
        {"data/chunk_index": None},
        {"data/file_index": [0, -1, 0]},
        {VIDEO + "from_timestamp": [0.0, float("nan"), 1.9]},
        {VIDEO + "from_timestamp": [0.0, 1.25, 1.9]},  # between two frames
        {VIDEO + "from_timestamp": [0.0, 2.5, 1.9]},  # ends after the file does
        {VIDEO + "chunk_index": [0, 0, None]},
    ],
)
def test_episode_tables_that_are_wrong(v30: Path, columns: dict[str, Any]) -> None:
    edit_columns(v30 / TABLE, **columns)
    with pytest.raises(FormatError):
        read_all(v30)


@pytest.mark.parametrize(
    "columns",
    [
        {"episode_index": [0] * 13 + [1] * 6 + [2] * 9},
        {"frame_index": [0, 2, 1, *range(3, 12), *range(7), *range(9)]},
        {"episode_index": None},
        {"observation.state": pa.array([[0.0]] * 28)},
        {"observation.state": pa.array([["x"]] * 28)},
    ],
)
def test_rows_that_are_wrong(v30: Path, columns: dict[str, Any]) -> None:
    edit_columns(v30 / DATA, **columns)
    with raises(FormatError):
        read_all(v30)


def test_files_that_are_missing(v30: Path) -> None:
    (v30 / TABLE).unlink()
    with raises(MissingFileError):
        read_all(v30)
    (v30 / "meta/info.json").unlink()
    with raises(MissingFileError):
        opened(v30)
