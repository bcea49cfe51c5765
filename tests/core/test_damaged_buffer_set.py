"""Buffer sets with missing, damaged or exchanged parts: one error each."""

import json
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.buffer_sets import GOLDEN, copy_buffer_set
from support.damage import HEADER, ROWS, edit, renew_header
from support.lerobot_layouts import edit_columns, edit_info
from support.messages import raises

from robomme_interference_data import EpisodeId, load_buffer_set
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InvalidOptionError,
    MissingFileError,
    UnknownNameError,
)
from robomme_interference_data.storage.video.encode import CODECS, VideoEncoder


def test_what_is_no_buffer_set(tmp_path: Path) -> None:
    with raises(MissingFileError) as caught:
        load_buffer_set(tmp_path)
    assert caught.value.command == "build BUFFER_SET --source KIND:PATH"
    with raises(MissingFileError) as caught:
        load_buffer_set(GOLDEN / "demonstrations")
    assert caught.value.command is None and "the folder that holds it" in str(caught.value.hint)
    (tmp_path / "recordings" / "meta").mkdir(parents=True)
    (tmp_path / "recordings" / "meta" / "info.json").write_text("{}")
    with pytest.raises(MissingFileError) as caught:
        load_buffer_set(tmp_path / "recordings")
    assert f"lerobot:{tmp_path / 'recordings'}" in str(caught.value.command)
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


def test_commands_quote_the_folder(tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "my set")
    with pytest.raises(UnknownNameError) as caught:
        load_buffer_set(root).planned("k2")
    words = ["build", str(root), "--only", "manifests"]
    assert shlex.split(caught.value.command or "")[:4] == words
    shutil.rmtree(root / "manifests")
    with pytest.raises(MissingFileError) as missing:
        load_buffer_set(root)
    assert shlex.split(missing.value.command or "") == words


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
