"""Buffer sets: list, filter and load; missing, damaged or mistyped parts raise one error."""

import json
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.buffer_sets import CONDITIONS, GOLDEN, QUERIES, UNITS
from support.damage import HEADER, ROWS, edit, renew_header
from support.lerobot_layouts import edit_columns, edit_info
from support.messages import raises

from robomme_interference_data import (
    DecodedCache,
    EpisodeId,
    InterferenceError,
    load_buffer,
    load_buffer_set,
)
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InvalidIdError,
    InvalidOptionError,
    MissingExtraError,
    MissingFileError,
    UnknownNameError,
)
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.storage.encode import CODECS, VideoEncoder


def test_manifests_as_a_data_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    buffer_set = load_buffer_set(GOLDEN)
    frame = buffer_set.to_pandas()
    assert frame.to_dict("records")[0]["sessions"].tolist() == []  # no-history
    listed = [to_dict(one) for one in buffer_set.manifests()]
    for name in ("episode_id", "family", "condition", "k", "lesson_share", "exact"):
        assert frame[name].tolist() == [one[name] for one in listed]
    sessions = frame["sessions"].iloc[-1].tolist()
    assert sessions == listed[-1]["sessions"] and len(sessions) == 8
    some = buffer_set.to_pandas(family="MoveCube", condition=["k3", "k7"])
    assert (some["family"] + some["condition"]).tolist() == ["MoveCubek3", "MoveCubek7"]
    with pytest.raises(UnknownNameError):
        buffer_set.to_pandas(k=5)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError) as raised:
        buffer_set.to_pandas()
    assert raised.value.hint == "Install it: pip install pandas"


def test_what_a_buffer_set_lists() -> None:
    buffer_set = load_buffer_set(GOLDEN)
    assert tuple(map(str, buffer_set.episode_ids)) == QUERIES
    assert buffer_set.families == ("VideoRepick", "MoveCube", "PatternLock")
    assert buffer_set.conditions == CONDITIONS
    assert buffer_set.cameras == ("front", "wrist")
    assert (len(buffer_set), buffer_set.name) == (15, "buffer_set")
    assert [str(manifest) for manifest in buffer_set.manifests()] == [
        f"{episode} under {condition}" for episode in QUERIES for condition in CONDITIONS
    ]
    assert repr(buffer_set) == f"BufferSet(buffer_set, buffers=15, conditions={list(CONDITIONS)})"


@pytest.mark.parametrize(
    ("filters", "count"),
    [
        ({}, 15),
        ({"k": 0}, 3),
        ({"condition": ["k3", parse_condition("k0"), "k3"], "family": ("MoveCube",) * 2}, 2),
        ({"condition": (), "family": ("PatternLock", "MoveCube")}, 10),
        ({"difficulty": "easy"}, 15),  # the sample's index 0
    ],
)
def test_filters(filters: dict[str, Any], count: int) -> None:
    buffer_set = load_buffer_set(GOLDEN)
    found = list(buffer_set.manifests(**filters))
    assert len(found) == count
    assert [buffer.manifest for buffer in buffer_set.buffers(**filters)] == found


@pytest.mark.parametrize(
    ("filters", "message"),
    [
        ({"family": ("MoveCube", "MoveCub")}, "Did you mean 'MoveCube'?"),
        ({"difficulty": "hard"}, "Known: easy"),
        ({"condition": "k2"}, "k1"),
    ],
)
def test_unknown_filters(filters: dict[str, Any], message: str) -> None:
    with pytest.raises(UnknownNameError) as caught:
        load_buffer_set(GOLDEN).manifests(**filters)
    assert message in str(caught.value)


