"""Every kind of damage to a split is found, and named where it is."""

import json
import re
import shutil
from pathlib import Path

import av
import numpy as np
import pytest
from made_splits import check_violations as check
from made_splits import edit_json, edit_table, split
from made_splits import violations_of as found
from recordings import contents
from typer.testing import CliRunner

from robomme_interference_data.cli import app
from robomme_interference_data.errors import FormatError, MissingFileError

EPISODES = "meta/episodes/chunk-000/file-000.parquet"
FRONT = "observation.images.front"


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    """A copy of a clean split, to be damaged."""
    shutil.copytree(split(), tmp_path / "split")
    return tmp_path / "split"


# --- nothing to find -----------------------------------------------------------------------------


def test_a_clean_split() -> None:
    before = contents(split())
    counted: list[int] = []
    check(split(), advance=counted.append)
    assert counted == [6, 21, 6, *[32] * 6]  # frames by episode
    assert contents(split()) == before


def test_without_decoding() -> None:
    counted: list[int] = []
    check(split(), decode=False, advance=counted.append)
    assert counted == []


# --- frames and vectors --------------------------------------------------------------------------


def packets(path: Path) -> list[tuple[int, int]]:
    """Place and size of every packet in a video file."""
    with av.open(str(path)) as container:
        return [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]


