"""`verify` finds content that contradicts itself or the rules, though all hashes are renewed."""

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from support.buffer_sets import UNITS, plan_again, renew_sums, violations
from support.damage import HEADER, ROWS, edit, put, renew_header
from support.messages import raises
from support.mutations import Place, mutate, renew
from support.retrieval import make_index
from support.verifying import DATA, EPISODES, FRONT, RECORDS, VIDEO, expect, first_changed

from robomme_interference_data import load_buffer_set
from robomme_interference_data.constants import STATE
from robomme_interference_data.data.dataset import Dataset, revision_of
from robomme_interference_data.errors import FormatError, HashMismatchError, InterferenceError
from robomme_interference_data.storage.files import LocalFiles
from robomme_interference_data.storage.video.encode import CODECS, VideoEncoder
from robomme_interference_data.storage.video.frames import iter_frames


def as_text(name: str) -> Callable[[pa.Table], pa.Table]:
    def change(table: pa.Table) -> pa.Table:
        place, values = table.column_names.index(name), table[name].to_pylist()
        return table.set_column(place, name, pa.array(list(map(str, values))))

    return change


def doubled(table: pa.Table) -> pa.Table:
    place, states = table.column_names.index(STATE), table[STATE].to_pylist()
    return table.set_column(place, STATE, pa.array(states, pa.list_(pa.float64())))


def first(name: str, value: Any) -> Callable[[Path], None]:
    """Change the first value of a column."""
    return partial(edit, change=first_changed(name, value))


def table(change: Callable[[pa.Table], pa.Table]) -> Callable[[Path], None]:
    return partial(edit, change=change)


def fields(**values: Any) -> Callable[[Path], object]:
    """Change fields of a JSON file."""
    return lambda path: path.write_text(json.dumps(json.loads(path.read_text()) | values))


def replaced(before: str, after: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(path.read_text().replace(before, after, 1))


def skipping(path: Path) -> None:
    report = json.loads(path.read_text())
    report["counts"]["skipped"] = 1
    report["skipped"] = [{"episode_id": "MoveCube/train/99", "why": "\x1b[2J"}]
    path.write_text(json.dumps(report, indent=2, sort_keys=True) + "\n")


META = "distractors/meta"
TASKS = f"{META}/tasks.parquet"
INFO, STATS, REPORT, IDENTITY = (
    f"{META}/{name}.json" for name in ("info", "stats", "build_report", "interference")
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "change", "message"),
    [
        (DATA, first("timestamp", 0.05), "timestamp of episode 3"),
        (DATA, table(as_text("timestamp")), "timestamp of episode 3 is of type string"),
        (DATA, first("task_index", 0), "task_index of episode 3"),
        (DATA, table(doubled), "state of episode 3 is of type double; expected float"),
        (DATA, first("frame_index", 1), "frame_index"),
        (RECORDS, first("dataset_from_index", 7), "dataset_from_index"),
        (RECORDS, first(f"{FRONT}/to_timestamp", 1.0), "to_timestamp"),
        (RECORDS, first("data/file_index", 1), "is shared by episodes"),
        (RECORDS, first("tasks", ["another"]), "tasks of"),
        (RECORDS, first("length", 31), "holds 31 frames, not 32"),
        (RECORDS, first("exec_start_idx", 7), "exec_start_idx is 7"),
        (RECORDS, first("seed", 1), "revision is"),
        (RECORDS, table(lambda t: t.slice(1)), "the episode table lists 16 episodes"),
        (RECORDS, table(lambda t: t.drop_columns(["dataset_from_index"])), "_index is missing"),
        (RECORDS, table(lambda t: t.append_column("x", t["seed"])), "x is undeclared"),
        (EPISODES, first("dataset_from_index", 7), "dataset_from_index differs"),
        (TASKS, table(lambda t: put(t, "task_index", [*range(len(t))][::-1])), "lists the tasks"),
        (INFO, fields(total_frames=1), "total_frames is 1"),
        (INFO, fields(video_path="../../etc/{video_key}"), "leads out of it"),
        (IDENTITY, fields(codec="h264"), "codec 'h264' is unknown"),
        (IDENTITY, fields(kind="demonstrations"), "kind is"),
        (IDENTITY, fields(sources=3), "sources: 3"),
        (IDENTITY, fields(counts={"episodes": 17, "frames": 1, "families": {}}), "counts is"),
        (REPORT, skipping, "has control characters"),
        (REPORT, replaced('"frames": ', '"frames": 1'), "does not have the counts"),
        (ROWS, table(lambda t: t.append_column("x", t["seed"])), r"'x'\]"),
        (ROWS, table(lambda t: pa.concat_tables([t, t[:1]])), "2 rows of Video"),
        (ROWS, table(lambda t: t.slice(1)), "VideoRepick/test/0 under no-history: is missing"),
        (ROWS, table(lambda t: pa.concat_tables([t[1:], t[:1]])), "is out of order"),
        (ROWS, first("condition", "k9"), "under k9: should not be in"),
        (ROWS, first("lesson_share", 0.5), r"lesson_share is 0\.5; the rules give 0\.0"),
        (ROWS, first("goals", ["x"]), "goals is 'x' at 0; the rules give"),
        (HEADER, fields(seed=1), "the rules give"),
        (HEADER, fields(rule_version=2), "rule version 2; this package can check 1"),
        (HEADER, fields(counts={}), "counts are {}"),
        (HEADER, fields(conditions=["k7", "k3", "k1", "k0", "no-history"]), "conditions are"),
        (HEADER, fields(conditions=["k0"]), "should not be in"),
        (HEADER, fields(position_limit=1400), "under k3 needs 1444 positions"),
    ],
)
def test_inconsistent_content(
    own_buffers: Path, path: str, change: Callable[[Path], object], message: str
) -> None:
    change(own_buffers / path)
    if path == ROWS:
        renew_header(own_buffers)
    if path.startswith("distractors"):
        renew_sums(own_buffers / "distractors")
    expect(own_buffers, message)