def test_a_buffer_by_its_key() -> None:
    buffer_set = load_buffer_set(GOLDEN)
    expected = buffer_set.load("MoveCube/test/0", "k3").manifest
    name = EpisodeId("MoveCube", "test", 0)
    for found in (
        load_buffer("MoveCube/test/0", "k3", buffer_set=GOLDEN),
        load_buffer(name, parse_condition("k3"), buffer_set=buffer_set),
        load_buffer("MoveCube/test/0", k=3, buffer_set=str(GOLDEN), verify=True),
        buffer_set.load(name, k=3),
    ):
        assert found.manifest == expected
    assert to_dict(expected)["episode_id"] == "MoveCube/test/0"
    assert (to_dict(expected)["family"], to_dict(expected)["condition"]) == ("MoveCube", "k3")


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((), InvalidOptionError, "expected exactly one"),
        (("k3", 3), InvalidOptionError, "expected exactly one"),
        ((None, True), InvalidOptionError, "k True; expected an integer"),
        ((None, -1), InvalidIdError, "'k-1' is not a condition"),
        (("k5",), UnknownNameError, "Planned there: no-history k0 k1 k3 k7"),
    ],
)
def test_conditions_that_cannot_be_loaded(
    arguments: tuple[Any, ...], error: type[InterferenceError], message: str
) -> None:
    given = dict(zip(("condition", "k"), arguments, strict=False))
    with pytest.raises(error) as caught:
        load_buffer("MoveCube/test/0", buffer_set=GOLDEN, **given)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("condition", "missing"),
    [
        ("before-k7", None),
        ("k40", f"{40 - (UNITS - 1)} too few"),  # one is of the query's family
        ("same-k2", "1 too few"),
        ("stale-k0", "contradictions"),
    ],
)
def test_a_condition_is_suggested_only_where_it_can_be_planned(
    condition: str, missing: str | None, own_buffers: Path
) -> None:
    with pytest.raises(UnknownNameError) as caught:
        load_buffer_set(own_buffers).planned(condition)
    if missing is None:
        assert (
            caught.value.command == f"build {own_buffers} --only manifests --conditions {condition}"
        )
    else:
        assert caught.value.command is None and missing in str(caught.value.hint)


@pytest.mark.parametrize(
    ("episode", "error", "message"),
    [
        ("MoveCub/test/0", UnknownNameError, "Did you mean 'MoveCube'?"),
        ("MoveCube/test/1", UnknownNameError, "Did you mean 'MoveCube/test/0'"),
        ("MoveCube", InvalidIdError, "Expected <Family>/<split>/<index>"),
    ],
)
def test_episodes_that_cannot_be_loaded(
    episode: Any, error: type[InterferenceError], message: str
) -> None:
    buffer_set = load_buffer_set(GOLDEN)
    for load in (lambda: buffer_set.load(episode, "k3"), lambda: buffer_set.query(episode)):
        with pytest.raises(error) as caught:
            load()
        assert message in str(caught.value)


@pytest.mark.parametrize(
    ("option", "values"),
    [
        ("cache", (3, ["x"], b"x", "", "a\0b")),
        ("threads", (0, -3, True, "2", 1.5)),
        ("buffer_set", (None, 3, b"g", "", "a\0b")),
    ],
)
def test_no_such_option(option: str, values: tuple[Any, ...]) -> None:
    for value in values:
        with raises(InvalidOptionError):
            load_buffer_set(**{"buffer_set": GOLDEN, option: value})


def test_numbers_may_be_numpys() -> None:
    buffer_set = load_buffer_set(GOLDEN, threads=np.int64(2))  # type: ignore[arg-type]
    buffer = buffer_set.load("MoveCube/test/0", k=np.int64(1))  # type: ignore[arg-type]
    np.testing.assert_array_equal(buffer.frame(np.uint8(60)), buffer.frames()[60])


def test_caches_by_folder_or_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    for cache, folder in (
        (str(tmp_path / "a"), tmp_path / "a"),
        (tmp_path / "b", tmp_path / "b"),
        (DecodedCache(tmp_path / "c"), tmp_path / "c"),
        (True, tmp_path / "home" / "robomme-interference" / "decoded"),
    ):
        load_buffer_set(GOLDEN, cache=cache).load("MoveCube/test/0", "k0").frames()
        assert len(list(folder.iterdir())) == 1


