"""Rollouts that break in a run: errors on record, run again, and when the run stops."""

import json
from pathlib import Path

import factories
import pyarrow.parquet as pq
import pytest
from run_calls import run

pytestmark = pytest.mark.usefixtures("troubled_world")


def trouble(tmp_path: Path, episode: str, kind: str) -> None:
    (tmp_path / "trouble" / episode).write_text(kind)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("raise", "SimulatorCrashError: the world fell apart (Pick it up.)"),
        ("error", "RolloutError: the rollout_doubles:World simulator reported an error at step 7"),
        ("die", "RuntimeError: the worker process died (exit code -9)"),
        ("hang", "TimeoutError: still running after 8 s"),
    ],
)
def test_a_rollout_that_breaks_is_an_error_and_run_again(
    tmp_path: Path, kind: str, message: str
) -> None:
    trouble(tmp_path, "MoveCube-0", kind)
    options = {"families": ["MoveCube", "PatternLock"], "rollout_s": 8.0}
    result = run(tmp_path / "run", **options)
    broken = [row for row in result.rows if row.status == "error"]
    # The cheat succeeds at its first step with the lesson: only no-history gets to the trouble.
    assert [(row.family, row.episode, row.condition) for row in broken] == [
        ("MoveCube", 0, "no-history")
    ]
    assert broken[0].error == message
    assert broken[0].success is None
    assert broken[0].attempt == (2 if kind in ("die", "hang") else 1)
    assert result.counts["error"] == 1 and len(result.rows) == 8
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "incomplete"
    if kind in ("raise", "error"):
        log = (tmp_path / "run" / "errors.log").read_text()
        assert "MoveCube/test/0 no-history, attempt 1" in log and "Traceback" in log

    (tmp_path / "trouble" / "MoveCube-0").unlink()
    again = run(tmp_path / "run", **options)
    assert again.counts == {"success": 4, "fail": 3, "timeout": 1, "error": 0}
    mended = next(r for r in again.rows if r.key == broken[0].key)
    assert mended.attempt == broken[0].attempt + 1
    table = pq.read_table(tmp_path / "run" / "rollouts.parquet").to_pylist()
    assert [row["status"] for row in table].count("error") == 0


def test_a_simulator_that_hangs_is_an_error_with_its_traceback(tmp_path: Path) -> None:
    trouble(tmp_path, "MoveCube-0", "hang")
    result = run(tmp_path / "run", families=["MoveCube"], simulator_s=8.0)
    (broken,) = [row for row in result.rows if row.status == "error"]
    assert (broken.condition, broken.episode, broken.attempt) == ("no-history", 0, 2)
    assert broken.error == "the simulator hung: no answer for 8 s"
    log = (tmp_path / "run" / "errors.log").read_text()
    assert log.count("Timeout (0:00:08)!") == 1  # that of the second time
    assert "rollout_doubles.py" in log and "in step" in log


def test_what_a_hung_worker_said_is_told_of_no_other_rollout(tmp_path: Path) -> None:
    trouble(tmp_path, "MoveCube-0", "hang once")
    options = {"conditions": ["no-history"], "episodes": "0", "simulator_s": 8.0}
    hung = run(tmp_path / "run", families=["MoveCube"], **options)
    assert [(row.status, row.attempt) for row in hung.rows] == [("fail", 2)]
    trouble(tmp_path, "PatternLock-0", "die")
    died = run(tmp_path / "run", families=["PatternLock"], **options)
    assert [row.error for row in died.rows] == [
        "RuntimeError: the worker process died (exit code -9)"
    ]
    assert not (tmp_path / "run" / "errors.log").exists()


def test_a_worker_that_dies_once_is_replaced(tmp_path: Path) -> None:
    trouble(tmp_path, "MoveCube-0", "die once")
    result = run(tmp_path / "run", families=["MoveCube"], workers=2)
    assert result.counts == {"success": 2, "fail": 1, "timeout": 1, "error": 0}
    died = next(row for row in result.rows if row.condition == "no-history" and row.episode == 0)
    assert died.attempt == 2


def test_a_run_in_which_everything_breaks_stops(tmp_path: Path) -> None:
    for family in factories.FAMILIES:
        for index in (0, 1):
            trouble(tmp_path, f"{family}-{index}", "raise")
    result = run(tmp_path / "run", conditions=["no-history"], max_errors=3)
    assert result.stopped is not None
    assert result.stopped.startswith("3 rollouts in a row broke; the last: SimulatorCrashError")
    assert len(result.rows) == 3 and result.planned == 8
