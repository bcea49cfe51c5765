"""A whole run in this process: rows, resume, what breaks, and when it stops."""

import fcntl
import shutil
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.buffer_sets import copy_buffer_set
from support.messages import raises
from support.retrieval import make_index
from support.runs import header, run, run_one, untimed
from support.worlds import World

from robomme_interference_data.errors import HashMismatchError, RunError, SimulatorCrashError
from robomme_interference_data.evaluate.rollout import worker
from robomme_interference_data.evaluate.rollout.worker import StartSimulator
from robomme_interference_data.evaluate.run.row import read_record
from robomme_interference_data.evaluate.score.config import Expected, Settings
from robomme_interference_data.evaluate.score.partners import base_of
from robomme_interference_data.evaluate.score.scoring import score
from robomme_interference_data.evaluate.systems import FACT_COLUMNS
from robomme_interference_data.runtime.executor import Outcome, Serial

pytestmark = pytest.mark.usefixtures("trouble")


# --- rows --------------------------------------------------------------------------------------


def test_a_run_writes_a_row_for_every_rollout(tmp_path: Path) -> None:
    result = run(tmp_path / "run", conditions=("k7", "no-history", "k0"))
    assert result.counts == {"success": 4, "fail": 2, "timeout": 0, "error": 0}
    assert (result.planned, result.stopped, result.folder) == (6, None, tmp_path / "run")
    found, conditions = header(tmp_path / "run"), ["no-history", "k0", "k7"]
    assert [(row.family, row.condition) for row in result.rows] == [
        (family, condition) for family in ("VideoRepick", "MoveCube") for condition in conditions
    ]
    assert (found["status"], found["planned"], found["counts"]) == ("complete", 6, result.counts)
    episodes = {"VideoRepick/test": "0", "MoveCube/test": "0"}
    assert found["plans"] == [{"episodes": episodes, "conditions": conditions, "shard": "1/1"}]
    (start,) = found["invocations"]
    assert start["policy"] == {"policy": "cheat"} and start["started"] <= start["ended"]
    assert {"numpy", "python", "robomme-interference-data"} <= set(start["versions"])
    assert start["settings"]["conditions"] == ["k7", "no-history", "k0"]
    frame, stored = result.to_pandas(), pandas.read_parquet(tmp_path / "run" / "rollouts.parquet")
    pandas.testing.assert_frame_equal(frame, stored)
    assert frame["success"].tolist() == [row.success for row in result.rows]


def test_rows_and_run_json_have_the_facts_of_the_system(tmp_path: Path) -> None:
    buffer_set = copy_buffer_set(tmp_path / "buffer_set")
    make_index(buffer_set)
    settings = {"buffer_set": buffer_set, "families": ("MoveCube",), "conditions": ("k1",)}

    def facts(name: str, **changes: Any) -> dict[str, Any]:
        (row,) = run(tmp_path / name, **settings, system=name, **changes).rows
        stated: dict[str, Any] = header(tmp_path / name)["identity"]["facts"]
        assert stated == {column: getattr(row, column) for column in FACT_COLUMNS}
        return stated

    plain = facts("a", policy="replay:window:8")
    assert (plain["policy"], plain["memory"], plain["retrieval"]) == ("replay", "window:8", None)
    step = facts("b", policy="replay:window:8", retrieval="thumbnail")
    assert step == plain | {"retrieval": "thumbnail/max/adaptive"}  # whatever their labels
    other = facts("c", policy="replay:window:8", policy_options=("extrapolate=true",))
    assert other["policy_id"] != plain["policy_id"] and not plain["reference"]
    cheat = facts("d")
    assert (cheat["policy"], cheat["memory"], cheat["reads_history"]) == ("python", None, True)
    rows = [tmp_path / name for name in "abcd"]
    (outcomes,) = score(Settings(rows=rows, expected=Expected.OBSERVED)).outcomes.values()
    assert [base_of(outcomes, name) for name in "abcd"] == [None, "a", None, None]


# --- resume ------------------------------------------------------------------------------------


def test_a_resumed_run_skips_finished_rollouts(tmp_path: Path) -> None:
    first = run(tmp_path / "run")
    log = tmp_path / "run" / "rollouts.jsonl"
    text = log.read_bytes()
    assert run(tmp_path / "run", workers=2).rows == first.rows
    assert log.read_bytes() == text
    assert len(header(tmp_path / "run")["invocations"]) == 2
    log.write_bytes(text[:-20])  # torn
    assert untimed(run(tmp_path / "run").rows) == untimed(first.rows)
    assert len(log.read_bytes().splitlines()) == 4