def test_a_frame_that_no_row_has(own_buffers: Path) -> None:
    """No buffer reads it, so that all hashes of frames are right."""
    path = own_buffers / VIDEO
    frames = list(iter_frames(path, 0, None, 10))
    encoder = VideoEncoder(path, CODECS["av1-lossless"], 10, *frames[0].shape[:2])
    for frame in [*frames, frames[0]]:
        encoder.add(frame)
    encoder.close()
    renew_sums(own_buffers / "distractors")
    expect(own_buffers, f"{VIDEO}: episode 3: the video holds 33 frames, 0 to 32, but the table")


def test_statistics_that_are_not_those_of_the_build(own_buffers: Path) -> None:
    """They are not recomputed: their files have recorded digests."""
    fields(action=None)(own_buffers / STATS)
    first("stats/observation.state/mean", [0.5] * 8)(own_buffers / EPISODES)
    expect(own_buffers, "meta/stats.json", "meta/episodes")


def test_frames_that_are_not_the_hashed_ones(own_buffers: Path) -> None:
    videos = own_buffers / f"distractors/{FRONT}/chunk-000"
    shutil.copyfile(videos / "file-005.mp4", videos / "file-003.mp4")
    renew_sums(own_buffers / "distractors")
    expect(own_buffers, r"observation\.images\.front does not have", decode=True)


def test_vectors_that_are_not_the_hashed_ones(own_buffers: Path) -> None:
    def change(table: pa.Table) -> pa.Table:
        states = np.array(table["observation.state"].to_pylist(), np.float32)
        states[17, 3] = np.nextafter(states[17, 3], 9, dtype=np.float32)
        return put(table, "observation.state", states.tolist())

    edit(own_buffers / "demonstrations/data/chunk-000/file-001.parquet", change)
    renew_sums(own_buffers / "demonstrations")
    expect(
        own_buffers,
        r"MoveCube/test/0: observation\.state does not",
        r"MoveCube/test/0: frames 0 to 23 \(first\) do not",
        decode=True,
    )


@pytest.mark.parametrize("path", [EPISODES, RECORDS])
def test_records_out_of_order(own_buffers: Path, path: str) -> None:
    """LeRobot finds an episode by its place."""

    def exchange(table: pa.Table) -> pa.Table:
        return table.take([1, 0, *range(2, len(table))])

    edit(own_buffers / path, exchange)
    renew(own_buffers, path)
    expect(own_buffers, "the episode table lists 17 episodes: 1, 0")