def test_a_buffer_set_travels_between_processes() -> None:
    buffer_set = pickle.loads(pickle.dumps(load_buffer_set(GOLDEN)))
    assert buffer_set.load("MoveCube/test/0", "k0").frames().shape == (48, 32, 32, 3)


def test_datasets_are_opened_on_first_use(own_buffers: Path) -> None:
    header = json.loads((own_buffers / HEADER).read_text())
    for name in ("shifted", "contradictions"):
        header["datasets"][name] = header["datasets"]["distractors"] | {"kind": name}
    (own_buffers / HEADER).write_text(json.dumps(header))
    buffer_set = load_buffer_set(own_buffers)
    assert buffer_set.load("MoveCube/test/0", "k3").frames().any()
    assert "shifted" in buffer_set.datasets
    with pytest.raises(MissingFileError):
        buffer_set.datasets["shifted"]


@pytest.mark.slow
def test_imports_are_lazy_and_loading_needs_light_libraries_only() -> None:
    code = (
        "import sys\n"
        "from robomme_interference_data import EpisodeId, InterferenceError\n"
        "from robomme_interference_data.errors import FormatError\n"
        "print(sorted({'pyarrow', 'av', 'numpy', 'huggingface_hub'} & sys.modules.keys()))\n"
        "from robomme_interference_data import load_buffer\n"
        f"buffer = load_buffer('MoveCube/test/0', 'k3', buffer_set={str(GOLDEN)!r}, verify=True)\n"
        "print(len(buffer.frames()), sorted({'torch', 'lerobot', 'datasets', 'typer',"
        " 'rich', 'scipy', 'matplotlib', 'sapien', 'h5py'} & sys.modules.keys()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout == "[]\n144 []\n"


def test_unknown_cameras_are_an_error_in_a_folder_too(tiny_buffers: Path) -> None:
    load = partial(load_buffer, QUERIES[0], "k1", buffer_set=tiny_buffers)
    assert len(load(cameras=["front"])) > 0
    for cameras, error in ((["top"], UnknownNameError), ("front", InvalidOptionError)):
        with pytest.raises(error):
            load(cameras=cameras)


# --- what is not as it should be ----------------------------------------------------------------


def test_what_is_no_buffer_set(tmp_path: Path) -> None:
    for folder in (tmp_path, GOLDEN / "demonstrations"):
        with raises(MissingFileError) as caught:
            load_buffer_set(folder)
        assert "build BUFFER_SET" in str(caught.value.command)
    (tmp_path / "begun" / ".demonstrations.building").mkdir(parents=True)
    with pytest.raises(MissingFileError) as caught:
        load_buffer_set(tmp_path / "begun")
    assert caught.value.command is None and "to resume it" in str(caught.value.hint)
    with raises(MissingFileError):
        load_buffer_set(tmp_path / "nowhere")
    with raises(InvalidOptionError):
        load_buffer_set(str(tmp_path / "nowhere"))
    with raises(InvalidOptionError):
        load_buffer_set(GOLDEN, revision="data-1.0.0")


@pytest.mark.parametrize("name", ["demonstrations", "distractors", ROWS])
def test_missing_parts(own_buffers: Path, name: str) -> None:
    part = own_buffers / name
    shutil.rmtree(part) if part.is_dir() else part.unlink()
    with pytest.raises(MissingFileError):
        load_buffer_set(own_buffers).load("MoveCube/test/0", "k3")


def test_another_dataset_than_the_manifests_name(own_buffers: Path) -> None:
    identity = own_buffers / "distractors" / "meta" / "interference.json"
    revision = load_buffer_set(own_buffers).header.datasets["distractors"].revision
    identity.write_text(identity.read_text().replace(revision, "0" * 64))
    with raises(HashMismatchError) as caught:
        load_buffer_set(own_buffers).load("MoveCube/test/0", "k3")
    assert caught.value.command == f"build {own_buffers} --only manifests"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('"format_version": 1', '"format_version": 2'),
        ('"conditions": [', '"conditionz": ['),
        ('"datasets": {', '"datasets": null, "x": {'),
        ('"seed": 0', '"seed": null'),
        ('"demonstrations"', '"demonstration"'),
        ('"distractors": {', '"../distractors": {'),
        ('"distractors": {', '"a\\u0000b": {'),
        ("{", "["),
    ],
)
def test_damaged_headers(own_buffers: Path, before: str, after: str) -> None:
    header = own_buffers / HEADER
    text = header.read_text()
    assert before in text
    header.write_text(text.replace(before, after))
    with raises(FormatError):
        load_buffer_set(own_buffers).load("MoveCube/test/0", "k3")


