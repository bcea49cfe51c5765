"""Runs with policy servers: several, and some that go away; and how policies are closed."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import factories
import numpy as np
import policy_server
import pytest
from run_calls import config
from run_calls import run_one as run

from robomme_interference_data.errors import PolicyServerError, WorkerRetiredError
from robomme_interference_data.evaluate.checks import describe_policy
from robomme_interference_data.evaluate.log import read_log
from robomme_interference_data.evaluate.policies.websocket import WebsocketPolicy

pytestmark = pytest.mark.usefixtures("world")


@contextmanager
def two_servers() -> Iterator[list[policy_server.PolicyServer]]:
    with ExitStack() as stack:
        yield [stack.enter_context(policy_server.PolicyServer().running()) for _ in range(2)]


def several(*names: str) -> str:
    return "websocket://" + ",".join(name.removeprefix("websocket://") for name in names)


def test_every_server_is_asked_and_on_record() -> None:
    with two_servers() as servers:
        said = describe_policy(config(policy=several(*(server.url for server in servers))))
    assert said.metadata["server"] == ", ".join(f"127.0.0.1:{server.port}" for server in servers)
    assert said.metadata["server_metadata"] == {"model": "none", "seed": 7}
    assert [server.connections for server in servers] == [1, 1]


def test_servers_of_different_models_are_refused(tmp_path: Path) -> None:
    with two_servers() as servers:
        servers[1].metadata["seed"] = np.int64(8)
        policy = several(*(server.url for server in servers))
        with pytest.raises(PolicyServerError, match="serve different models") as raised:
            run(tmp_path / "run", policy=policy, workers=2)
    for server in servers:
        assert f"127.0.0.1:{server.port}" in raised.value.message
    assert not (tmp_path / "run").exists()


def test_a_server_that_cannot_be_reached_is_named_before_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(WebsocketPolicy.__init__.__kwdefaults__, "attempts", 1)
    with policy_server.PolicyServer().running() as server:
        policy = several(server.url, "127.0.0.1:9")
        with pytest.raises(PolicyServerError, match=r"127\.0\.0\.1:9 cannot be reached"):
            run(tmp_path / "run", policy=policy, workers=2)
    assert not (tmp_path / "run").exists()


@contextmanager
def server_processes(count: int) -> Iterator[tuple[list[subprocess.Popen[str]], str]]:
    with ExitStack() as stack:
        started = []
        for _ in range(count):
            command = [sys.executable, str(Path(policy_server.__file__)), "--port", "0"]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            stack.callback(process.wait)
            stack.callback(process.kill)
            started.append(process)
        urls = [process.stdout.readline().strip() for process in started if process.stdout]
        yield started, ",".join(url.removeprefix("websocket://") for url in urls)


class Killer:
    """Kills servers as soon as a row is written."""

    def __init__(self, processes: list[subprocess.Popen[str]]):
        self.processes = processes

    def start(self, plan: Any, done: Any) -> None: ...

    def row(self, row: Any) -> None:
        while self.processes:
            self.processes.pop().kill()


SERVED: dict[str, Any] = {
    "policy": "python:own_policies:served",
    "conditions": None,
    "families": ["all"],
    "workers": 2,
}


def test_a_server_that_goes_away_costs_no_rollout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The policy holds still, so all 16 rollouts fail; the other server does the rest."""
    with server_processes(2) as (processes, urls):
        monkeypatch.setenv("SERVERS", urls)
        result = run(tmp_path / "run", listener=Killer(processes[1:]), **SERVED)
    assert [(row.status, row.error, row.attempt) for row in result.rows] == [("fail", None, 1)] * 16
    assert result.stopped is None


def test_without_any_server_the_run_stops_with_one_error_and_goes_on_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with server_processes(2) as (processes, urls):
        monkeypatch.setenv("SERVERS", urls)
        with pytest.raises(WorkerRetiredError, match="cannot be reached") as raised:
            run(tmp_path / "run", listener=Killer(list(processes)), **SERVED)
    assert raised.value.hint is not None and "Start it" in raised.value.hint
    rows = read_log(tmp_path / "run")
    assert 1 <= len(rows) < 16 and {row.status for row in rows.values()} == {"fail"}
    header = json.loads((tmp_path / "run" / "run.json").read_text())
    assert header["status"] == "incomplete" and "cannot be reached" in header["stopped"]
    with server_processes(2) as (_, urls):
        monkeypatch.setenv("SERVERS", urls)
        assert run(tmp_path / "run", **SERVED).counts["fail"] == 16


def test_policies_are_closed_and_what_they_print_is_not_among_the_rows(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    line = "evaluate --policy python:own_policies:talker --simulator rollout_doubles:World --json"
    line += " --families MoveCube --conditions no-history --episodes 0-1 --workers 2"
    done = subprocess.run(
        [
            *(sys.executable, "-m", "robomme_interference_data.cli", *line.split()),
            *("--split", str(factories.split()), "--out", str(tmp_path / "run")),
        ],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent), "CLOSED": str(closed)},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert [row["status"] for row in json.loads(done.stdout)] == ["fail", "timeout"]
    words = done.stderr.split()
    assert (words.count("made"), words.count("reset"), words.count("closed")) == (3, 2, 3)
    assert len(set(closed.read_text().split())) == 3  # the command itself, and two workers
