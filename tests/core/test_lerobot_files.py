"""The one reader of LeRobot datasets: both layouts, and what may be wrong with them."""

import json
import string
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.episodes import make_episode
from support.lerobot_layouts import (
    EPISODES,
    V21_NAMES,
    V30_NAMES,
    edit_columns,
    edit_info,
    write_lerobot,
)

from robomme_interference_data.errors import (
    FormatError,
    InterferenceError,
    MissingFileError,
    TruncatedVideoError,
    UnknownNameError,
)
from robomme_interference_data.files import LocalFiles
from robomme_interference_data.lerobot_files import LeRobotFiles
from robomme_interference_data.lerobot_layout import fill_template

VERSIONS = ("v3.0", "v2.1")
TABLE = "meta/episodes/chunk-000/file-000.parquet"


def opened(root: Path) -> LeRobotFiles:
    return LeRobotFiles(LocalFiles(root))


def read_all(root: Path) -> None:
    """Read everything there is, as the sources and datasets do."""
    lerobot = opened(root)
    assert lerobot.tasks
    for index in range(len(lerobot)):
        for name, feature in lerobot.features.items():
            if feature["dtype"] == "video":
                list(lerobot.iter_frames(index, name, 0, lerobot.place(index).length))
            elif feature["dtype"] == "float32":
                lerobot.vectors(index, name)


