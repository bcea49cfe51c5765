"""What is found out before a run, and what becomes of servers that go away during one."""

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
import rollout_doubles

from robomme_interference_data import load_split
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    MissingExtraError,
    MissingIndexError,
    NoRendererError,
    PolicyServerError,
    UnknownNameError,
    WorkerRetiredError,
)
from robomme_interference_data.evaluate import RunResult, run_evaluation, runner
from robomme_interference_data.evaluate.checks import check_simulator, describe_policy
from robomme_interference_data.evaluate.config import RunConfig, default_system
from robomme_interference_data.evaluate.log import read_log
from robomme_interference_data.evaluate.policies.websocket import WebsocketPolicy

CHEAT = "python:rollout_doubles:make_cheat"


@pytest.fixture(autouse=True)
def _world(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(rollout_doubles.SPLIT, str(factories.split()))


def run(out: Path, **changes: Any) -> RunResult:
    options: dict[str, Any] = {
        "simulator": "rollout_doubles:World",
        "conditions": ["no-history"],
        "families": ["MoveCube"],
        "episodes": "0",
        "system": "mine",
    } | changes
    return run_evaluation(options.pop("policy", CHEAT), factories.split(), out, **options)


def config(**changes: Any) -> RunConfig:
    split = load_split(factories.split())
    options: dict[str, Any] = {"system": "mine", "policy": "hold", "memory": None}
    options |= {"simulator": "tabletop", "split": str(split.root), "split_name": split.name}
    return RunConfig(**options | {"revision": split.revision} | changes)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"simulator": "nosuch:thing"}, UnknownNameError, "no simulator 'nosuch:thing'"),
        ({"simulator": "rollout_doubles:Word"}, UnknownNameError, "no attribute 'Word'"),
        ({"conditions": []}, InvalidOptionError, "there is nothing to run"),
        ({"families": []}, InvalidOptionError, "there is nothing to run"),
        (
            {"retrieval": "thumbnail", "conditions": ["k0", "k1"]},
            MissingIndexError,
            "has no embeddings of encoder 'thumbnail'",
        ),
        ({"policy": "python:__main__:make"}, InvalidOptionError, "worker processes run another"),
        ({"retrieval_rule": "oracle"}, InvalidOptionError, "--retrieval-rule oracle says nothing"),
        ({"retrieval_camera": "wrist"}, InvalidOptionError, "--retrieval-camera wrist says"),
        (
            {"retrieval": "thumbnail", "retrieval_rule": "top32"},
            InvalidOptionError,
            "a policy is handed a span",
        ),
        (
            {
                "retrieval": "thumbnail",
                "retrieval_rule": "last/0.9",
                "system": "retrieval-framesamp-modul",
            },
            InvalidOptionError,
            "chooses by max, not by last/0.9",
        ),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_written(
    tmp_path: Path, changes: dict[str, Any], error: type[InterferenceError], message: str
) -> None:
    with pytest.raises(error) as raised:
        run(tmp_path / "run", **changes)
    assert message in raised.value.message
    assert raised.value.hint
    assert not (tmp_path / "run").exists()


def test_videos_without_pillow_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(MissingExtraError, match="--videos needs pillow"):
        run(tmp_path / "run", videos=True)
    assert not (tmp_path / "run").exists()


# --- the simulator -----------------------------------------------------------------------------


def test_a_machine_that_cannot_draw_is_told_so_once(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mani_skill")
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, "/nowhere.json")
    with pytest.raises(NoRendererError) as raised:
        check_simulator(config(), describe_policy(config()))
    assert raised.value.hint


def test_the_simulator_is_made_before_the_folder_and_only_for_rollouts_that_are_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def broken(config: RunConfig, policy: Any) -> None:
        asked.append(config.simulator)
        raise NoRendererError("no driver", "Install one.")

    whole = run(tmp_path / "whole")
    monkeypatch.setattr(runner, "check_simulator", broken)
    with pytest.raises(NoRendererError):
        run(tmp_path / "run")
    assert not (tmp_path / "run").exists()
    assert asked == ["rollout_doubles:World"]
    assert run(tmp_path / "whole").rows == whole.rows
    assert len(asked) == 1
    with pytest.raises(NoRendererError):
        run(tmp_path / "whole", conditions=["no-history", "k0"])
    assert len(asked) == 2


