"""Runs in real processes: killed, hung, stopped, or left by their servers."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
from support import runs, worlds
from support.policy_server import Memory, PolicyServer
from support.serve_policy import command
from support.worker_calls import wait_until_gone

from robomme_interference_data.errors import WorkerRetiredError
from robomme_interference_data.evaluate.run.row import read_record
from robomme_interference_data.runtime.process import Processes

pytestmark = pytest.mark.usefixtures("world")

CONDITIONS = ("no-history", "k0", "k1", "k3", "k7")
ROLLOUTS = 10  # two episodes, five conditions


def start(
    out: Path, pause: float = 0.0, policy: str = runs.CHEAT, words: Sequence[str] = ()
) -> subprocess.Popen[str]:
    usual = f"evaluate {os.environ[worlds.BUFFER_SET]} --simulator {runs.WORLD} --no-probe"
    usual += " --system mine --workers 2 --families VideoRepick,MoveCube --json"
    called = [sys.executable, "-m", "robomme_interference_data.cli.main", *usual.split()]
    called += ["--policy", policy, *words]
    return subprocess.Popen(
        [*called, "--out", str(out)],
        env=os.environ | {worlds.PAUSE: str(pause)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def finish(out: Path) -> None:
    running = start(out)
    _, err = running.communicate(timeout=200)
    assert running.returncode == 0, err


@pytest.fixture
def undisturbed(tmp_path: Path) -> list[dict[str, Any]]:
    """What one process writes."""
    runs.run(tmp_path / "undisturbed", conditions=CONDITIONS)
    return runs.finished_rows(tmp_path / "undisturbed")


@pytest.mark.slow
def test_the_command_may_be_killed_or_stopped_at_any_moment(
    tmp_path: Path, undisturbed: list[dict[str, Any]]
) -> None:
    out, sent = tmp_path / "run", (signal.SIGKILL, signal.SIGTERM)
    before: dict[Any, Any] = {}
    for already, number in zip((1, 3), sent, strict=True):
        running = start(out, 0.02)
        runs.wait_for_rows(out, already, running)
        workers = [one.pid for one in psutil.Process(running.pid).children()]
        if number == signal.SIGKILL:
            running.kill()
        else:
            os.killpg(running.pid, number)
        _, err = running.communicate(timeout=180)
        wait_until_gone(workers)  # they end with their parent
        header, rows = json.loads((out / "run.json").read_text()), read_record(out)
        # `read_record` refuses a second row of a finished rollout: none is lost, none is double.
        assert all(rows[item] == row for item, row in before.items())
        assert already <= len(rows) < ROLLOUTS and header["planned"] == ROLLOUTS
        before = rows
        if number == signal.SIGKILL:
            assert header["status"] == "running" and set(header["counts"].values()) == {0}
            continue
        assert running.returncode == 128 + number
        assert "Traceback" not in err and "resume with:\nrobomme-interference evaluate" in err
        assert sum(header["counts"].values()) == len(rows)
        assert header["invocations"][-1]["stopped"] == "interrupted"
        assert len((out / "rollouts.csv").read_text().splitlines()) == len(rows) + 1
    finish(out)
    starts = json.loads((out / "run.json").read_text())["invocations"]
    killed = [one == signal.SIGKILL for one in sent]
    assert [one["ended"] is None for one in starts] == [*killed, False]
    assert runs.finished_rows(out) == undisturbed


@pytest.mark.slow
def test_a_simulator_that_hangs_or_takes_its_process_along_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "VideoRepick-0").write_text("die")
    (tmp_path / "MoveCube-0").write_text("hang")
    options = {"conditions": ("no-history",), "simulator_timeout_s": 2.0}
    died, hung = runs.run(tmp_path / "run", Processes(2), **options).rows
    assert (died.error, died.attempt) == ("the worker process died (exit code -9)", 2)
    assert (hung.error, hung.attempt) == ("the simulator's steps took more than 2 s", 2)
    log = (tmp_path / "run" / "errors.log").read_text()
    assert "MoveCube/test/0 under no-history, attempt 2" in log
    assert "worlds.py" in log and "in step" in log  # where it hung
    # Once only, it costs no rollout.
    (tmp_path / "VideoRepick-0").write_text("die once")
    (tmp_path / "MoveCube-0").write_text("hang once")
    again = runs.run(tmp_path / "run", Processes(2), **options, rollout_timeout_s=60.0)
    assert [(row.status, row.attempt) for row in again.rows] == [("fail", 4), ("fail", 4)]


@pytest.mark.slow
def test_policies_are_closed_and_what_they_print_is_not_among_the_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CLOSED", str(tmp_path / "closed"))
    running = start(tmp_path / "run", policy="python:support.own_policies:Talker")
    out, err = running.communicate(timeout=120)
    assert [row["status"] for row in json.loads(out)] == ["fail", "fail"]
    words = err.split()
    assert (words.count("made"), words.count("reset"), words.count("closed")) == (3, 2, 3)
    pids = (tmp_path / "closed").read_text().split()
    assert len(set(pids)) == 3  # the command itself, and two workers


@contextmanager
def servers(count: int) -> Iterator[tuple[list[ExitStack], str]]:
    """Servers, each with what stops it, and their addresses with commas between."""
    with ExitStack() as stack:
        stops = [stack.enter_context(ExitStack()) for _ in range(count)]
        started = [stop.enter_context(PolicyServer(Memory(keep=False)).running()) for stop in stops]
        yield stops, ",".join(server.url.removeprefix("websocket://") for server in started)


class Stopper:
    """Stops servers as soon as a row is written."""

    def __init__(self, stops: list[ExitStack]):
        self.stops = stops

    def start(self, items: Any, done: Any) -> None: ...

    def row(self, row: Any, node: Any) -> None:
        while self.stops:
            self.stops.pop().close()


@pytest.mark.slow
def test_servers_that_go_away_cost_no_rollout(tmp_path: Path, monkeypatch: Any) -> None:
    """The policy holds still: all rollouts fail. Another server does the rest, or a later run."""
    served: dict[str, Any] = {"policy": "python:support.own_policies:Served", "workers": 2}
    served |= {"conditions": CONDITIONS}
    with servers(2) as (stops, urls):
        monkeypatch.setenv("SERVERS", urls)
        result = runs.run(tmp_path / "one", Processes(2), progress=Stopper(stops[1:]), **served)
        assert [(row.status, row.attempt) for row in result.rows] == [("fail", 1)] * ROLLOUTS
        with pytest.raises(WorkerRetiredError):
            runs.run(tmp_path / "two", Processes(1), progress=Stopper(stops[:1]), **served)
    rows = read_record(tmp_path / "two")
    assert 1 <= len(rows) < ROLLOUTS and {row.status for row in rows.values()} == {"fail"}
    header = json.loads((tmp_path / "two" / "run.json").read_text())
    assert (
        header["status"] == "incomplete"
        and "cannot be reached" in header["invocations"][0]["stopped"]
    )
    with servers(2) as (_, urls):
        monkeypatch.setenv("SERVERS", urls)
        assert runs.run(tmp_path / "two", Processes(2), **served).counts["fail"] == ROLLOUTS


@pytest.mark.slow
@pytest.mark.parametrize(
    "sent", [pytest.param(signal.SIGKILL, marks=pytest.mark.slow), signal.SIGINT]
)
def test_servers_that_workers_start_end_with_the_command(
    tmp_path: Path, sent: signal.Signals
) -> None:
    policy = f"websocket:{command('--pids', tmp_path / 'pids')}"
    running = start(tmp_path / "run", 0.05, policy=policy)
    runs.wait_for_rows(tmp_path / "run", 2, running)
    pids = [int(line) for line in (tmp_path / "pids").read_text().split()]
    assert len(pids) == 2  # one beside each worker
    os.killpg(running.pid, sent)
    running.communicate(timeout=180)
    wait_until_gone(pids)
    numbers = {path.stem.rpartition("-")[2] for path in (tmp_path / "run" / "servers").iterdir()}
    assert {"0"} <= numbers <= {"0", "1"}