def test_data_files_out_of_order(own_buffers: Path) -> None:
    """LeRobot reads all data files in the order of their names."""
    first, second = (own_buffers / f"distractors/data/chunk-000/file-00{n}.parquet" for n in (1, 2))
    saved = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(saved)
    for path in (EPISODES, RECORDS):
        edit(own_buffers / path, lambda t: put(t, "data/file_index", [0, 2, 1, *range(3, UNITS)]))
        renew(own_buffers, path)
    expect(own_buffers, "does not have the data files in the order of the episodes")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "place"),
    [
        ("distractors/meta/interference.json", ("codec",)),
        ("distractors/meta/interference.json", ("unit", "stride")),
        ("demonstrations/meta/interference.json", ("sources", 0, "kind")),
        ("demonstrations/meta/info.json", ("features", "observation.state", "names", 0)),
        ("demonstrations/meta/info.json", ("robot_type",)),
    ],
)
def test_what_describes_the_content_is_in_the_revision(
    own_buffers: Path, path: str, place: Place
) -> None:
    mutate(own_buffers / path, place)
    renew(own_buffers, path)
    expect(own_buffers, r"interference\.json: revision is .*; the episodes give")
    name = path.split("/", maxsplit=1)[0]
    with raises(HashMismatchError):
        load_buffer_set(own_buffers).load("MoveCube/test/0", "k1", verify=True)
    assert name in {"demonstrations", "distractors"}


def test_a_codec_that_the_videos_do_not_have(own_buffers: Path) -> None:
    """With the revision renewed and all buffers planned again, the videos themselves tell."""
    path = own_buffers / "distractors/meta/interference.json"
    stored = json.loads(path.read_text())
    path.write_text(json.dumps(stored | {"codec": "lerobot-default"}))
    made = Dataset(LocalFiles(own_buffers / "distractors"))
    revision = revision_of(made.identity, made.lerobot.info, made.records())
    path.write_text(json.dumps(stored | {"codec": "lerobot-default", "revision": revision}))
    plan_again(own_buffers)
    assert violations(own_buffers, decode=False) == []
    expect(own_buffers, "distractors .*: has videos in gbrp, not lerobot-default", decode=True)


def test_a_location_beside_the_folder(own_buffers: Path) -> None:
    """It is no content, but would send the readers of the published manifests to another place."""
    revision, header = load_buffer_set(own_buffers).revision, own_buffers / HEADER
    changed = json.loads(header.read_text())
    changed["datasets"]["distractors"]["location"] = "someone/else@" + "0" * 40
    header.write_text(json.dumps(changed))
    [found] = violations(own_buffers, decode=False)
    assert "someone/else" in found
    assert load_buffer_set(own_buffers).revision == revision


@pytest.mark.slow
def test_an_index_of_other_numbers(own_buffers: Path) -> None:
    make_index(own_buffers)
    path = "distractors/index/thumbnail/index.json"
    saved = (own_buffers / path).read_bytes()
    for place, words in {
        ("typical_cosine",): "the embeddings give",
        ("encoder", "sha256"): "fingerprint does not have its SHA-256",
        ("frames",): "frames; the dataset has",
        ("revision",): "with revision",
    }.items():
        mutate(own_buffers / path, place)
        renew(own_buffers, path)
        expect(own_buffers, f"index/thumbnail: .*{words}")
        (own_buffers / path).write_bytes(saved)


@pytest.mark.parametrize("name", ["demonstrations", "distractors"])
def test_a_dataset_that_is_a_link_out_of_the_buffer_set(own_buffers: Path, name: str) -> None:
    outside = own_buffers.parent / "outside"
    (own_buffers / name).rename(outside)
    (own_buffers / name).symlink_to(outside)
    expect(own_buffers, f"{name}: .* is a link that leads out of the buffer set")
    with raises(FormatError):
        load_buffer_set(own_buffers).load("MoveCube/test/0", "k1")
    (own_buffers / name).unlink()
    (own_buffers / name).symlink_to(outside.rename(own_buffers / "inside"))
    assert load_buffer_set(own_buffers).load("MoveCube/test/0", "k1")


@pytest.mark.slow
@pytest.mark.parametrize("path", [EPISODES, RECORDS, ROWS, DATA, "distractors/meta/tasks.parquet"])
def test_two_columns_of_one_name(own_buffers: Path, path: str) -> None:
    def twice(table: pa.Table) -> pa.Table:
        return table.append_column(table.schema.names[0], table.column(0))

    edit(own_buffers / path, twice)
    renew(own_buffers, path)
    expect(own_buffers, "same name|two columns", decode=True)
    with suppress(InterferenceError):  # whatever is read without that file
        load_buffer_set(own_buffers).load("MoveCube/test/0", "k7").frames()