# --- labels ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("policy", "memory", "system", "message"),
    [
        ("oracle", None, "perceptual-framesamp-modul", "is not the paper's system"),
        ("lerobot:x/y", None, "pi05_baseline", "is not the paper's system"),
        ("replay", "window", "replay-full", "replay with the memory window is not the control"),
        ("replay", None, "replay-window", "replay is not the control replay-window"),
        ("guess", None, "oracle", "guess is not the control oracle"),
        (CHEAT, None, "oracle", "is not the control oracle"),
        ("hold", None, "retrieval-replay-full", "hold is not the control"),
        ("websocket://h:1", None, "memer", "sends the server none"),
        ("websocket://h:1", None, "symbolic-simplesg", "sends the server none"),
    ],
)
def test_a_name_of_the_table_is_refused_to_another_policy(
    policy: str, memory: str | None, system: str, message: str
) -> None:
    from robomme_interference_data.evaluate.checks import _check_label
    from robomme_interference_data.evaluate.systems import name_system

    with pytest.raises(InvalidOptionError) as raised:
        _check_label(config(policy=policy, memory=memory, system=system), name_system(system))
    assert message in raised.value.message
    assert raised.value.hint is not None and "name of your own" in raised.value.hint


@pytest.mark.parametrize(
    ("policy", "memory", "retrieval", "system"),
    [
        ("oracle", None, None, "oracle"),
        ("oracle", None, None, "my-upper-end"),
        ("replay", None, None, "replay-full"),
        ("replay", "window", None, "replay-window"),
        ("replay", "window", "thumbnail", "retrieval-replay-window"),
        ("websocket://h:1", None, None, "perceptual-framesamp-modul"),
        ("websocket://h:1", None, None, "without-subgoals"),
        (CHEAT, None, None, "memer"),
    ],
)
def test_a_name_is_given_to_the_policy_that_it_stands_for(
    policy: str, memory: str | None, retrieval: str | None, system: str
) -> None:
    from robomme_interference_data.evaluate.checks import _check_label
    from robomme_interference_data.evaluate.systems import name_system

    made = config(policy=policy, memory=memory, retrieval=retrieval, system=system)
    _check_label(made, name_system(system))


@pytest.mark.parametrize(
    ("step", "name"),
    [
        ({}, "replay-window"),
        ({"retrieval": "siglip"}, "retrieval-replay-window"),
        ({"retrieval": "siglip", "retrieval_rule": "oracle"}, "retrieval-replay-window-oracle"),
        (
            {"retrieval": "siglip", "retrieval_rule": "max/0.9", "retrieval_camera": "wrist"},
            "retrieval-replay-window-max-0.9-wrist",
        ),
    ],
)
def test_rows_are_named_after_the_retrieval_step(step: dict[str, str], name: str) -> None:
    from robomme_interference_data.evaluate.checks import _check_label
    from robomme_interference_data.evaluate.systems import name_system

    assert default_system("replay", "window", **step) == name
    made = config(policy="replay", memory="window", system=name, **step)
    _check_label(made, name_system(name))
    if "retrieval_rule" in step:
        with pytest.raises(InvalidOptionError, match="not the control retrieval-replay-window"):
            _check_label(made, name_system("retrieval-replay-window"))


def test_labels_are_checked_before_a_run(tmp_path: Path) -> None:
    with pytest.raises(InvalidOptionError, match="is not the control replay-full"):
        run(tmp_path / "run", system="replay-full")
    assert not (tmp_path / "run").exists()


def test_a_privileged_policy_is_on_record(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(tmp_path / "run", policy="python:own_policies:insider")
    header = json.loads((tmp_path / "run" / "run.json").read_text())
    assert header["policy"] == {"policy": "still", "privileged": True}
    assert "own_policies:insider is privileged: it gets the simulator" in capsys.readouterr().err
    run(tmp_path / "other", policy="python:own_policies:Still")
    header = json.loads((tmp_path / "other" / "run.json").read_text())
    assert header["policy"] == {"policy": "still"}
    assert "privileged" not in capsys.readouterr().err


# --- servers -----------------------------------------------------------------------------------


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
