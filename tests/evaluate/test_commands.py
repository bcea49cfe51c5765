"""The commands `evaluate` and `merge`: what is typed, what is printed, and how one goes on."""

import json
import resource
from pathlib import Path
from typing import Any

import pytest
import typer
from support.runs import run_one
from typer.testing import CliRunner

from robomme_interference_data.evaluate import commands
from robomme_interference_data.evaluate.run import evaluation as run_module
from robomme_interference_data.runtime.executor import Serial

pytestmark = pytest.mark.usefixtures("trouble", "_serial")

APP = typer.Typer(rich_markup_mode="markdown", pretty_exceptions_enable=False)
APP.command()(commands.evaluate)
APP.command()(commands.merge)
APP.command()(commands.ceiling)
OWN = "python:support.own_policies:"
USUAL = "--simulator support.worlds:World --system mine --episodes 0"


@pytest.fixture
def _serial(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_module, "make_executor", lambda config: Serial())


def type_in(line: str) -> Any:
    return CliRunner().invoke(APP, line.split())


def test_ceiling_prints_a_table_or_json(tiny_buffers: Path) -> None:
    line = f"ceiling {tiny_buffers} --memory window --conditions k0,k1"
    done = type_in(line)
    assert done.exit_code == 0, done.output
    lines = [line.split() for line in done.stdout.splitlines()]
    assert ["MoveCube", "k0", "1", "50.0%"] in lines and ["all", "k1", "3", "0.0%"] in lines
    cells = json.loads(type_in(f"{line} --json").stdout)
    assert cells[0] == {
        "family": "VideoRepick",
        "condition": "k0",
        "queries": 1,
        "evidence_kept": 0.5,
        "success": None,
    }


@pytest.mark.parametrize("families", ["MoveCube --families VideoRepick", "MoveCube,VideoRepick"])
def test_evaluate_writes_the_rows_as_json(
    tmp_path: Path, tiny_buffers: Path, families: str
) -> None:
    line = f"evaluate {tiny_buffers} --policy noop {USUAL} --families {families}"
    line += " --conditions no-history,k1 --json"
    done = type_in(f"{line} --out {tmp_path / 'run'}")
    assert done.exit_code == 0, done.output
    assert [
        (row["family"], row["condition"], row["status"]) for row in json.loads(done.stdout)
    ] == [
        ("VideoRepick", "no-history", "fail"),
        ("VideoRepick", "k1", "fail"),
        ("MoveCube", "no-history", "fail"),
        ("MoveCube", "k1", "fail"),
    ]


def test_options_of_the_policy_are_typed(tmp_path: Path, tiny_buffers: Path) -> None:
    line = f"evaluate {tiny_buffers} --policy {OWN}Still {USUAL} --families MoveCube"
    line += f" --out {tmp_path / 'run'} --policy-option gripper=-1"
    done = type_in(line)
    assert done.exit_code == 0, done.output
    assert "1 of 1 rollouts in" in done.stdout and "0/1 0%" in done.stdout
    header = json.loads((tmp_path / "run" / "run.json").read_text())
    assert header["identity"]["policy_options"] == {"gripper": -1}


def test_what_broke_is_told_with_the_command_to_go_on(
    tmp_path: Path, trouble: Path, tiny_buffers: Path
) -> None:
    (trouble / "MoveCube-0").write_text("raise")
    line = (
        f"evaluate {tiny_buffers} --policy noop {USUAL} --families MoveCube --conditions no-history"
    )
    done = type_in(f"{line} --out {tmp_path / 'run'} --max-errors 1")
    assert done.exit_code == 1
    assert "1 rollouts broke (see" in done.stderr
    assert "Stopped: 1 in a row broke" in done.stderr
    assert done.stderr.rstrip().splitlines()[-1].startswith("robomme-interference")


def test_a_full_disk_names_the_file_and_the_command_to_go_on(
    tmp_path: Path, tiny_buffers: Path
) -> None:
    line = f"evaluate {tiny_buffers} --policy {OWN}Filler {USUAL} --families MoveCube"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        done = type_in(f"{line} --out {tmp_path / 'run'}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert isinstance(done.exception, OSError)
    assert done.exception.filename == str(tmp_path / "run" / "rollouts.jsonl")
    assert f"Finished rollouts are in {tmp_path / 'run'}" in done.stderr
    assert "resume with:\nrobomme-interference" in done.stderr


@pytest.mark.parametrize("begun", [True, False])
def test_a_stop_tells_of_rollouts_only_where_there_are_some(
    begun: bool, tmp_path: Path, tiny_buffers: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(run_module, "_run_items" if begun else "plan_work", stop)
    line = f"evaluate {tiny_buffers} --policy noop {USUAL} --families MoveCube"
    done = type_in(f"{line} --out {tmp_path / 'run'}")
    assert done.exit_code == 130 and "resume with:\nrobomme-interference" in done.stderr
    assert (f"Finished rollouts are in {tmp_path / 'run'}" in done.stderr) == begun


def test_merge_tells_what_is_missing_and_double(tmp_path: Path) -> None:
    run_one(tmp_path / "a", shard="1/1", conditions=("no-history", "k0"))
    log = tmp_path / "a" / "rollouts.jsonl"
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:1]))
    line = f"merge {tmp_path / 'a'} {tmp_path / 'a'} --out"
    done = type_in(f"{line} {tmp_path / 'merged'}")
    assert done.exit_code == 0, done.output
    assert "1 missing: MoveCube/test/0 under" in done.stderr
    assert "1 in more than one run, the first one kept: MoveCube/test/0" in done.stderr
    assert "1 of 2 rollouts in " in done.stdout
    told = json.loads(type_in(f"{line} {tmp_path / 'again'} --json").stdout)
    assert (told["planned"], told["rows"], len(told["missing"])) == (2, 1, 1)
    assert told["missing"][0]["episode"] == "MoveCube/test/0"
    assert told["conflicts"] == told["broken"] == []
