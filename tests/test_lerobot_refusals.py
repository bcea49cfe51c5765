"""Whether LeRobot datasets that do not fit are refused, and where marks come from."""

import json
import os
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot_factory import (
    MOVE,
    SMALL,
    SMALL_IDS,
    change_column,
    change_info,
    recording,
    write_lines,
    write_small_families,
    write_v21,
)

from robomme_interference_data.build_dataset.sources.lerobot import LeRobotSource
from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingFileError,
    SourceError,
    UnknownNameError,
)


@pytest.fixture
def families(tmp_path: Path) -> Path:
    return write_small_families(tmp_path)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A v2.1 dataset."""
    write_v21(tmp_path / "dataset", SMALL)
    return tmp_path / "dataset"


# --- where things are ------------------------------------------------------------------------


def test_key_tells_when_a_file_changes(root: Path, families: Path) -> None:
    source = LeRobotSource(str(root), families_file=families)
    before = source.episodes()[0].key
    assert LeRobotSource(str(root), families_file=families).episodes()[0].key == before
    os.utime(root / "data/chunk-000/episode_000000.parquet", (0, 0))
    assert LeRobotSource(str(root), families_file=families).episodes()[0].key != before


def test_a_part_of_a_dataset_can_be_used(root: Path, families: Path) -> None:
    (root / "data/chunk-000/episode_000001.parquet").unlink()
    source = LeRobotSource(str(root), families_file=families)
    episodes = source.episodes()
    assert len(list(source.read(episodes[1]))) == len(SMALL[2])
    with pytest.raises(SourceError, match="InsertPeg/train/0: data/chunk-000/episode_000001"):
        next(source.read(episodes[2]))


@pytest.mark.parametrize(
    ("location", "options", "message"),
    [
        ("no/such/folder", {}, "neither a folder nor a dataset repository"),
        ("nowhere", {}, "neither a folder nor a dataset repository"),
        (".", {"split": "trian"}, "'trian' is not a split"),
        (".", {"revision": "main"}, "only a repository on the Hub has revisions"),
    ],
)
def test_wrong_options(location: str, options: dict, message: str) -> None:
    with pytest.raises(InvalidOptionError, match=message):
        LeRobotSource(location, **options)


def test_folder_without_a_dataset(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"is no LeRobot dataset: meta/info.json is missing"):
        LeRobotSource(str(tmp_path)).episodes()


@pytest.mark.parametrize("version", ["v2.0", "v3.1", "v1.6", None])
def test_other_versions_are_refused_by_name(root: Path, version: str | None) -> None:
    change_info(root, codebase_version=version)
    with pytest.raises(SourceError, match=f"version {version!r}; this package reads v3.0 and v2.1"):
        LeRobotSource(str(root)).episodes()


def test_dataset_without_families_is_refused(root: Path) -> None:
    with pytest.raises(SourceError, match=r"of what family its 3 episodes(.|\n)*--families-file"):
        LeRobotSource(str(root)).episodes()


# --- columns -----------------------------------------------------------------------------------


def test_columns_by_other_names(root: Path, families: Path) -> None:
    features = json.loads((root / "meta/info.json").read_text())["features"]
    new = {"image": "top", "actions": "joints", "is_demo": "shown", "exec_start_idx": "begin"}
    change_info(root, features={new.get(name, name): value for name, value in features.items()})
    for path in root.glob("data/*/*.parquet"):
        table = pq.read_table(path)
        pq.write_table(table.rename_columns([new.get(n, n) for n in table.column_names]), path)
    stats = (root / "meta/episodes_stats.jsonl").read_text()
    (root / "meta/episodes_stats.jsonl").write_text(stats.replace("exec_start_idx", "begin"))
    with pytest.raises(SourceError) as caught:
        LeRobotSource(str(root), families_file=families).episodes()
    assert "no column named observation.images.front or image" in str(caught.value)
    assert "begin, joints, shown, state, top, wrist_image" in str(caught.value)
    assert "--columns front=COLUMN" in str(caught.value)
    columns = {"front": "top", "action": "joints", "is_demo": "shown", "exec_start_idx": "begin"}
    source = LeRobotSource(str(root), columns=columns, families_file=families)
    episodes = source.episodes()
    assert [str(episode.id) for episode in episodes] == SMALL_IDS
    assert [episode.demonstration_length for episode in episodes] == [5, 0, 9]
    frame = next(source.read(episodes[2]))
    assert (frame.images["front"] == SMALL[1].images["front"][0]).all()
    assert (frame.action == SMALL[1].action[0]).all()


@pytest.mark.parametrize(
    ("columns", "error", "message"),
    [
        ({"fornt": "image"}, InvalidOptionError, "'fornt' is none of(.|\n)*Did you mean 'front'"),
        ({"front": "imge"}, UnknownNameError, "no column 'imge'(.|\n)*Did you mean 'image'"),
        ({"front": "state"}, SourceError, "'state' holds float32; 'front' needs one of video"),
        ({"state": "image"}, SourceError, "'image' holds image; 'state' needs one of float32"),
    ],
)
def test_wrong_columns(root: Path, columns: dict, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        LeRobotSource(str(root), columns=columns).episodes()


def test_depth_is_no_camera(root: Path) -> None:
    features = json.loads((root / "meta/info.json").read_text())["features"]
    features["image"]["shape"] = [48, 64, 1]
    change_info(root, features=features)
    with pytest.raises(SourceError, match="'image' has the shape"):
        LeRobotSource(str(root)).episodes()


# --- where demonstrations end ------------------------------------------------------------------


def marks(root: Path, **columns: list) -> LeRobotSource:
    """A dataset of one episode of four frames with other marks."""
    write_v21(root / "d", [recording(1, 4, MOVE, 2)], stats=False)
    path = root / "d/data/chunk-000/episode_000000.parquet"
    table = pq.read_table(path)
    for name, values in columns.items():
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    pq.write_table(table, path)
    (root / "f.csv").write_text("episode_index,family\n0,MoveCube\n")
    return LeRobotSource(str(root / "d"), families_file=root / "f.csv")


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"is_demo": [True, False, True, False]}, "true in 2 frames, not all of them at the"),
        ({"is_demo": [False, False, True, True]}, "true in 2 frames, not all of them at the"),
        ({"exec_start_idx": [2, 2, 3, 2]}, "'exec_start_idx' holds 2, 3; expected one number"),
        ({"exec_start_idx": [5] * 4}, "holds 5; expected one number from 0 to 4"),
        ({"exec_start_idx": [3] * 4}, "not clear: 2 by is_demo and 3 by exec_start_idx"),
        ({"exec_start_idx": [2, None, 2, 2]}, "1 empty values"),
        ({"is_demo": ["yes"] * 4}, "column 'is_demo' is of type string"),
    ],
)
def test_marks_that_are_wrong(tmp_path: Path, columns: dict, message: str) -> None:
    with pytest.raises(SourceError, match=message) as caught:
        marks(tmp_path, **columns).episodes()
    assert "episode 0" in str(caught.value) or "episode_000000" in str(caught.value)


def test_plain_columns_mark_as_lists_do(tmp_path: Path) -> None:
    source = marks(tmp_path, is_demo=[True, True, True, False], exec_start_idx=[3] * 4)
    assert source.episodes()[0].demonstration_length == 3


def test_statistics_that_lie_are_found_when_read(tmp_path: Path, families: Path) -> None:
    write_v21(tmp_path / "d", SMALL)
    stats = [
        {"episode_index": index, "stats": {"exec_start_idx": {"min": [4], "max": [4]}}}
        for index in range(3)
    ]
    write_lines(tmp_path / "d/meta/episodes_stats.jsonl", stats)
    source = LeRobotSource(str(tmp_path / "d"), families_file=families)
    episode = source.episodes()[0]
    assert episode.demonstration_length == 4
    with pytest.raises(SourceError, match="5 by is_demo and 5 by exec_start_idx and 4 by meta/"):
        next(source.read(episode))


# --- damage ------------------------------------------------------------------------------------


def test_rows_that_are_missing(root: Path, families: Path) -> None:
    path = root / "data/chunk-000/episode_000000.parquet"
    table = pq.read_table(path)
    pq.write_table(table.slice(0, 10), path)
    source = LeRobotSource(str(root), families_file=families)
    with pytest.raises(SourceError, match=r"episode 0: .*holds 10 rows of it; 12, one after"):
        source.episodes()  # the first episode is looked at for the format of its images
    pq.write_table(table.take([0, 2, 1, *range(3, 12)]), path)
    with pytest.raises(SourceError, match="its frame_index does not count from 0 to 11"):
        source.episodes()


def test_damaged_image(root: Path, families: Path) -> None:
    path = root / "data/chunk-000/episode_000001.parquet"
    cells = pq.read_table(path)["image"].to_pylist()
    cells[4]["bytes"] = cells[4]["bytes"][:60]
    change_column(path, "image", cells)
    source = LeRobotSource(str(root), families_file=families)
    frames = source.read(source.episodes()[2])
    for _ in range(4):
        next(frames)
    with pytest.raises(SourceError, match="InsertPeg/train/0: an image is damaged"):
        next(frames)


def test_image_of_another_size(tmp_path: Path) -> None:
    odd = recording(1, 4, MOVE)
    odd.images["front"] = odd.images["front"][:, :40]
    write_v21(tmp_path / "d", [odd])
    (tmp_path / "f.csv").write_text("episode_index,family\n0,MoveCube\n")
    source = LeRobotSource(str(tmp_path / "d"), families_file=tmp_path / "f.csv")
    with pytest.raises(SourceError, match="frame 0 of camera 'front' is 64×40 pixels; info"):
        list(source.read(source.episodes()[0]))


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("meta/episodes.jsonl", '{"episode_index": 0}\n', "(KeyError: 'length')"),
        ("meta/episodes.jsonl", "{\n", "episodes.jsonl, line 1 is not JSON"),
        (
            "meta/episodes.jsonl",
            f'{{"episode_index": 0, "length": 12, "tasks": ["{MOVE}"]}}\n',
            "lists 1 episodes; info.json says 3",
        ),
        (
            "meta/episodes.jsonl",
            f'{{"episode_index": 0, "length": 12, "tasks": ["{MOVE}"]}}\n' * 3,
            "lists episode 0 twice",
        ),
        ("meta/tasks.jsonl", f'{{"task_index": 0, "task": "{MOVE}"}}\n', "tasks.jsonl does not"),
        ("meta/info.json", "[", "is not JSON"),
        ("meta/info.json", '{"codebase_version": "v2.1"}', "has no valid 'features'"),
        (
            "meta/info.json",
            '{"codebase_version": "v2.1", "features": {}, "fps": 0}',
            "has no valid 'fps'",
        ),
        ("meta/episodes.jsonl", "[0, 1]\n", "episodes is not as LeRobot v2.1 writes it"),
    ],
)
def test_damaged_metadata(root: Path, file: str, text: str, message: str) -> None:
    (root / file).write_text(text)
    with pytest.raises(ValueError) as caught:
        LeRobotSource(str(root)).episodes()
    assert message in str(caught.value)
