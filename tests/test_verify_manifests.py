"""Every deviation of the manifests from the rules is found, and named where it is."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from made_splits import check_violations as check
from made_splits import edit_json, edit_manifests, split, vouch
from made_splits import violations_of as found
from recordings import opened

from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests

EPISODES = "meta/episodes/chunk-000/file-000.parquet"
FRONT = "observation.images.front"


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    """A copy of a clean split, to be damaged."""
    shutil.copytree(split(), tmp_path / "split")
    return tmp_path / "split"


# --- manifests -----------------------------------------------------------------------------------

ROW = ("MoveCube/test/1 at k=3", 5)  # the sixth row


def swapped_unit(rows: list[dict], source: str) -> None:
    """Put another unit in the last place of a buffer, with all that belongs to it."""
    row = rows[ROW[1]]
    assert (row["episode_id"], row["k"]) == ("MoveCube/test/1", 3)
    datasets = opened(split() / "distractors")
    (record,) = [r for r in datasets.records() if str(r.id) == source]
    row["sessions"][3].update(
        family=record.id.family,
        source=source,
        episode_index=record.episode_index,
        sha256=record.sha256,
    )


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        (
            lambda rows: swapped_unit(rows, "MoveCube/train/0"),
            r"'source': 'MoveCube/train/0'.* at 3",
        ),
        (lambda rows: rows[5].update(sessions=rows[5]["sessions"][:3]), r"^sessions is \["),
        (
            lambda rows: rows[5]["sessions"][2].update(sha256="0" * 64),
            r"{'sha256': '0+'} at 2; the",
        ),
        (lambda rows: rows[5]["sessions"][0].update(stop=19), r"{'stop': 19} at 0; .*{'stop': 20}"),
        (lambda rows: rows[5]["sessions"][1].update(repeat=2), r"{'repeat': 2} at 1; the rules"),
        (lambda rows: rows[5].update(goals=["other"]), r"^goals is \['other'\]; .*\['do MoveC"),
        (lambda rows: rows[5].update(lesson_share=0.5), r"^lesson_share is 0.5; the rules give 0"),
        (lambda rows: rows[5].update(history_frames=115), r"^history_frames is 115; the .* 116"),
        (lambda rows: rows[5]["query"].update(frame=19), r"^query is {'frame': 19}; .*'frame': 20"),
        (lambda rows: rows[5].update(seed=None), r"^seed is None; the rules give 1001"),
        (lambda rows: rows[5].update(exact=False), r"^exact is False; the rules give True"),
    ],
)
def test_a_changed_row(damaged: Path, change: Callable, pattern: str) -> None:
    edit_manifests(damaged, change)
    check(damaged, (ROW[0], pattern), decode=False)


def test_a_repeated_unit(damaged: Path) -> None:
    def change(rows: list[dict]) -> None:
        rows[5]["sessions"][3] = dict(rows[5]["sessions"][1])

    edit_manifests(damaged, change)
    check(damaged, (ROW[0], r"^sessions is {.*} at 3; the rules give"), decode=False)


def test_a_lost_row(damaged: Path) -> None:
    edit_manifests(damaged, lambda rows: rows.pop(ROW[1]))
    message = r"^the row is missing in buffers\.parquet, or not in its place$"
    check(damaged, (ROW[0], message), decode=False)


@pytest.mark.parametrize("place", [6, 9])
def test_a_row_too_many(damaged: Path, place: int) -> None:
    edit_manifests(damaged, lambda rows: rows.insert(place, dict(rows[ROW[1]])))
    violations = found(damaged, decode=False)
    message = "the row should not be there in buffers.parquet, or not in its place"
    assert (ROW[0], message) in violations
    assert {where for where, _ in violations} <= {ROW[0], "manifests/buffers.jsonl"}


def test_a_row_far_from_its_place(damaged: Path) -> None:
    edit_manifests(damaged, lambda rows: rows.insert(0, rows.pop(ROW[1])))
    violations = [what for where, what in found(damaged, decode=False) if " at k=" in where]
    assert violations
    assert all(what.endswith("in buffers.parquet, or not in its place") for what in violations)


def test_rows_of_a_query_that_there_is_not(damaged: Path) -> None:
    def change(rows: list[dict]) -> None:
        rows.insert(5, {**rows[5], "episode_id": "no id"})
        rows.append({**rows[5], "episode_id": "Zzz/test/0", "family": "Zzz"})

    edit_manifests(damaged, change)
    message = r"^the row should not be there"
    check(damaged, ("no id at k=3", message), ("Zzz/test/0 at k=3", message), decode=False)


def test_two_rows_exchanged(damaged: Path) -> None:
    def change(rows: list[dict]) -> None:
        rows[3], rows[4] = rows[4], rows[3]

    edit_manifests(damaged, change)
    names = {where for where, _ in found(damaged, decode=False)}
    assert "MoveCube/test/1 at k=0" in names
    assert names <= {"MoveCube/test/1 at k=0", "manifests/buffers.jsonl"}


FORGED = ("manifests/buffers.jsonl", "^does not have the SHA-256 of manifest.json$")


@pytest.mark.parametrize("harm", ["changed", "lost", "doubled", "not JSON", "a list", "exchanged"])
def test_json_lines(damaged: Path, harm: str) -> None:
    path = damaged / "manifests/buffers.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    name = "MoveCube/test/1 at k=3"
    other = f"^{name} is not the same row as in buffers.parquet$"
    expected = [other]
    if harm == "changed":
        lines[5] = lines[5].replace('"seed": 1001', '"seed": 1002')
    elif harm == "lost":
        del lines[5]
    elif harm == "doubled":
        lines.insert(6, lines[5])
    elif harm == "exchanged":
        lines[5], lines[6] = lines[6], lines[5]
        expected = ["^Drawer/test/0 at k=0 is not|^MoveCube/test/1 at k=3 is not"] * 2
    else:
        lines[5] = "{\n" if harm == "not JSON" else "[1, 2]\n"
        expected += ["^line 6 is not a JSON object$"]
    path.write_text("".join(lines))
    place = "manifests/buffers.jsonl"
    check(damaged, FORGED, *((place, pattern) for pattern in expected), decode=False)
    vouch(damaged)
    check(damaged, *((place, pattern) for pattern in expected), decode=False)


def test_json_lines_that_are_not_text(damaged: Path) -> None:
    path = damaged / "manifests/buffers.jsonl"
    path.write_bytes(path.read_bytes().replace(b"MoveCube/test/1", b"MoveCube\xff\xfe/test/1"))
    violations = found(damaged, decode=False)
    assert {where for where, _ in violations} == {"manifests/buffers.jsonl"}


@pytest.mark.parametrize("name", ["buffers.parquet", "buffers.jsonl"])
def test_a_missing_manifest_file(damaged: Path, name: str) -> None:
    (damaged / "manifests" / name).unlink()
    violations = found(damaged, decode=False)
    assert violations[0] == (f"manifests/{name}", "is missing")
    assert len(violations) == (2 if name == "buffers.parquet" else 1)


@pytest.mark.parametrize("place", [0, 200, 1500, -200, -6])
def test_a_flipped_byte_in_the_manifests(damaged: Path, place: int) -> None:
    path = damaged / "manifests/buffers.parquet"
    data = bytearray(path.read_bytes())
    data[place] ^= 0x10
    path.write_bytes(data)
    message = "does not have the SHA-256 of manifest.json"
    assert ("manifests/buffers.parquet", message) in found(damaged, decode=False)


def test_other_manifests_with_the_same_name(damaged: Path) -> None:
    datasets = [opened(damaged / name) for name in ("demonstrations", "distractors")]
    for _ in write_manifests(plan_manifests(*datasets, (0, 1, 3), seed=1), damaged / "manifests"):
        pass
    check(damaged, decode=False)  # a split of its own
    edit_json(damaged / "manifests/manifest.json", lambda header: header.update(seed=0))
    violations = found(damaged, decode=False)
    assert violations
    assert all(re.match(r"sessions is .* at \d; the rules give", what) for _, what in violations)


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        ({"seed": 1}, r"^sessions is"),
        ({"k": [0, 1]}, "should not be there"),
        ({"rule_version": 2}, r"^rule version 2; this package can check 1$"),
        ({"position_limit": 1300}, r"^MoveCube/test/0 at k=3 needs 1401 positions"),
        ({"counts": {"queries": 3}}, r"^counts are {'queries': 3}; there are {'queries': 3, 'b"),
    ],
)
def test_a_changed_header(damaged: Path, change: dict, pattern: str) -> None:
    edit_json(damaged / "manifests/manifest.json", lambda header: header.update(change))
    violations = found(damaged, decode=False)
    assert any(re.search(pattern, what) for _, what in violations)
    assert found(split(), decode=False) == []


@pytest.mark.parametrize("field", ["version", "name", "exact", "counts"])
def test_a_header_that_says_other_things_of_a_dataset(damaged: Path, field: str) -> None:
    edit_json(
        damaged / "manifests/manifest.json",
        lambda header: header["datasets"]["distractors"].update({field: "other"}),
    )
    message = f"^{field} of the distractors is other; the dataset says "
    check(damaged, ("manifests/manifest.json", message), decode=False)
