"""The files of a run, held against golden ones, and the command that writes them."""

import inspect
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import factories
import pyarrow.parquet as pq
import pytest
import rollout_doubles
from typer.testing import CliRunner

from robomme_interference_data.cli import app, spread
from robomme_interference_data.errors import FormatError, InvalidIdError, InvalidOptionError
from robomme_interference_data.evaluate import log as log_module
from robomme_interference_data.evaluate.log import open_log, read_log
from robomme_interference_data.evaluate.rows import Rollout, condition_rank

GOLDEN = Path(__file__).parent / "golden" / "run"

ROW: dict[str, Any] = {
    "system": "replay-full",
    "simulator": "tabletop",
    "split": "my-split",
    "revision": "ab" * 32,
    "family": "MoveCube",
    "condition": "k7",
    "episode_split": "test",
    "episode": 3,
    "model_seed": 0,
    "protocol_version": 1,
    "seed": 19803,
    "difficulty": "easy",
    "goal": 'move the "red" cube, in the same manner',
    "status": "success",
    "success": True,
    "steps": 151,
    "history_frames": 410,
    "lesson_frames": 186,
    "lesson_share": 0.46875,
    "reset_s": 0.5,
    "history_s": 0.25,
    "policy_s": 0.0125,
    "simulator_s": 1.5,
    "wall_s": 2.5,
    "finished_at": "2026-01-31T12:00:00Z",
}


def rows() -> list[Rollout]:
    retrieved = {
        "condition": "k0",
        "status": "timeout",
        "success": False,
        "steps": 1300,
        "retrieval_model": "thumbnail/max/adaptive",
        "retrieval_start": 0,
        "retrieval_stop": 186,
        "retrieval_selected_lesson_fraction": 0.96875,
        "retrieval_selected_filler_fraction": 0.0,
        "retrieval_selected_query_fraction": 0.03125,
    }
    broken = {
        "condition": "no-history",
        "status": "error",
        "success": None,
        "steps": 0,
        "lesson_share": None,
        "history_frames": 0,
        "lesson_frames": 0,
        "error": "TimeoutError: still running after 8 s",
        "attempt": 2,
    }
    return [Rollout(**ROW), Rollout(**ROW | retrieved), Rollout(**ROW | broken)]


def test_golden_files(tmp_path: Path) -> None:
    with open_log(tmp_path / "run", {"system": "replay-full", "protocol_version": 1}) as log:
        for row in rows():
            log.append(row)
        order = {row.key: place for place, row in enumerate(reversed(rows()))}
        log.write_tables(order)
    for name in ("rollouts.jsonl", "rollouts.csv", "run.json"):
        assert (tmp_path / "run" / name).read_text() == (GOLDEN / name).read_text(), name
    table = pq.read_table(tmp_path / "run" / "rollouts.parquet")
    assert table.to_pylist() == [row.as_dict() for row in reversed(rows())]


def test_golden_files_are_read() -> None:
    assert list(read_log(GOLDEN).values()) == rows()


