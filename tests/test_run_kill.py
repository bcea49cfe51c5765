"""An evaluation, killed at any moment: no finished rollout is lost, and none is written twice."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import factories
import pytest
import rollout_doubles

from robomme_interference_data.evaluate.log import read_log
from robomme_interference_data.evaluate.rows import TIMING_COLUMNS, Rollout

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")

ROLLOUTS = 16


def start(out: Path, pause: float, workers: int = 2) -> subprocess.Popen[bytes]:
    environment = os.environ | {
        rollout_doubles.SPLIT: str(factories.split()),
        rollout_doubles.PAUSE: str(pause),
        "PYTHONPATH": str(Path(__file__).parent),
    }
    options = (
        "evaluate --policy python:rollout_doubles:make_cheat --simulator rollout_doubles:World"
    )
    options += " --system mine --episodes 0-1 --conditions no-history k0"
    return subprocess.Popen(
        [
            *(sys.executable, "-m", "robomme_interference_data.cli", *options.split()),
            *("--split", str(factories.split()), "--out", str(out), "--workers", str(workers)),
        ],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def children(pid: int) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = path.read_text()
        except OSError:
            continue
        if int(text.rpartition(")")[2].split()[1]) == pid:
            found.append(int(path.parent.name))
    return found


def gone(pids: list[int], seconds: float = 30) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if not any(Path(f"/proc/{pid}").exists() for pid in pids):
            return True
        time.sleep(0.1)
    return False


def untimed(rows: dict[tuple[object, ...], Rollout]) -> dict[tuple[object, ...], dict[str, object]]:
    skipped = {*TIMING_COLUMNS, "attempt"}
    return {
        key: {name: value for name, value in row.as_dict().items() if name not in skipped}
        for key, row in rows.items()
    }


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[object, ...], dict]:
    out = tmp_path_factory.mktemp("undisturbed") / "run"
    assert start(out, 0).wait(timeout=200) == 0
    rows = read_log(out)
    assert len(rows) == ROLLOUTS
    return untimed(rows)


def wait_for_rows(out: Path, count: int, running: subprocess.Popen[bytes]) -> None:
    log = out / "rollouts.jsonl"
    end = time.monotonic() + 120
    while time.monotonic() < end and running.poll() is None:
        if log.exists() and log.read_bytes().count(b"\n") >= count:
            return
        time.sleep(0.02)


def test_the_parent_may_be_killed(tmp_path: Path, undisturbed: dict) -> None:
    out, moments = tmp_path / "run", random.Random(7)
    before: dict[tuple[object, ...], Rollout] = {}
    for already in (2, 7):
        running = start(out, 0.005)
        wait_for_rows(out, already, running)
        time.sleep(moments.uniform(0, 0.3))
        workers = children(running.pid)
        running.kill()
        running.wait()
        assert gone(workers), "workers end with their parent"
        rows = read_log(out)
        assert all(rows[key] == row for key, row in before.items()), "a finished rollout is kept"
        assert len(rows) >= min(already, ROLLOUTS)
        before = rows
    assert start(out, 0).wait(timeout=200) == 0
    # A start that was killed has no end on record.
    starts = json.loads((out / "run.json").read_text())["invocations"]
    assert ["ended" in one for one in starts] == [False, False, True]
    # `read_log` refuses a second row of a finished rollout, so none was written twice.
    rows = read_log(out)
    assert all(rows[key] == row for key, row in before.items())
    assert untimed(rows) == undisturbed


def test_any_worker_may_be_killed(tmp_path: Path, undisturbed: dict) -> None:
    out = tmp_path / "run"
    running = start(out, 0.01)
    killed = 0
    for already in (1, 5):
        wait_for_rows(out, already, running)
        for pid in children(running.pid):
            command = Path(f"/proc/{pid}/cmdline").read_bytes()
            if b"spawn_main" in command and b"resource_tracker" not in command:
                os.kill(pid, signal.SIGKILL)
                killed += 1
                break
    assert killed == 2
    code = running.wait(timeout=300)
    rows = read_log(out)
    assert len(rows) == ROLLOUTS
    if code == 0:
        assert untimed(rows) == undisturbed
    else:  # the same rollout was hit twice: an error, which the next run mends
        assert start(out, 0).wait(timeout=200) == 0
        assert untimed(read_log(out)) == undisturbed


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_stops_cleanly_and_the_command_to_go_on_is_told(
    tmp_path: Path, undisturbed: dict, number: signal.Signals, code: int
) -> None:
    out = tmp_path / "run"
    running = start(out, 0.01)
    wait_for_rows(out, 2, running)
    workers = children(running.pid)
    os.killpg(running.pid, number)
    _, err = running.communicate(timeout=60)
    assert running.returncode == code
    text = err.decode()
    assert "Traceback" not in text
    assert "go on with:" in text
    assert "--policy python:rollout_doubles:make_cheat" in text
    assert gone(workers)
    done = read_log(out)
    assert 2 <= len(done) < ROLLOUTS
    assert (out / "rollouts.csv").read_text().count("\n") == len(done) + 1
    header = json.loads((out / "run.json").read_text())
    assert (header["status"], header["stopped"]) == ("incomplete", "interrupted")
    assert "ended" in header["invocations"][0]
    assert start(out, 0).wait(timeout=200) == 0
    assert untimed(read_log(out)) == undisturbed
