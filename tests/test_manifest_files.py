"""The manifest files: what is in them, runs that break off, and the command."""

import fcntl
import hashlib
import itertools
import json
from pathlib import Path

import made_splits
import pyarrow.parquet as pq
import pytest
from made_splits import named, queries, units, write
from recordings import contents
from typer.testing import CliRunner

from robomme_interference_data import Dataset
from robomme_interference_data.build_dataset import manifest_rows, manifests
from robomme_interference_data.build_dataset.manifests import (
    plan_manifests,
    write_manifests,
)
from robomme_interference_data.cli import app
from robomme_interference_data.errors import (
    BuildError,
    InvalidOptionError,
)
from robomme_interference_data.manifest_io import SCHEMA

K = (0, 1, 3)
FILES = ["buffers.jsonl", "buffers.parquet", "manifest.json"]


@pytest.fixture(name="pair")
def _pair() -> tuple[Dataset, Dataset]:
    return made_splits.pair()


# --- files --------------------------------------------------------------------------------------


def test_header(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    write(plan_manifests(*pair, (1, 3), seed=7), tmp_path)
    files = {name: (tmp_path / name).read_bytes() for name in FILES[:2]}
    assert json.loads((tmp_path / "manifest.json").read_text()) == {
        "format_version": 1,
        "rule_version": 1,
        "seed": 7,
        "k": [1, 3],
        "position_limit": 4096,
        "datasets": {
            "demonstrations": {
                "name": "demonstrations",
                "version": "1.0.0",
                "revision": pair[0].revision,
                "exact": True,
                "simulators": ["made-up"],
                "counts": {
                    "episodes": 6,
                    "frames": 36,
                    "families": {"MoveCube": 3, "InsertPeg": 2, "Drawer": 1},
                },
            },
            "distractors": {
                "name": "distractors",
                "version": "1.0.0",
                "revision": pair[1].revision,
                "exact": True,
                "simulators": ["made-up"],
                "counts": {
                    "episodes": 9,
                    "frames": 288,
                    "families": {"MoveCube": 3, "InsertPeg": 2, "PatternLock": 3, "Drawer": 1},
                },
            },
        },
        # Six queries, two buffers each, of 2 and 4 sessions.
        "counts": {"queries": 6, "buffers": 12, "sessions": 36},
        "files": {
            name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            for name, data in files.items()
        },
    }


def test_json_lines_are_the_rows(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    rows = write(plan_manifests(*pair, K), tmp_path)
    lines = (tmp_path / "buffers.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line) for line in lines] == rows
    assert all(list(json.loads(line)) == SCHEMA.names for line in lines)
    assert pq.read_schema(tmp_path / "buffers.parquet") == SCHEMA


def test_json_lines_with_letters_of_all_kinds(tmp_path: Path) -> None:
    goal = 'place the „Würfel"\n立方体'
    demonstrations = queries(tmp_path / "d", ["MoveCube/test/0"], goals=(goal,))
    plan = plan_manifests(demonstrations, units(tmp_path / "u", ["Drawer/train/0"]), (0, 1))
    rows = write(plan, tmp_path / "out")
    lines = (tmp_path / "out/buffers.jsonl").read_text(encoding="utf-8").split("\n")
    assert [json.loads(line) for line in lines if line] == rows
    assert rows[0]["goals"] == [goal]
    assert "立方体" in lines[0]


def test_the_same_inputs_give_the_same_bytes(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    write(plan_manifests(*pair, (0, 1, 3)), tmp_path / "one")
    reopened = [Dataset(dataset.files) for dataset in pair]
    write(plan_manifests(*reopened, (3, 1, 0)), tmp_path / "two")
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    assert sorted(contents(tmp_path)) == [f"{n}/{f}" for n in ("one", "two") for f in FILES]


def test_batches_do_not_show(
    pair: tuple[Dataset, Dataset], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_manifests(*pair, K)
    assert list(write_manifests(plan, tmp_path / "one")) == [6]
    monkeypatch.setattr(manifest_rows, "BATCH", 4)
    assert list(write_manifests(plan, tmp_path / "two")) == [4, 2]
    jsonl = [(tmp_path / name / "buffers.jsonl").read_bytes() for name in ("one", "two")]
    assert jsonl[0] == jsonl[1]
    tables = [pq.read_table(tmp_path / name / "buffers.parquet") for name in ("one", "two")]
    assert tables[0] == tables[1]
    groups = pq.ParquetFile(tmp_path / "two/buffers.parquet").metadata
    assert max(groups.row_group(i).num_rows for i in range(groups.num_row_groups)) == 4


# --- interrupted writing ------------------------------------------------------------------------


def vouched(out: Path) -> None:
    """If there is a manifest.json, the files that it names are the ones that it names."""
    assert set(contents(out)) <= set(FILES)
    if (out / "manifest.json").exists():
        for name, recorded in json.loads((out / "manifest.json").read_text())["files"].items():
            data = (out / name).read_bytes()
            assert recorded == {
                "bytes": len(data),
                "sha256": hashlib.sha256(data).hexdigest(),
            }


def test_an_abandoned_run_leaves_nothing(
    pair: tuple[Dataset, Dataset], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(manifest_rows, "BATCH", 2)
    running = write_manifests(plan_manifests(*pair, K), tmp_path / "out")
    assert next(running) == 2
    running.close()
    assert contents(tmp_path) == {}
    write(plan_manifests(*pair, K), tmp_path / "out")
    before = contents(tmp_path)
    running = write_manifests(plan_manifests(*pair, K, seed=1), tmp_path / "out")
    next(running)
    running.close()
    assert contents(tmp_path) == before
    vouched(tmp_path / "out")


@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.parametrize("step", range(5))
def test_a_failure_at_any_step_vouches_for_nothing_wrong(
    pair: tuple[Dataset, Dataset],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    step: int,
    existing: bool,
) -> None:
    """The steps: the files are renamed, then hashed, then manifest.json is renamed."""
    out = tmp_path / "out"
    if existing:
        write(plan_manifests(*pair, K), out)
    calls = itertools.count()

    def failing(real):
        def call(*arguments):
            if next(calls) == step:
                raise OSError("no more space")
            return real(*arguments)

        return call

    plan = plan_manifests(*pair, K, seed=1)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", failing(Path.replace))
        patch.setattr(manifests, "sha256_file", failing(manifests.sha256_file))
        with pytest.raises(OSError, match="no more space"):
            write(plan, out)
    vouched(out)
    assert not (out / "manifest.json").exists()
    # The same command completes.
    write(plan, out)
    vouched(out)
    write(plan, tmp_path / "undisturbed")
    assert contents(out) == contents(tmp_path / "undisturbed")
    assert {path.name for path in tmp_path.iterdir()} == {"out", "undisturbed"}


def test_what_a_killed_run_left_is_cleared(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / ".buffers.parquet.a1b2c3d4.partial").write_bytes(b"half")
    (out / ".buffers.jsonl.a1b2c3d4.partial").write_bytes(b"half")
    (tmp_path / ".out.building").mkdir()
    (tmp_path / ".out.building/lock").touch()
    write(plan_manifests(*pair, K), out)
    assert sorted(contents(out)) == FILES
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_old_files_are_replaced(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    write(plan_manifests(*pair, (0, 1, 3)), tmp_path / "out")
    write(plan_manifests(*pair, (1,), seed=1), tmp_path / "out")
    write(plan_manifests(*pair, (1,), seed=1), tmp_path / "other")
    assert contents(tmp_path / "out") == contents(tmp_path / "other")


def test_foreign_places_are_refused(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/notes.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    before = contents(tmp_path)
    for name, message in (("folder", "holds no manifests, but notes.txt"), ("file", "is a file")):
        with pytest.raises(BuildError, match=message) as raised:
            write(plan_manifests(*pair, K), tmp_path / name)
        assert "Choose another --out." in str(raised.value)
    assert contents(tmp_path) == before


def test_two_runs_at_once(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    work = tmp_path / ".out.building"
    work.mkdir()
    with (work / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(BuildError, match=r"another build of .*/out is running"):
            write(plan_manifests(*pair, K), tmp_path / "out")
    assert not (tmp_path / "out").exists()


# --- the command --------------------------------------------------------------------------------


def run(pair: tuple[Dataset, Dataset], out: Path, *arguments: str):
    demonstrations, distractors = (str(dataset.files.describe()) for dataset in pair)
    places = ["--demonstrations", demonstrations, "--distractors", distractors, "--out", str(out)]
    return CliRunner().invoke(app, ["build", "manifests", *places, *arguments])


def test_command(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    done = run(pair, tmp_path / "out", "--k", "0", "3", "--seed", "5", "--json")
    assert done.exit_code == 0
    assert json.loads(done.stdout) == {
        "out": str(tmp_path / "out"),
        "queries": 6,
        "buffers": 12,
        "sessions": 30,
    }
    write(plan_manifests(*pair, (0, 3), seed=5), tmp_path / "other")
    assert contents(tmp_path / "out") == contents(tmp_path / "other")


def test_command_with_defaults(tmp_path: Path, pair: tuple[Dataset, Dataset]) -> None:
    distractors = units(tmp_path / "u", named({"PatternLock": 7}))
    done = run((pair[0], distractors), tmp_path / "out")
    assert done.exit_code == 0
    header = json.loads((tmp_path / "out/manifest.json").read_text())
    assert (header["k"], header["seed"], header["position_limit"]) == ([0, 1, 3, 7], 0, 4096)


def test_command_without_a_limit(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    assert run(pair, tmp_path, "--k", "1", "--position-limit", "none").exit_code == 0
    assert json.loads((tmp_path / "manifest.json").read_text())["position_limit"] is None


@pytest.mark.parametrize("limit", ["0", "-5", "many", "4096.0", "²", ""])
def test_command_with_a_limit_that_is_none(
    pair: tuple[Dataset, Dataset], tmp_path: Path, limit: str
) -> None:
    done = run(pair, tmp_path / "out", "--k", "1", "--position-limit", limit)
    assert isinstance(done.exception, InvalidOptionError)
    assert "expected a positive number or none" in str(done.exception)
    assert not (tmp_path / "out").exists()