@pytest.fixture(params=VERSIONS)
def root(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A dataset of videos of either version."""
    return write_lerobot(tmp_path / "dataset", version=request.param, stored="video")


# --- what is read --------------------------------------------------------------------------------


def test_values_and_frames(root: Path) -> None:
    lerobot = opened(root)
    names = V21_NAMES if lerobot.version == "v2.1" else V30_NAMES
    assert (len(lerobot), lerobot.fps, lerobot.shape(names["front"])) == (3, 10.0, (16, 24, 3))
    assert lerobot.tasks == {episode.goal for episode in EPISODES}
    for index, episode in enumerate(EPISODES):
        np.testing.assert_array_equal(lerobot.vectors(index, names["state"]), episode.state)
        for camera, frames in episode.images.items():
            found = np.stack(list(lerobot.iter_frames(index, names[camera], 2, 6)))
            np.testing.assert_array_equal(found, frames[2:6])
            lerobot.read_frames(index, names[camera], 1, found)
            np.testing.assert_array_equal(found, frames[1:5])
    with pytest.raises(UnknownNameError, match="episode 3 is not in .* 3 episodes"):
        lerobot.row(3)
    with pytest.raises(TruncatedVideoError, match="7 stored frames; frames 4 to 7"):
        lerobot.iter_frames(2, names["front"], 4, 8)


def test_places(tmp_path: Path) -> None:
    v30 = opened(write_lerobot(tmp_path / "v30", stored="video"))
    place = v30.place(2)  # frame 21 of the common files is its first
    assert (place.length, place.data) == (7, "data/chunk-000/file-000.parquet")
    front = "videos/observation.images.front/chunk-000/file-000.mkv"
    assert place.videos["observation.images.front"] == (front, 21)
    v21 = opened(write_lerobot(tmp_path / "v21", version="v2.1", stored="video"))
    place = v21.place(2)
    assert place.data == "data/chunk-000/episode_000002.parquet"
    assert place.videos["image"] == ("videos/chunk-000/image/episode_000002.mkv", 0)


def test_columns_of_several_files_and_statistics_are_left_aside(tmp_path: Path) -> None:
    root = write_lerobot(tmp_path, [make_episode(0, 2)] * 4, stored=None)
    first = root / TABLE
    edit_columns(first, **{"stats/state/mean": [[0.0]] * 4})
    whole = pa.parquet.read_table(first)
    pa.parquet.write_table(whole.slice(2), first)
    pa.parquet.write_table(whole.slice(0, 2), first.with_name("file-001.parquet"))
    lerobot = opened(root)
    assert [row["episode_index"] for row in lerobot.all_rows()] == [0, 1, 2, 3]
    assert "stats/state/mean" not in lerobot.row(3)


def test_tasks_as_pandas_writes_an_index(tmp_path: Path) -> None:
    root = write_lerobot(tmp_path, stored=None)
    table = pa.table({"task_index": [0, 1], "__index_level_0__": ["one", "two"]})
    pa.parquet.write_table(table, root / "meta/tasks.parquet")
    assert opened(root).tasks == {"one", "two"}


# --- path templates ------------------------------------------------------------------------------

VALUES: dict[str, Any] = {"chunk_index": 3, "file_index": 12, "video_key": "a.b"}
FIELDS = ("{chunk_index:03d}", "{file_index:06d}", "{file_index}", "{video_key}")


@given(st.lists(st.sampled_from([*FIELDS, "data/", "-", ".mp4", "é", " "]), max_size=8))
def test_templates_are_filled_as_python_does(parts: list[str]) -> None:
    template = "".join(parts)
    assert fill_template(template, "here", **VALUES) == template.format(**VALUES)


@given(st.text(alphabet=string.ascii_lowercase + "{}_.!:[]0d", max_size=25))
def test_any_template_is_filled_or_one_clear_error(template: str) -> None:
    try:
        filled = fill_template(template, "here", d="x", a=7)
    except FormatError as error:
        assert "path template" in error.message
    else:
        assert "{" not in filled
        assert len(filled) <= len(template) + 9


TEMPLATES = (
    "{video_key.__class__}/{file_index}",
    "{file_index!r}",
    "{file_index:999999999d}",
    "{file_index[0]}",
    "data/{chunk_index:03d/file.parquet",
    "data/file}.parquet",
    "data/{{file_index}}",
    "{video_key:03d}",
    "{nothing}",
    "{}",
)


@pytest.mark.parametrize("template", TEMPLATES)
def test_other_templates_are_refused(tmp_path: Path, template: str) -> None:
    root = write_lerobot(tmp_path, stored=None)
    edit_info(root, data_path=template)
    with pytest.raises(FormatError, match="path template .* cannot be filled in"):
        opened(root).place(0)


# --- paths that leave the dataset ----------------------------------------------------------------


@pytest.mark.parametrize("path", ["../../etc/passwd", "/etc/passwd", "videos/../../outside.mkv"])
@pytest.mark.parametrize("which", ["data_path", "video_path"])
def test_no_path_leads_out(root: Path, which: str, path: str) -> None:
    (root.parent / "outside.mkv").write_bytes(b"secret")
    edit_info(root, **{which: path})
    with pytest.raises(FormatError, match="leads out of it"):
        read_all(root)


def test_no_link_leads_out(root: Path) -> None:
    data = next(root.glob("data/*/*.parquet"))
    outside = data.replace(root.parent / "outside.parquet")
    data.symlink_to(outside)
    with pytest.raises(FormatError, match="is a link that leads out of the folder"):
        read_all(root)


def test_links_inside_are_followed(root: Path) -> None:
    for path in [*root.rglob("*.parquet"), *root.rglob("*.mkv")]:
        target = path.replace(path.with_name(f"stored-{path.name}.bin"))
        path.symlink_to(target.name)
    read_all(root)


def test_links_into_the_hubs_cache_are_followed(root: Path, tmp_path: Path) -> None:
    blobs = tmp_path / "datasets--a--b/blobs"
    snapshot = tmp_path / "datasets--a--b/snapshots/commit"
    blobs.mkdir(parents=True)
    for number, path in enumerate(p for p in sorted(root.rglob("*")) if p.is_file()):
        link = snapshot / path.relative_to(root)
        link.parent.mkdir(parents=True, exist_ok=True)
        path.replace(blobs / str(number))
        link.symlink_to(blobs / str(number))
    read_all(snapshot)


def test_a_link_that_goes_round_is_missing(root: Path) -> None:
    data = next(root.glob("data/*/*.parquet"))
    data.unlink()
    data.symlink_to(data.name)
    with pytest.raises(MissingFileError, match="is missing"):
        read_all(root)


# --- damage --------------------------------------------------------------------------------------


def test_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"is no LeRobot dataset: meta/info\.json"):
        opened(tmp_path)


@pytest.mark.parametrize("version", ["v2.0", "v3.1", None, ["v3.0"]])
def test_other_versions(root: Path, version: Any) -> None:
    edit_info(root, codebase_version=version)
    with pytest.raises(FormatError, match=r"version .*reads v3\.0 and v2\.1"):
        opened(root)


def feature(**values: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda info: next(iter(info["features"].values())).update(values)


INFO: list[Callable[[dict[str, Any]], Any]] = [
    lambda info: info.update(features=None),
    lambda info: info.update(features={}),
    lambda info: info.update(features={"state": "float32"}),
    lambda info: info.update(fps="10"),
    lambda info: info.update(fps=0),
    lambda info: info.update(fps=float("nan")),
    lambda info: info.pop("fps"),
    lambda info: info.update(total_episodes="3"),
    lambda info: info.update(total_episodes=-1),
    lambda info: info.update(total_episodes=2),
    lambda info: info.update(total_episodes=4),
    lambda info: info.update(total_episodes=10**12),
    lambda info: info.update(chunks_size="many"),
    lambda info: info.update(chunks_size=0),
    lambda info: info.update(data_path=None),
    lambda info: info.update(video_path=7),
    feature(dtype=None),
    feature(shape=None),
    feature(shape=[100_000, 100_000, 3]),
    feature(shape=[-16, 24, 3]),
    feature(shape=["16", 24, 3]),
    feature(shape=[32, 24, 3]),
    feature(info="ffv1"),
]


@pytest.mark.parametrize("change", INFO)
def test_info_that_is_wrong(root: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    edit_info(root, change)
    with pytest.raises(FormatError) as caught:
        read_all(root)
    assert str(root) in caught.value.message


@pytest.mark.parametrize("text", ["", "[", "[]", '{"fps": 1', "[" * 100_000, "\ud800"])
def test_info_that_is_no_json_object(root: Path, text: str) -> None:
    (root / "meta/info.json").write_text(text, errors="surrogatepass")
    with pytest.raises(FormatError, match=r"info\.json: no"):
        opened(root)


LINE = {"episode_index": 0, "length": 12, "tasks": ["x"]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{\n", "line 1: "),
        ("[0, 1]\n", "line 1: no JSON object"),
        (json.dumps(LINE) + "\n" + "[" * 100_000, "line 2: "),
        (json.dumps(LINE) + "\n", "the episodes 0 to 2, each once"),
        ((json.dumps(LINE) + "\n") * 3, "the episodes 0 to 2, each once"),
        ("", "no whole numbers 'episode_index'"),
        ('{"episode_index": 0}\n', "no whole numbers 'length'"),
        ('{"episode_index": "0", "length": 1}\n', "no whole numbers 'episode_index'"),
        ('{"episode_index": 0, "length": 1}\n{"episode_index": 1}\n{}', "no whole numbers"),
        (json.dumps(LINE | {"length": 10**30}), "cannot be read"),
        (json.dumps(LINE | {"tasks": ["\ud800"]}), "cannot be read"),
        (json.dumps(LINE) + "\n" + json.dumps(LINE | {"tasks": 7}), "cannot be read"),
    ],
)
def test_lines_that_are_wrong(tmp_path: Path, text: str, message: str) -> None:
    root = write_lerobot(tmp_path, version="v2.1", stored=None)
    (root / "meta/episodes.jsonl").write_text(text)
    with pytest.raises(FormatError, match=message):
        opened(root).all_rows()


VIDEO = "videos/observation.images.front/"


@pytest.mark.parametrize(
    "columns",
    [
        {"length": None},
        {"length": [12, None, 7]},
        {"length": [12, 10**12, 7]},
        {"length": [12, -1, 7]},
        {"length": [12, 8, 7]},
        {"length": pa.array([12.0, 9.0, 7.0])},
        {"episode_index": [0, 1, 1]},
        {"data/chunk_index": None},
        {"data/file_index": [0, -1, 0]},
        {"data/file_index": pa.array(["0", "0", "0"])},
        {VIDEO + "from_timestamp": [0.0, float("nan"), 2.1]},
        {VIDEO + "from_timestamp": [0.0, -1.0, 2.1]},
        {VIDEO + "from_timestamp": [0.0, 1.25, 2.1]},
        {VIDEO + "from_timestamp": [0.0, 1e8, 2.1]},
        {VIDEO + "chunk_index": [0, 0, None]},
    ],
)
def test_episode_tables_that_are_wrong(tmp_path: Path, columns: dict[str, Any]) -> None:
    root = write_lerobot(tmp_path, stored="video")
    edit_columns(root / TABLE, **columns)
    with pytest.raises((FormatError, TruncatedVideoError)):
        read_all(root)


def test_a_missing_table(tmp_path: Path) -> None:
    root = write_lerobot(tmp_path, stored=None)
    (root / TABLE).unlink()
    with pytest.raises(MissingFileError, match="meta/episodes holds no parquet file"):
        opened(root).all_rows()


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"episode_index": [0] * 13 + [1] * 8 + [2] * 7}, "13 rows of episode 0; 12"),
        ({"episode_index": [0, 1] * 14}, "14 rows of episode 0; 12"),
        ({"frame_index": [0, 2, 1, *range(3, 12), *range(9), *range(7)]}, "one after the other"),
        ({"episode_index": None}, "no column 'episode_index'"),
        ({"observation.state": pa.array([[0.0]] * 28)}, "1 values a frame; info.json"),
        ({"observation.state": pa.array([["x"]] * 28)}, "expected lists of floats"),
    ],
)
def test_rows_that_are_wrong(tmp_path: Path, columns: dict[str, Any], message: str) -> None:
    root = write_lerobot(tmp_path, stored="video", rows_a_group=10)
    edit_columns(root / "data/chunk-000/file-000.parquet", **columns)
    with pytest.raises((FormatError, TruncatedVideoError), match=message):
        read_all(root)


@pytest.mark.parametrize("name", ["meta/info.json", TABLE, "data/chunk-000/file-000.parquet"])
def test_any_flipped_bit_is_one_clear_error_or_none(tmp_path: Path, name: str) -> None:
    root = write_lerobot(tmp_path, stored="video")
    path = root / name
    data = path.read_bytes()
    for number, place in enumerate(np.linspace(0, len(data) - 1, 32, dtype=int).tolist()):
        flipped = bytearray(data)
        flipped[place] ^= 1 << number % 8
        path.write_bytes(flipped)
        try:
            read_all(root)
        except InterferenceError as error:
            assert "\n" not in error.message