def test_a_run_may_grow_and_keeps_all_its_plans(tmp_path: Path) -> None:
    out, one = tmp_path / "run", {"families": ("MoveCube",), "conditions": ("k0",)}
    run(out, **one)
    grown = run(out, conditions=("no-history", "k0"))
    assert len(grown.rows) == 4
    assert pq.read_table(out / "rollouts.parquet")["condition"].to_pylist() == [
        *("no-history", "k0", "no-history", "k0")
    ]
    # A smaller plan keeps the rows of the larger one.
    assert run(out, **one).planned == 1
    found = header(out)
    assert (found["planned"], len(found["plans"]), found["status"]) == (4, 2, "complete")


class Impatient:
    """Progress that reads the header at the start, and presses Ctrl-C at the first row."""

    def __init__(self, out: Path):
        self.out = out

    def start(self, items: Any, done: Any) -> None:
        self.seen = header(self.out)

    def row(self, row: Any, node: Any) -> None:
        raise KeyboardInterrupt


def test_the_header_states_the_status_from_the_start_and_after_ctrl_c(tmp_path: Path) -> None:
    out = tmp_path / "run"
    impatient = Impatient(out)
    with pytest.raises(KeyboardInterrupt):
        run(out, progress=impatient)
    begun = impatient.seen
    assert (begun["status"], begun["planned"]) == ("running", 4)
    assert set(begun["counts"].values()) == {0} and begun["invocations"][0]["ended"] is None
    found = header(out)
    assert (found["status"], sum(found["counts"].values())) == ("incomplete", 1)
    assert found["invocations"][0]["stopped"] == "interrupted"
    assert pq.read_metadata(out / "rollouts.parquet").num_rows == 1
    assert len((out / "rollouts.csv").read_text().splitlines()) == 2
    run(out)
    assert [one["stopped"] for one in header(out)["invocations"]] == ["interrupted", None]


# --- what breaks -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "error", "attempts", "steps"),
    [
        # A simulator that crashed is tried again; an error that it reports itself is final.
        ("raise", "SimulatorCrashError: the world fell apart (Pick it up.)", 2, 4),
        ("error", "RunError: the support.worlds:World simulator reported an error at step", 1, 7),
    ],
)
def test_a_rollout_that_breaks_is_an_error_row_and_runs_again_on_resume(
    tmp_path: Path, trouble: Path, kind: str, error: str, attempts: int, steps: int
) -> None:
    (trouble / "MoveCube-0").write_text(kind)
    result = run(tmp_path / "run")
    # The cheat succeeds at its first step with the lesson: only no-history gets to the trouble.
    (broken,) = [row for row in result.rows if row.status == "error"]
    assert (broken.family, broken.condition) == ("MoveCube", "no-history")
    assert broken.error is not None and broken.error.startswith(error)
    assert (broken.success, broken.attempt, broken.difficulty) == (None, attempts, "easy")
    assert (broken.steps, broken.model_calls) == (steps, None)
    assert broken.seed == result.rows[-1].seed
    assert header(tmp_path / "run")["status"] == "incomplete"
    log = (tmp_path / "run" / "errors.log").read_text()
    assert f"MoveCube/test/0 under no-history, attempt {attempts}\nTraceback" in log

    (trouble / "MoveCube-0").unlink()
    again = run(tmp_path / "run")
    assert again.counts == {"success": 2, "fail": 2, "timeout": 0, "error": 0}
    assert [row.attempt for row in again.rows] == [1, 1, attempts + 1, 1]
    # Why the first attempt failed stays known, whoever repeated it.
    assert [row.repeated_because for row in again.rows] == [None, None, broken.error, None]


def test_a_simulator_that_crashes_once_costs_no_rollout(tmp_path: Path, trouble: Path) -> None:
    (trouble / "MoveCube-0").write_text("raise once")
    (row,) = run_one(tmp_path / "run").rows
    why = "SimulatorCrashError: the world fell apart (Pick it up.)"
    assert (row.status, row.attempt, row.error, row.repeated_because) == ("fail", 2, None, why)
    log = (tmp_path / "run" / "errors.log").read_text()
    assert f"MoveCube/test/0 under no-history, attempt 2\nThe first attempt failed: {why}\n" in log
    assert "Traceback" in log


