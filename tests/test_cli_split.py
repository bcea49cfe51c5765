"""Commands on a split: list, show, verify, audit and build manifests."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import factories
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from robomme_interference_data import load_split

EPISODE = "VideoUnmask/test/1"

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    return factories.copy_of_split(tmp_path / "split")


# --- list and show -----------------------------------------------------------------------------


def test_list(run: Run) -> None:
    code, out, err = run("list", factories.split())
    assert (code, err) == (0, "")
    rows = [line.split("│")[1:-1] for line in out.splitlines() if line.startswith("│")]
    assert len(rows) == 24
    found = [[cell.strip() for cell in row] for row in rows]
    assert found[11] == [EPISODE, "3", "medium", "36", "132", "0.28"]


@pytest.mark.parametrize(
    ("options", "count"),
    [
        ([], 24),
        (["--k", "3"], 8),
        (["--family", "MoveCube", "--difficulty", "easy"], 3),
    ],
)
def test_list_as_json(options: list[str], count: int, run: Run) -> None:
    code, out, err = run("list", factories.split(), "--json", *options)
    assert (code, err) == (0, "")
    rows = [json.loads(line) for line in out.splitlines()]
    assert len(rows) == count
    lines = (factories.split() / "manifests" / "buffers.jsonl").read_text().splitlines()
    assert all(row in [json.loads(line) for line in lines] for row in rows)


def test_show(run: Run) -> None:
    code, out, err = run("show", EPISODE, "--split", factories.split(), "--k", 3)
    assert (code, err) == (0, "")
    assert f"{EPISODE} at k=3: watch the video carefully" in out
    rows = [line.split("│")[1:-1] for line in out.splitlines() if line.startswith("│")]
    found = [[cell.strip() for cell in row] for row in rows]
    assert found[0] == ["0", "lesson", "VideoUnmask", EPISODE, "0 to 35"]
    assert [row[4] for row in found] == ["0 to 35", "36 to 67", "68 to 99", "100 to 131"]
    assert "132 history frames" in out
    assert "sample at the first step holds 28% lesson" in " ".join(out.split())


def test_show_as_json(run: Run) -> None:
    code, out, err = run("show", EPISODE, "--split", factories.split(), "--k", 3, "--json")
    assert (code, err) == (0, "")
    assert json.loads(out) == load_split(factories.split()).manifest(EPISODE, 3).as_dict()


def test_show_draws_a_strip(run: Run, tmp_path: Path) -> None:
    picture = tmp_path / "strip.png"
    code, out, err = run(
        "show", EPISODE, "--split", factories.split(), "--k", 1, "--out", picture, "--json"
    )
    assert code == 0
    assert json.loads(out)["k"] == 1  # the message about the picture is not among the data
    assert str(picture) in err.replace("\n", "")
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_goals_are_shown_as_they_are(run: Run, copy: Path) -> None:
    """Brackets and colons in them are not taken for markup."""
    goal = "put [red] :fire: into [/b] the [bold]box"
    path = copy / "manifests" / "buffers.parquet"
    table = pq.ParquetFile(path).read()
    place = table.schema.get_field_index("goals")
    goals = pa.array([[goal]] * len(table), table.schema.field(place).type)
    pq.write_table(table.set_column(place, table.schema.field(place), goals), path)
    code, out, err = run("show", EPISODE, "--split", copy, "--k", 1)
    assert (code, err) == (0, "")
    assert goal in " ".join(out.split())


# --- verify and audit ----------------------------------------------------------------------------


def test_verify_a_clean_split(run: Run) -> None:
    code, out, err = run("verify", factories.split())
    assert (code, out) == (0, "")
    assert f"All hashes and rules of {factories.split()} hold." in err.replace("\n", " ").replace(
        "  ", " "
    )
    code, out, err = run("verify", factories.split(), "--json", "--no-decode")
    assert (code, json.loads(out)) == (0, [])


def remove_video(root: Path) -> None:
    (root / "demonstrations/videos/observation.images.front/chunk-000/file-001.mp4").unlink()


def change_line(root: Path) -> None:
    path = root / "manifests/buffers.jsonl"
    path.write_text(path.read_text().replace('"k": 3', '"k": 5', 1))


def swap_videos(root: Path) -> None:
    folder = root / "distractors/videos/observation.images.wrist/chunk-000"
    shutil.copyfile(folder / "file-001.mp4", folder / "file-002.mp4")


@pytest.mark.parametrize(
    ("damage", "where", "what"),
    [
        (remove_video, "demonstrations VideoUnmask/test/0", "file-001.mp4 is missing"),
        (change_line, "manifests/buffers.jsonl", "does not have the SHA-256"),
        (swap_videos, "distractors MoveCube/train/0", "observation.images.wrist"),
    ],
)
def test_verify_names_violations(
    damage: Callable[[Path], None], where: str, what: str, run: Run, copy: Path
) -> None:
    damage(copy)
    code, out, err = run("verify", copy)
    assert code == 1
    assert any(line.startswith(where) and what in line for line in out.splitlines())
    assert "violations" in err
    code, out, _ = run("verify", copy, "--json")
    assert code == 1
    assert any(where in found["where"] and what in found["what"] for found in json.loads(out))


def test_audit(run: Run) -> None:
    code, out, err = run("audit", factories.split())
    assert (code, err) == (0, "No leaks.\n")
    assert "Uses of a unit" in out
    code, out, err = run("audit", factories.split(), "--json")
    assert (code, err) == (0, "")
    report = json.loads(out)
    assert report["leaks"] == []
    assert sum(report["units"].values()) == 8 * 3
    assert report["usage"]["1"]["mean"] == 8 / 7


# --- build manifests --------------------------------------------------------------------------


def test_build_manifests_as_the_split_has_them(run: Run, tmp_path: Path) -> None:
    root = factories.split()
    code, out, _ = run(
        "build", "manifests",
        "--demonstrations", root / "demonstrations",
        "--distractors", root / "distractors",
        "--out", tmp_path / "manifests",
        "--k", 3, 0, 1,
        "--json",
    )  # fmt: skip
    assert code == 0
    assert json.loads(out) == {
        "out": str(tmp_path / "manifests"),
        "buffers": 24,
        "queries": 8,
        "sessions": 8 * (1 + 2 + 4),
    }
    for name in ("buffers.parquet", "buffers.jsonl", "manifest.json"):
        made = (tmp_path / "manifests" / name).read_bytes()
        assert made == (root / "manifests" / name).read_bytes()
