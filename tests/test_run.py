"""A whole run: rows, resume, refusals, errors, and the same from one worker as from several."""

import csv
import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import factories
import pyarrow.parquet as pq
import pytest
import rollout_doubles
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data import evaluate, load_split
from robomme_interference_data.errors import (
    FormatError,
    HistoryTooLongError,
    InterferenceError,
    InvalidIdError,
    InvalidOptionError,
    MissingFileError,
    PolicyError,
    RunFolderError,
    UnknownNameError,
)
from robomme_interference_data.evaluate import RunResult, run_evaluation
from robomme_interference_data.evaluate.config import IDENTITY, RunConfig
from robomme_interference_data.evaluate.log import read_log
from robomme_interference_data.evaluate.rows import ROLLOUT_SCHEMA, TIMING_COLUMNS, Rollout

CHEAT = "python:rollout_doubles:make_cheat"
WORLD = "rollout_doubles:World"


@pytest.fixture(autouse=True)
def _world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(rollout_doubles.SPLIT, str(factories.split()))
    (tmp_path / "trouble").mkdir()
    monkeypatch.setenv(rollout_doubles.TROUBLE, str(tmp_path / "trouble"))


def trouble(tmp_path: Path, episode: str, kind: str) -> None:
    (tmp_path / "trouble" / episode).write_text(kind)


def run(out: Path, **changes: Any) -> RunResult:
    options: dict[str, Any] = {
        "simulator": WORLD,
        "conditions": ["no-history", "k0"],
        "episodes": "0-1",
        "system": "mine",
    } | changes
    return run_evaluation(options.pop("policy", CHEAT), factories.split(), out, **options)


def untimed(rows: tuple[Rollout, ...]) -> list[dict[str, Any]]:
    return [
        {name: value for name, value in row.as_dict().items() if name not in TIMING_COLUMNS}
        for row in rows
    ]


def test_what_a_policy_says_of_itself_is_on_record(tmp_path: Path) -> None:
    changes = {"conditions": ["no-history"], "families": ["MoveCube"], "episodes": "0"}
    run(tmp_path / "run", policy="python:own_policies:with_array", **changes)
    header = json.loads((tmp_path / "run" / "run.json").read_text())
    assert header["policy"] == {"policy": "still", "sizes": [0, 1, 2], "4": 5.0}
    with pytest.raises(PolicyError, match=r"metadata\(\) returned a str"):
        run(tmp_path / "other", policy="python:own_policies:with_text", **changes)
    assert not (tmp_path / "other").exists()


# --- a run -------------------------------------------------------------------------------------


def test_a_run_writes_a_row_for_every_rollout(tmp_path: Path) -> None:
    result = run(tmp_path / "run")
    # Four families with two episodes each, under two conditions. Without history the cheat fails,
    # but for MoveCube/test/1, which times out.
    assert result.counts == {"success": 8, "fail": 7, "timeout": 1, "error": 0}
    assert (result.planned, result.stopped, len(result.rows)) == (16, None, 16)
    first = [(row.family, row.episode, row.condition) for row in result.rows[:4]]
    assert first == [("VideoRepick", i, c) for i in (0, 1) for c in ("no-history", "k0")]
    header = json.loads((tmp_path / "run" / "run.json").read_text())
    assert header["status"] == "complete"
    assert header["counts"] == result.counts
    assert header["policy"] == {"policy": "cheat"}
    assert header["plans"] == [
        {
            "families": list(factories.FAMILIES),
            "episodes": [0, 1],
            "conditions": ["no-history", "k0"],
            "shard": "1/1",
        }
    ]
    assert {"numpy", "python", "robomme-interference-data"} <= set(header["versions"])