@pytest.mark.parametrize(
    "columns",
    [
        {"sessions": None},
        {"sessions": [None] * 15},
        {"k": pa.array(["x"] * 15)},
        {"condition": pa.array([["k3"]] * 15)},
    ],
)
def test_damaged_rows(own_buffers: Path, columns: dict[str, Any]) -> None:
    edit_columns(own_buffers / ROWS, **columns)
    with raises(FormatError):
        load_buffer_set(own_buffers).load("MoveCube/test/0", "k3")


def test_a_key_that_occurs_twice(own_buffers: Path) -> None:
    edit(own_buffers / ROWS, lambda table: pa.concat_tables([table, table.slice(8, 1)]))
    with raises(FormatError):
        load_buffer_set(own_buffers).load("MoveCube/test/0", "k3")


def other_goals(root: Path) -> None:
    edit_columns(root / ROWS, goals=[["another"]] * 15)


def other_goals_with_their_sum(root: Path) -> None:
    other_goals(root)
    renew_header(root)


def shorter_lesson(root: Path) -> None:
    for path in ("interference.parquet", "episodes/chunk-000/file-000.parquet"):
        edit_columns(root / "demonstrations/meta" / path, exec_start_idx=[47] * 3)


def other_first_view(root: Path) -> None:
    dataset = load_buffer_set(root).datasets["demonstrations"]
    index = dataset.index_of(EpisodeId.parse("MoveCube/test/0"))
    frames = list(dataset.iter_frames(index, "front", 0, 49))
    path = dataset.files.path(dataset.files_of(index, ["front"])[1])
    encoder = VideoEncoder(path, CODECS["av1-lossless"], 10, 32, 32)
    for frame in [*frames[:-1], 255 - frames[-1]]:
        encoder.add(frame)
    encoder.close()


@pytest.mark.parametrize(
    "change", [other_goals, other_goals_with_their_sum, shorter_lesson, other_first_view]
)
def test_a_verified_load_checks_the_query(
    own_buffers: Path, change: Callable[[Path], object]
) -> None:
    change(own_buffers)
    load_buffer_set(own_buffers).load("MoveCube/test/0", "k3")
    with raises(HashMismatchError):
        load_buffer_set(own_buffers).load("MoveCube/test/0", "k3", verify=True)


@pytest.mark.parametrize("name", ["distractors", "demonstrations"])
@pytest.mark.parametrize("other", [None, "with a look-alike letter", "../elsewhere"])
def test_datasets_have_their_names(own_buffers: Path, name: str, other: str | None) -> None:
    header = own_buffers / HEADER
    edited = json.loads(header.read_text())
    dataset = edited["datasets"].pop(name)
    if other is not None:
        renamed = name.replace("a", "\N{CYRILLIC SMALL LETTER A}") if " " in other else other
        edited["datasets"][renamed] = dataset
    header.write_text(json.dumps(edited))
    with raises(FormatError):
        load_buffer_set(own_buffers)


def exchanged(rows: list[list[dict[str, Any]]]) -> list[list[dict[str, Any]]]:
    """The units of the first and the last k3 buffer, exchanged."""
    first, last = (number for number, row in enumerate(rows) if len(row) == 4), len(rows) - 2
    number = next(first)
    rows[number][1:], rows[last][1:] = rows[last][1:], rows[number][1:]
    return rows