def test_a_finished_row_is_not_written_twice(tmp_path: Path) -> None:
    with open_log(tmp_path / "run", {}) as log:
        log.append(rows()[2])
        log.append(rows()[2])  # an error may come again
        log.append(rows()[0])
        with pytest.raises(FormatError, match="has a row of"):
            log.append(rows()[0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"status": "ongoing"}, "status 'ongoing' is none of success, fail, timeout, error"),
        ({"success": False}, "success False contradicts status 'success'; expected True"),
        ({"status": "error"}, "success True contradicts status 'error'; expected None"),
        ({"steps": 1301}, "steps 1301; expected 0 to 1300"),
    ],
)
def test_a_row_checks_itself(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        Rollout(**ROW | changes)


def test_conditions_are_ranked() -> None:
    names = ["k7", "no-history", "k0", "k63", "k1"]
    assert sorted(names, key=condition_rank) == ["no-history", "k0", "k1", "k7", "k63"]
    with pytest.raises(InvalidIdError, match="'K0' is not a condition"):
        condition_rank("K0")


def test_the_command_writes_the_rows_as_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(rollout_doubles.SPLIT, str(factories.split()))
    line = "evaluate --policy hold --simulator rollout_doubles:World --families MoveCube "
    line += "VideoRepick --conditions no-history k1 --episodes 0 --json"
    words = [*line.split(), "--split", str(factories.split()), "--out", str(tmp_path / "run")]
    done = CliRunner().invoke(app, spread(words))
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert [(row["family"], row["condition"], row["status"]) for row in found] == [
        ("VideoRepick", "no-history", "fail"),
        ("VideoRepick", "k1", "fail"),
        ("MoveCube", "no-history", "fail"),
        ("MoveCube", "k1", "fail"),
    ]


def test_memory_belongs_to_replay(tmp_path: Path) -> None:
    words = ["evaluate", "--policy", "hold", "--memory", "full", "--split", ".", "--out", "x"]
    with pytest.raises(InvalidOptionError, match="only replay has memory rules"):
        CliRunner().invoke(app, words, catch_exceptions=False)


def test_help_is_whole_at_80_columns(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from robomme_interference_data.evaluate import commands

    monkeypatch.setenv("COLUMNS", "80")
    _, out, _ = run("evaluate", "--help")
    names = [name for name in inspect.signature(commands.evaluate).parameters if name != "as_json"]
    assert len(names) > 20
    for name in names:
        assert f"--{name.replace('_', '-')} " in out
    # The examples are as they can be typed: a command begins a line, and goes on in the next.
    lines = [line.strip() for line in out.splitlines()]
    place = lines.index("robomme-interference evaluate --policy replay --shard 2/8 \\")
    assert lines[place + 1] == "--split S --out runs/shard-2"


def test_options_of_the_policy_are_typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(rollout_doubles.SPLIT, str(factories.split()))
    line = "evaluate --policy python:own_policies:Still --simulator rollout_doubles:World "
    line += "--families MoveCube --conditions no-history --episodes 0 --json "
    line += "--policy-option gripper=-1"
    words = [*line.split(), "--split", str(factories.split()), "--out", str(tmp_path / "run")]
    done = CliRunner().invoke(app, spread(words))
    assert done.exit_code == 0, done.output
    header = json.loads((tmp_path / "run" / "run.json").read_text())
    assert header["identity"]["policy_options"] == {"gripper": -1}
    with pytest.raises(InvalidOptionError, match="speed") as raised:
        CliRunner().invoke(
            app, spread([*words, "--policy-option", "speed=1"]), catch_exceptions=False
        )
    assert raised.value.hint == "Its options: gripper."


def test_a_full_disk_names_the_file_and_the_command_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setenv(rollout_doubles.SPLIT, str(factories.split()))
    monkeypatch.setattr(log_module, "os", SimpleNamespace(fsync=full))
    out = tmp_path / "run"
    line = "evaluate --policy hold --simulator rollout_doubles:World --families MoveCube "
    line += "--conditions no-history --episodes 0"
    words = [*line.split(), "--split", str(factories.split()), "--out", str(out)]
    done = CliRunner().invoke(app, words)
    assert isinstance(done.exception, OSError)
    assert done.exception.filename == str(out / "rollouts.jsonl")
    assert f"Finished rollouts are in {out}; once mended, go on with:\nrobomme-inter" in done.stderr


def test_the_help_of_merge_is_whole_in_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = CliRunner().invoke(app, ["merge", "--help"]).stdout
    options = text[text.index("Options") :]
    assert "--out " in options and not re.search(r"--[a-z-]+…", options)
    assert re.search(
        r"^ *robomme-interference merge [^\n]*(\\| --out runs/whole) *$", text, re.MULTILINE
    )