def test_the_three_files_agree(tmp_path: Path) -> None:
    rows = [row.as_dict() for row in run(tmp_path / "run", families=["MoveCube"]).rows]
    table = pq.read_table(tmp_path / "run" / "rollouts.parquet")
    assert table.schema.equals(ROLLOUT_SCHEMA)
    assert table.to_pylist() == rows
    with (tmp_path / "run" / "rollouts.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert list(read[0]) == ROLLOUT_SCHEMA.names == [f.name for f in dataclasses.fields(Rollout)]
    for text, row in zip(read, rows, strict=True):
        assert text["episode"] == str(row["episode"])
        assert text["success"] == ("true" if row["success"] else "false")
        assert text["retrieval_model"] == ""
        assert text["wall_s"] == str(row["wall_s"])
    lines = (tmp_path / "run" / "rollouts.jsonl").read_text().splitlines()
    logged = [json.loads(line) for line in lines]  # as they ended
    assert sorted(logged, key=rows.index) == rows


def test_several_workers_write_what_one_writes(tmp_path: Path) -> None:
    one = run(tmp_path / "one", conditions=["no-history", "k0", "k3"])
    four = run(tmp_path / "four", conditions=["k3", "no-history", "k0"], workers=4)
    assert untimed(one.rows) == untimed(four.rows)
    tables = [
        pq.read_table(tmp_path / name / "rollouts.parquet").drop_columns(list(TIMING_COLUMNS))
        for name in ("one", "four")
    ]
    assert tables[0].equals(tables[1])


def test_conditions_are_those_that_the_split_has(tmp_path: Path) -> None:
    result = run(tmp_path / "run", conditions=None, families=["MoveCube"], episodes="0")
    assert [row.condition for row in result.rows] == ["no-history", "k0", "k1", "k3"]


# --- resume ------------------------------------------------------------------------------------


def test_finished_rollouts_are_not_run_again(tmp_path: Path) -> None:
    first = run(tmp_path / "run", families=["MoveCube"])
    text = (tmp_path / "run" / "rollouts.jsonl").read_text()
    again = run(tmp_path / "run", families=["MoveCube"], workers=2)
    assert again.rows == first.rows
    assert (tmp_path / "run" / "rollouts.jsonl").read_text() == text


def test_a_run_may_grow(tmp_path: Path) -> None:
    run(tmp_path / "run", families=["PatternLock"], episodes="1")
    grown = run(tmp_path / "run", families=["MoveCube", "PatternLock"], episodes="0-1")
    assert len(grown.rows) == 8
    table = pq.read_table(tmp_path / "run" / "rollouts.parquet").to_pylist()
    assert [(r["family"], r["episode"]) for r in table[::2]] == [
        *[("MoveCube", 0), ("MoveCube", 1), ("PatternLock", 0), ("PatternLock", 1)]
    ]
    # A smaller plan keeps the rows of the larger one.
    run(tmp_path / "run", families=["PatternLock"], episodes="1")
    assert pq.read_metadata(tmp_path / "run" / "rollouts.parquet").num_rows == 8
    assert len(json.loads((tmp_path / "run" / "run.json").read_text())["plans"]) == 2  # each once


@given(cut=st.integers(1, 400))
def test_a_torn_line_is_dropped_and_run_again(
    tmp_path_factory: pytest.TempPathFactory, cut: int
) -> None:
    out = tmp_path_factory.mktemp("torn") / "run"
    whole = _whole_run()
    out.mkdir()
    for name in ("run.json", "rollouts.jsonl"):
        (out / name).write_bytes(whole[name])
    log = out / "rollouts.jsonl"
    log.write_bytes(log.read_bytes()[:-cut])
    kept = read_log(out)
    assert len(kept) == 3 or cut > len(whole["rollouts.jsonl"].splitlines()[-1])
    assert log.read_bytes().startswith(b"".join(_lines(whole["rollouts.jsonl"])[: len(kept)]))


def _lines(text: bytes) -> list[bytes]:
    return [line + b"\n" for line in text.split(b"\n")[:-1]]


_WHOLE: dict[str, bytes] = {}


def _whole_run() -> dict[str, bytes]:
    if not _WHOLE:
        import tempfile

        with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
            patch.setenv(rollout_doubles.SPLIT, str(factories.split()))
            run(Path(folder) / "run", families=["MoveCube"])
            for name in ("run.json", "rollouts.jsonl"):
                _WHOLE[name] = (Path(folder) / "run" / name).read_bytes()
    return _WHOLE


def test_after_a_torn_line_the_run_goes_on(tmp_path: Path) -> None:
    out = tmp_path / "run"
    first = run(out, families=["MoveCube"])
    log = out / "rollouts.jsonl"
    log.write_bytes(log.read_bytes()[:-20])
    again = run(out, families=["MoveCube"])
    assert untimed(again.rows) == untimed(first.rows)
    assert len(log.read_bytes().splitlines()) == 4
    assert read_log(out) == {row.key: row for row in again.rows}


# --- refusals ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"system": "yours"}, "system is 'mine' there, 'yours' here"),
        ({"model_seed": 7}, "model_seed is 0 there, 7 here"),
        ({"policy": "hold"}, f"policy is '{CHEAT}' there, 'hold' here"),
    ],
)
def test_another_run_is_refused_and_the_difference_named(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    before = (tmp_path / "run" / "run.json").read_bytes()
    with pytest.raises(RunFolderError, match="holds another run") as raised:
        run(tmp_path / "run", families=["MoveCube"], episodes="0", **changes)
    assert message in raised.value.message
    assert (tmp_path / "run" / "run.json").read_bytes() == before


def test_every_setting_is_classed() -> None:
    """A new setting either makes another run of it, or does not: somebody has to say which."""
    assert {
        *IDENTITY,
        *("policy", "memory", "policy_options"),  # by policy_identity
        *("retrieval", "retrieval_rule", "retrieval_camera"),  # by Selector.identity
        *("split", "split_name", "robomme_python", "check_lesson", "videos", "workers"),
        *("rollout_s", "simulator_s", "cache", "history_chunk", "max_errors"),
    } == {field.name for field in dataclasses.fields(RunConfig)}


def test_a_run_may_be_refused_if_one_is_there(tmp_path: Path) -> None:
    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    with pytest.raises(RunFolderError, match="holds a run already"):
        run(tmp_path / "run", families=["MoveCube"], episodes="0", resume=False)


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.tex").write_text("…")
    with pytest.raises(RunFolderError, match=r"holds other files \(thesis\.tex\)"):
        run(tmp_path / "run")
    assert [p.name for p in (tmp_path / "run").iterdir()] == ["thesis.tex"]


def test_a_folder_that_is_being_written_is_refused(tmp_path: Path) -> None:
    import fcntl

    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    with (tmp_path / "run" / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(RunFolderError, match="another process is writing"):
            run(tmp_path / "run", families=["MoveCube"], episodes="0")


def test_a_later_format_is_refused(tmp_path: Path) -> None:
    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    path = tmp_path / "run" / "run.json"
    path.write_text(path.read_text().replace('"format_version": 1', '"format_version": 2'))
    with pytest.raises(FormatError, match="format version 2; this package reads 1"):
        run(tmp_path / "run", families=["MoveCube"], episodes="0")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"{}\n", "is not a row of a rollout"),
        (b"not json\n", "is not a row of a rollout"),
        (b'{"unknown": 1}\n', "is not a row of a rollout"),
    ],
)
def test_a_damaged_line_is_named(tmp_path: Path, line: bytes, message: str) -> None:
    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    log = tmp_path / "run" / "rollouts.jsonl"
    log.write_bytes(line + log.read_bytes())
    with pytest.raises(FormatError, match=rf"rollouts.jsonl, line 1 {message}"):
        run(tmp_path / "run", families=["MoveCube"], episodes="0")