def test_a_crashed_simulator_is_not_used_again(
    tmp_path: Path, trouble: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[World] = []

    def close(self: World) -> None:
        closed.append(self)

    monkeypatch.setattr(World, "close", close)
    (trouble / "VideoRepick-0").write_text("raise")
    run(tmp_path / "run", conditions=("no-history",))
    # After each attempt of the one that broke; the other episode has the second attempt's world.
    assert len(closed) == len(set(map(id, closed))) == 2


def test_text_that_files_cannot_hold_is_escaped(tmp_path: Path) -> None:
    (row,) = run_one(tmp_path / "run", policy="python:support.own_policies:Broken").rows
    assert row.error == r"ValueError: no such file: caf\udce9 in two lines"
    assert r"caf\udce9" in (tmp_path / "run" / "errors.log").read_text()
    assert pq.read_table(tmp_path / "run" / "rollouts.parquet")["error"][0].as_py()


def test_a_number_that_files_cannot_hold_is_an_error_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    roll = worker.run_rollout
    monkeypatch.setattr(
        worker, "run_rollout", lambda *args, **named: replace(roll(*args, **named), seed=10**30)
    )
    (row,) = run_one(tmp_path / "run").rows
    assert row.status == "error" and "cannot be stored: " in str(row.error)
    assert read_record(tmp_path / "run")


def test_a_run_stops_after_max_errors_in_a_row(tmp_path: Path, trouble: Path) -> None:
    for family in ("VideoRepick", "MoveCube"):
        (trouble / f"{family}-0").write_text("raise")
    result = run(tmp_path / "run", conditions=("no-history",), max_errors=1)
    assert result.stopped is not None
    assert result.stopped.startswith("1 in a row broke; the last: SimulatorCrashError")
    assert (len(result.rows), result.planned) == (1, 2)


def test_a_run_without_workers_stops_with_the_reason(tmp_path: Path) -> None:
    class Lost(Serial):
        @contextmanager
        def pool(self, function: Any) -> Iterator[Any]:
            yield self

        def run(self, tasks: Any, **_: Any) -> Generator[Outcome]:
            if isinstance(tasks[0], StartSimulator):
                yield Outcome(tasks[0])
                return
            raise SimulatorCrashError("nobody is left")

    with pytest.raises(SimulatorCrashError):
        run(tmp_path / "run", executor=Lost())
    assert header(tmp_path / "run")["invocations"][0]["stopped"] == "nobody is left"


# --- folders -----------------------------------------------------------------------------------


def test_folders_that_are_errors(tmp_path: Path) -> None:
    out, other = tmp_path / "run", tmp_path / "other"
    run_one(out)
    with raises(RunError):
        run_one(out, no_resume=True)
    with (out / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with raises(RunError):
            run_one(out)
    (out / "rollouts.jsonl").unlink()
    with raises(RunError):
        run_one(out)
    other.mkdir()
    (other / "thesis.tex").write_text("…")
    with raises(RunError):
        run_one(other)
    assert [path.name for path in other.iterdir()] == ["thesis.tex"]


def test_a_run_that_stopped_before_its_header_starts_over(tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    (out / "rollouts.jsonl").touch()  # what a full disk, or a kill, leaves
    assert len(run(out).rows) == 4
    for name in ("run.json", "rollouts.csv", "rollouts.parquet"):
        (out / name).unlink()
    with raises(RunError):  # rows are never begun again
        run(out)


def test_a_buffer_set_may_move_and_keeps_its_label(tmp_path: Path, tiny_buffers: Path) -> None:
    run_one(tmp_path / "run")
    moved = shutil.copytree(tiny_buffers, tmp_path / "moved")
    both = run(tmp_path / "run", buffer_set=moved, conditions=("no-history",))
    assert [(row.family, row.buffer_set) for row in both.rows] == [
        ("VideoRepick", "buffer_set"),
        ("MoveCube", "buffer_set"),
    ]
    assert len(read_record(tmp_path / "run")) == 2


@pytest.mark.parametrize(
    ("path", "column"),
    [
        ("manifests/buffers.parquet", "sessions"),
        ("demonstrations/meta/interference.parquet", "goals"),
        ("distractors/meta/interference.parquet", "goals"),
    ],
)
def test_a_changed_table_is_an_error_before_the_run(
    own_buffers: Path, tmp_path: Path, path: str, column: str
) -> None:
    """The order of sessions, and wordings of goals."""
    table = pq.read_table(own_buffers / path)
    lists = [one[::-1] if len(one) > 1 else one * 2 for one in table[column].to_pylist()]
    values = pa.array(lists, table.schema.field(column).type)
    changed = table.set_column(table.column_names.index(column), column, values)
    pq.write_table(changed, own_buffers / path)
    with raises(HashMismatchError):
        run(tmp_path / "run", conditions=("k1",), buffer_set=own_buffers)
    assert not (tmp_path / "run").exists()