@pytest.mark.parametrize("frame", [0, 15, 16, 31, 32, 63])
def test_a_flipped_byte_in_a_video(damaged: Path, frame: int) -> None:
    path = damaged / f"distractors/videos/{FRONT}/chunk-000/file-000.mp4"  # MoveCube's two units
    place, size = packets(path)[frame]
    data = bytearray(path.read_bytes())
    data[place + size // 2] ^= 0x10
    path.write_bytes(data)
    violations = found(damaged)
    assert {where for where, _ in violations} == {f"distractors MoveCube/train/{frame // 32}"}
    assert found(damaged, decode=False) == []


@pytest.mark.parametrize("what", ["cut", "missing", "empty", "not a video"])
def test_a_broken_video(damaged: Path, what: str) -> None:
    path = damaged / f"demonstrations/videos/{FRONT}/chunk-000/file-001.mp4"  # Drawer's query
    if what == "missing":
        path.unlink()
    else:
        data = path.read_bytes()
        path.write_bytes({"cut": data[: len(data) // 2], "empty": b""}.get(what, b"text" * 99))
    check(damaged, ("demonstrations Drawer/test/0", re.escape(path.name)))


def test_two_videos_exchanged(damaged: Path) -> None:
    folder = damaged / f"distractors/videos/{FRONT}/chunk-000"
    (folder / "file-000.mp4").rename(folder / "other")
    (folder / "file-001.mp4").rename(folder / "file-000.mp4")
    (folder / "other").rename(folder / "file-001.mp4")
    message = rf"^{FRONT} \(frames\) does not have the recorded SHA-256$"
    names = ["MoveCube/train/0", "MoveCube/train/1", "PatternLock/train/0", "PatternLock/train/1"]
    check(damaged, *((f"distractors {name}", message) for name in names))


@pytest.mark.parametrize(
    ("column", "frame", "spans"),
    [
        ("observation.state", 0, ["frames", "lesson"]),
        ("observation.state", 19, ["frames", "lesson"]),
        ("observation.state", 20, ["frames"]),  # the query frame is not part of the lesson
        ("action", 5, ["frames", "lesson"]),
    ],
)
def test_a_changed_number(damaged: Path, column: str, frame: int, spans: list[str]) -> None:
    def change(rows: list[dict]) -> None:
        (row,) = [r for r in rows if (r["episode_index"], r["frame_index"]) == (1, frame)]
        row[column][3] = float(np.nextafter(np.float32(row[column][3]), np.float32(9)))

    edit_table(damaged / "demonstrations/data/chunk-000/file-000.parquet", change)
    check(
        damaged,
        *(
            ("demonstrations MoveCube/test/1", rf"^{column} \({span}\) does not have the recorded")
            for span in spans
        ),
    )


def test_a_lost_data_row(damaged: Path) -> None:
    path = damaged / "distractors/data/chunk-000/file-002.parquet"
    edit_table(path, lambda rows: rows.pop(40))
    check(damaged, ("distractors Drawer/train/1", "has 31 frames in the data file; 32 are"))


# --- tables -------------------------------------------------------------------------------------

TABLE_CHANGED = ("distractors", "the episode table is not the one that the revision was made from")


def test_a_changed_hash(damaged: Path) -> None:
    def change(rows: list[dict]) -> None:
        rows[3]["sha256"] = "0" * 64

    edit_table(damaged / "distractors" / EPISODES, change)
    name = "PatternLock/train/1"
    violations = found(damaged)
    assert violations[:2] == [
        TABLE_CHANGED,
        (f"distractors {name}", "the SHA-256 of its frames is not that of their features"),
    ]
    # Every buffer with that unit names another hash than the table does now.
    for where, what in violations[2:]:
        assert re.match(r"(MoveCube/test/[01]|Drawer/test/0) at k=[13]$", where)
        assert re.match(r"sessions is {'sha256': '[0-9a-f]+'} at \d; the rules give .*'0000", what)
    assert len(violations) > 2


def test_two_units_exchanged(damaged: Path) -> None:
    def change(rows: list[dict]) -> None:
        places = [name for name in rows[0] if name.startswith(("videos/", "data/", "dataset_"))]
        for name in [*places, "episode_index"]:
            rows[0][name], rows[2][name] = rows[2][name], rows[0][name]
        rows[0], rows[2] = rows[2], rows[0]

    # The ids change places, and take all of our columns with them, but the frames stay.
    edit_table(damaged / "distractors" / EPISODES, change)
    wrong = [(w, what) for w, what in found(damaged) if w.startswith("distractors")]
    assert wrong[0] == TABLE_CHANGED
    assert {where for where, _ in wrong[1:]} == {
        "distractors MoveCube/train/0",
        "distractors PatternLock/train/0",
    }


@pytest.mark.parametrize(
    ("column", "value", "more"),
    [
        ("seed", 5, []),
        ("difficulty", "hard", []),
        ("raw_length", 1000, []),
        (
            "goals",
            ["other"],
            [("distractors MoveCube/train/0", "its task is .*; its goal 'other'")],
        ),
        (
            "exact",
            False,
            [("distractors/meta/interference.json", "exact is True; its episodes say False")],
        ),
        (
            "simulator",
            "other",
            [("distractors/meta/interference.json", "simulators is .*; its episodes say")],
        ),
    ],
)
def test_a_changed_column(damaged: Path, column: str, value: object, more: list) -> None:
    edit_table(damaged / "distractors" / EPISODES, lambda rows: rows[0].update({column: value}))
    violations = found(damaged)
    assert violations[0] == TABLE_CHANGED
    datasets = [(w, what) for w, what in violations[1:] if " at k=" not in w]
    assert len(datasets) == len(more)
    for (where, what), (place, pattern) in zip(datasets, more, strict=True):
        assert (where, bool(re.match(pattern, what))) == (place, True)


def test_a_changed_task(damaged: Path) -> None:
    edit_table(
        damaged / "demonstrations" / EPISODES, lambda rows: rows[2].update(tasks=["do MoveCube"])
    )
    message = r"its task is \['do MoveCube'\]; its goal 'do Drawer'"
    check(damaged, ("demonstrations Drawer/test/0", message))


@pytest.mark.parametrize(
    ("field", "value", "pattern"),
    [
        ("exact", False, "exact is False; its episodes say True"),
        ("cameras", ["front"], r"cameras is \['front'\]; its episodes say \['front', 'wrist'\]"),
        ("simulators", [], "simulators is"),
        ("counts", {"episodes": 5}, "counts is {'episodes': 5}; its episodes say {'episodes': 6"),
    ],
)
def test_a_changed_identity(damaged: Path, field: str, value: object, pattern: str) -> None:
    path = damaged / "distractors/meta/interference.json"
    edit_json(path, lambda identity: identity.update({field: value}))
    violations = found(damaged)
    assert violations[0][0] == "distractors/meta/interference.json"
    assert re.match(pattern, violations[0][1])
    # The header of the manifests recorded it, too.
    others = [where for where, _ in violations[1:]]
    assert others == ([] if field == "cameras" else ["manifests/manifest.json"])


def test_another_dataset(damaged: Path, tmp_path: Path) -> None:
    edit_json(
        damaged / "distractors/meta/interference.json",
        lambda identity: identity.update(revision="0" * 64),
    )
    violations = found(damaged, decode=False)
    assert violations[:2] == [
        TABLE_CHANGED,
        ("distractors", "is not the revision that the manifests were made for"),
    ]


def test_datasets_exchanged(damaged: Path) -> None:
    (damaged / "distractors").rename(damaged / "other")
    (damaged / "demonstrations").rename(damaged / "distractors")
    (damaged / "other").rename(damaged / "demonstrations")
    violations = found(damaged, decode=False)
    assert ("demonstrations", "is not the revision that the manifests were made for") in violations
    assert ("demonstrations MoveCube/train/0", "exec_start_idx is None") in violations
    assert ("distractors MoveCube/test/0", "exec_start_idx is 5") in violations
    assert violations[-1][0] == "manifests"
    assert "is a dataset of distractors" in violations[-1][1]


def test_a_unit_of_another_length(damaged: Path) -> None:
    edit_table(damaged / "distractors" / EPISODES, lambda rows: rows[0].update(length=31))
    violations = found(damaged, decode=False)
    assert ("distractors MoveCube/train/0", "holds 31 frames, not 32") in violations


# --- folders that are no split -------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    ["manifests/manifest.json", "demonstrations/meta/info.json", "distractors/meta/info.json"],
)
def test_what_is_no_split(damaged: Path, path: str) -> None:
    (damaged / path).unlink()
    with pytest.raises(MissingFileError, match=re.escape(path.partition("/")[2])):
        found(damaged)


def test_an_unknown_format(damaged: Path) -> None:
    edit_json(damaged / "manifests/manifest.json", lambda header: header.update(format_version=9))
    with pytest.raises(FormatError, match="format version 9"):
        found(damaged)


# --- the command ---------------------------------------------------------------------------------


def test_command(damaged: Path) -> None:
    runner = CliRunner()
    done = runner.invoke(app, ["verify", str(damaged)])
    assert (done.exit_code, done.stdout) == (0, "")
    assert f"All hashes and rules of {damaged} hold." in " ".join(done.stderr.split())
    (damaged / f"distractors/videos/{FRONT}/chunk-000/file-000.mp4").unlink()
    done = runner.invoke(app, ["verify", str(damaged), "--no-decode"])
    assert (done.exit_code, done.stdout) == (0, "")
    assert "frames not decoded" in done.stderr
    done = runner.invoke(app, ["verify", str(damaged), "--json"])
    assert done.exit_code == 1
    assert [violation["where"] for violation in json.loads(done.stdout)] == [
        "distractors MoveCube/train/0",
        "distractors MoveCube/train/1",
    ]
    done = runner.invoke(app, ["verify", str(damaged)])
    assert done.exit_code == 1
    assert done.stdout.startswith("distractors MoveCube/train/0: videos/")
    assert "2 violations" in done.stderr