def test_a_finished_rollout_with_two_rows_is_refused(tmp_path: Path) -> None:
    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    log = tmp_path / "run" / "rollouts.jsonl"
    log.write_bytes(log.read_bytes() * 2)
    with pytest.raises(FormatError, match="line 3: a second row of"):
        run(tmp_path / "run", families=["MoveCube"], episodes="0")


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"policy": "orakel"}, UnknownNameError, "no policy 'orakel'"),
        (
            {"policy": "websocket://a:1", "system": None},
            InvalidOptionError,
            "need the name of the system that it serves",
        ),
        (
            {"policy": "lerobot:out/last/pretrained_model", "system": None},
            InvalidOptionError,
            "the rows of lerobot:out/last/pretrained_model need a name",
        ),
        ({"policy": "hold", "memory": "full"}, InvalidOptionError, "memory"),
        (
            {"policy": "replay", "policy_options": {"memory": "window"}},
            InvalidOptionError,
            "the memory rule is no --policy-option",
        ),
        ({"policy_options": {"a": object()}}, InvalidOptionError, "cannot be written down"),
        ({"policy_options": {"speed": 2}}, InvalidOptionError, "unexpected keyword argument"),
        ({"simulator": "tabeltop"}, UnknownNameError, "no simulator 'tabeltop'"),
        ({"simulator": "tabletop"}, InvalidOptionError, "recorded on the simulator 'sample'"),
        ({"families": ["MoveCub"]}, UnknownNameError, "'MoveCub' is not in the split"),
        ({"episodes": "0-9"}, UnknownNameError, "no query episode"),
        ({"conditions": ["k7"]}, UnknownNameError, "no buffers for k7; it has no-history, k0"),
        ({"conditions": ["k"]}, InvalidIdError, "'k' is not a condition"),
        ({"workers": 0}, InvalidOptionError, "workers 0; expected more than 0"),
        ({"rollout_s": 0.0}, InvalidOptionError, "rollout_s 0.0; expected more"),
        ({"system": "pi05_baseline"}, InvalidOptionError, "k0 does not apply"),
        ({"system": "retrieval-framesamp-modul"}, InvalidOptionError, None),
        ({"system": "perceptual-framesamp-modull"}, UnknownNameError, "reads like the system"),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_written(
    tmp_path: Path, changes: dict[str, Any], error: type[InterferenceError], message: str | None
) -> None:
    with pytest.raises(error) as raised:
        run(tmp_path / "run", **changes)
    assert message is None or message in raised.value.message
    assert raised.value.hint
    assert not (tmp_path / "run").exists()