@pytest.mark.parametrize("change", [exchanged, lambda rows: [row[:1] + row[:0:-1] for row in rows]])
def test_rows_that_the_rules_do_not_give(own_buffers: Path, change: Callable[[Any], Any]) -> None:
    rows = pq.read_table(own_buffers / ROWS)["sessions"].to_pylist()
    edit_columns(own_buffers / ROWS, sessions=change(rows))
    renew_header(own_buffers)
    made = load_buffer_set(own_buffers)
    for episode in ("VideoRepick/test/0", "PatternLock/test/0"):
        assert len(made.load(episode, "k3").sessions) == 4
        with raises(HashMismatchError):
            made.load(episode, "k3", verify=True)
        with raises(HashMismatchError):
            next(made.buffers(condition="k3")).verify()
        made.load(episode, "k0", verify=True)
    with raises(HashMismatchError):
        made.check_tables(["k0", "k3"])
    made.check_tables(["k0", "no-history"])
    made.check_tables(["k3"], planned=False)


def test_rows_of_other_rules(own_buffers: Path) -> None:
    renew_header(own_buffers, rule_version=2)
    made = load_buffer_set(own_buffers)
    assert made.load("MoveCube/test/0", "k3")
    with raises(FormatError):
        made.load("MoveCube/test/0", "k3", verify=True)


@pytest.mark.parametrize(
    ("part", "value"), [("family", "VideoRepick"), ("split", "train"), ("index", 9)]
)
def test_parts_of_an_id_are_those_of_the_id(own_buffers: Path, part: str, value: Any) -> None:
    """The columns for filters: nothing of this package trusts them."""
    edit_columns(own_buffers / ROWS, **{part: [value] * 15})
    made = load_buffer_set(own_buffers)
    assert made.families == ("VideoRepick", "MoveCube", "PatternLock")
    with raises(FormatError):
        list(made.buffers(family="PatternLock"))
    for path in ("interference.parquet", "episodes/chunk-000/file-000.parquet"):
        edit_columns(own_buffers / "demonstrations/meta" / path, **{part: [value] * 3})
    with raises(FormatError):
        load_buffer_set(own_buffers).query("PatternLock/test/0")


@pytest.mark.parametrize(
    ("feature", "shape"),
    [("observation.state", None), ("observation.state", [4, 2]), ("observation.images.front", [3])],
)
@pytest.mark.parametrize("condition", ["no-history", "k1"])
def test_features_that_are_not_as_they_must_be(
    own_buffers: Path, feature: str, shape: list[int] | None, condition: str
) -> None:
    def change(info: dict[str, Any]) -> None:
        declared = info["features"].pop(feature)
        if shape is not None:
            info["features"][feature] = declared | {"shape": shape}

    edit_info(own_buffers / "demonstrations", change)
    for use in (
        lambda buffer: buffer.frames(),
        lambda buffer: buffer.states,
        lambda buffer: buffer.query.frame(),
    ):
        with raises(FormatError):
            use(load_buffer_set(own_buffers).load("MoveCube/test/0", condition))


def test_a_row_that_is_missing(own_buffers: Path) -> None:
    edit(own_buffers / ROWS, lambda table: table.slice(0, 3))
    with pytest.raises(UnknownNameError):
        load_buffer_set(own_buffers).load("MoveCube/test/0", "k3")
    with raises(FormatError):
        load_buffer_set(own_buffers).load("VideoRepick/test/0", "k7")


def test_loading_from_a_folder_imports_little() -> None:
    """No Hub, no rules, no copies, no pictures: at most 21 modules beside empty packages."""
    code = f"""
import sys
from robomme_interference_data import load_buffer
load_buffer("MoveCube/test/0", "k7", buffer_set={str(GOLDEN)!r}).frames("front")
print(*(name for name in sys.modules if name.startswith("robomme_interference_data.")))
"""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    packages = {f"robomme_interference_data.{name}" for name in ("data", "schema", "storage")}
    modules = {*done.stdout.split()} - packages
    assert len(modules) <= 21, sorted(modules)