def test_a_missing_split_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="is not a split"):
        run_evaluation("hold", tmp_path / "none", tmp_path / "run")


def test_a_history_beyond_the_systems_positions_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from robomme_interference_data.evaluate import systems

    monkeypatch.setitem(
        systems.SYSTEMS,
        "perceptual-framesamp-modul",
        dataclasses.replace(
            systems.SYSTEMS["perceptual-framesamp-modul"], position_limit=1300 + 36 + 32
        ),
    )
    limited = {"system": "perceptual-framesamp-modul", "families": ["MoveCube"]}
    run(tmp_path / "run", conditions=["k0", "k1"], **limited)
    with pytest.raises(HistoryTooLongError, match=r"116 history frames and 1300 steps exceed"):
        run(tmp_path / "run", conditions=["k3"], **limited)  # 20 + 3 · 32 at index 0


# --- errors ------------------------------------------------------------------------------------


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


def test_the_split_may_be_given_by_any_path(tmp_path: Path) -> None:
    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    link = tmp_path / "split"
    link.symlink_to(factories.split())
    again = run_evaluation(
        CHEAT,
        link,
        tmp_path / "run",
        simulator=WORLD,
        system="mine",
        families=["MoveCube"],
        episodes="0",
        conditions=["no-history", "k0"],
    )
    assert len(again.rows) == 2
    assert load_split(link).revision == load_split(factories.split()).revision


# --- scripts -----------------------------------------------------------------------------------


def script(tmp_path: Path, call: str) -> subprocess.CompletedProcess[str]:
    """Run a script that ends with a call of `run_evaluation`."""
    options = f"{str(factories.split())!r}, 'run', simulator={WORLD!r}, system='mine', "
    options += "conditions=['k0'], families=['MoveCube'], episodes='0'"
    path = tmp_path / "script.py"
    path.write_text(
        "from rollout_doubles import make_cheat\n"
        "from robomme_interference_data.evaluate import run_evaluation\n"
        + call.format(options=options)
    )
    return subprocess.run(
        [sys.executable, str(path)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


GUARD = 'if __name__ == "__main__":'


def test_a_script_with_the_guard_runs(tmp_path: Path) -> None:
    call = f"{GUARD}\n    print(run_evaluation({CHEAT!r}, {{options}}).counts)\n"
    done = script(tmp_path, call)
    assert done.stderr == ""
    assert done.stdout == "{'success': 1, 'fail': 0, 'timeout': 0, 'error': 0}\n"


def test_a_script_without_the_guard_gets_one_error_and_no_rows(tmp_path: Path) -> None:
    done = script(tmp_path, f"run_evaluation({CHEAT!r}, {{options}}, workers=2)\n")
    assert done.returncode == 1
    assert done.stderr.count("Traceback") == 1
    assert done.stderr.splitlines()[-1] == f"Put the call into the script under  {GUARD}"
    assert read_log(tmp_path / "run") == {}
    header = json.loads((tmp_path / "run" / "run.json").read_text())
    assert header["status"] == "incomplete"
    assert header["stopped"].startswith("the worker processes came upon the call that starts them")


def test_a_factory_in_the_script_itself_is_refused(tmp_path: Path) -> None:
    done = script(
        tmp_path, f"{GUARD}\n    run_evaluation('python:__main__:make_cheat', {{options}})\n"
    )
    assert done.stderr.splitlines()[-1].endswith("and write python:MODULE:FUNCTION.")
    assert not (tmp_path / "run").exists()


def test_the_example_has_the_guard() -> None:
    page = (Path(__file__).parent.parent / "docs" / "evaluate.md").read_text(encoding="utf-8")
    for text in (page, evaluate.__doc__ or ""):
        snippet = text.split("```python\n")[1].split("```")[0]
        assert snippet.index(GUARD) < snippet.index("run_evaluation(")
