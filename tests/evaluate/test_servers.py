"""Policy servers of a run: identified, of the right kind, locked, and started by workers."""

import json
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
from support.messages import raises
from support.policy_calls import client, rollout
from support.policy_server import Memoryless, PolicyServer
from support.runs import header, run, run_one
from support.serve_policy import command
from support.worker_calls import wait_until_gone

from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    PolicyServerError,
    RunError,
    ServerDiedError,
    ServerKeepaliveError,
    WorkerRetiredError,
)
from robomme_interference_data.evaluate.policies import websocket
from robomme_interference_data.evaluate.policies.identity import check_servers_memory, lock_servers
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.policies.server_lock import reserve_port
from robomme_interference_data.evaluate.systems import PAPER_SYSTEMS, name_system

NAMED = ("checkpoint=a",)
FRAMES, NONE = "perceptual-framesamp-modul", "pi05_baseline"
pytestmark = pytest.mark.usefixtures("world")

# --- which checkpoint --------------------------------------------------------------------------


def test_a_server_that_reports_no_checkpoint_needs_the_option(
    tmp_path: Path, server: PolicyServer
) -> None:
    for metadata in ({}, {"reset_pose": [0.0]}):
        server.metadata = metadata
        with raises(InvalidOptionError) as raised:
            run_one(tmp_path / "run", policy=server.url)
        assert "checkpoint=TEXT" in (raised.value.hint or "")
    assert server.calls == [] and not (tmp_path / "run").exists()
    run_one(tmp_path / "run", policy=server.url, policy_options=NAMED)
    assert header(tmp_path / "run")["identity"]["policy_options"]["checkpoint"] == "a"
    # The checkpoint's name is text, even if it looks like a number.
    with raises(RunError):
        run_one(tmp_path / "run", policy=server.url, policy_options=("checkpoint=79999",))


def test_a_server_that_reports_its_checkpoint_needs_no_option(
    tmp_path: Path, server: PolicyServer
) -> None:
    server.metadata = {"checkpoint": "a"}
    assert run_one(tmp_path / "run", policy=server.url).counts["fail"] == 1
    run_one(tmp_path / "same", policy=server.url, policy_options=NAMED)
    with raises(PolicyServerError):
        run_one(tmp_path / "other", policy=server.url, policy_options=("checkpoint=b",))
    with raises(InvalidOptionError):
        run_one(tmp_path / "empty", policy=server.url, policy_options=("checkpoint= ",))


# --- which memory ------------------------------------------------------------------------------


def test_a_server_declares_its_memory_in_its_metadata(tmp_path: Path, server: PolicyServer) -> None:
    """Frames 0 to 3 and 31 to 38 of MoveCube's lesson of 48 show the answer."""
    server.metadata = {"checkpoint": "a", "capabilities": {"memory": "window"}}
    (row,) = run_one(tmp_path / "run", policy=server.url, conditions=("k0",)).rows
    assert (row.memory, row.evidence_kept) == ("window:32", 0.5)


@pytest.mark.parametrize("declared", ["window", {"memroy": "window"}, {"memory": "windw"}])
def test_a_misspelled_declaration_of_a_server_is_an_error(
    tmp_path: Path, server: PolicyServer, declared: Any
) -> None:
    server.metadata = {"checkpoint": "a", "capabilities": declared}
    with raises(PolicyServerError):
        run_one(tmp_path / "run", policy=server.url, conditions=("k0",))
    assert not (tmp_path / "run").exists()


# --- which kind --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("memory", "right", "wrong"), [(None, FRAMES, NONE), (Memoryless(), NONE, FRAMES)]
)
def test_a_server_of_the_other_kind_is_an_error(
    tmp_path: Path, memory: Any, right: str, wrong: str
) -> None:
    settings: dict[str, Any] = {"policy_options": NAMED, "conditions": ("no-history",)}
    with PolicyServer(memory).running() as server:
        result = run(tmp_path / "right", policy=server.url, system=right, **settings)
        assert result.counts["fail"] == 2
        with raises(PolicyServerError):
            run(tmp_path / "wrong", policy=server.url, system=wrong, **settings)
        assert not (tmp_path / "wrong").exists()
        calls = len(server.calls)
        check_servers_memory(server.url, NAMED, name_system("mine"))  # of an unknown kind
        assert len(server.calls) == calls


def test_another_error_does_not_identify_the_kind(server: PolicyServer) -> None:
    server.before = lambda message: "no key 'x'" if "prompt" in message else None
    with raises(PolicyServerError):
        check_servers_memory(server.url, NAMED, name_system(FRAMES))


def test_the_kinds_of_the_released_servers() -> None:
    without = {NONE, "symbolic-simplesg", "symbolic-groundsg", "memer"}
    kinds = {one.name: one.keeps_frames for one in PAPER_SYSTEMS}
    assert kinds == {name: name not in without for name in kinds}
    assert name_system("mine").keeps_frames is name_system("replay-full").keeps_frames is None


# --- keepalive ---------------------------------------------------------------------------------


def compiling(call: str, times: int = 1) -> PolicyServer:
    """A server whose first answers take so long that its keepalive closes the connection."""
    server, left = PolicyServer(None), iter([PolicyServer.COMPILE] * times)
    server.options |= {"ping_interval": 0.1, "ping_timeout": 0.1}
    server.before = lambda message: next(left, None) if call in message else None
    return server


def test_keepalive_ends_a_rollout_with_a_separate_error() -> None:
    with compiling("add_buffer").running() as server, client(server) as policy:
        with raises(ServerKeepaliveError):
            rollout(policy, 40, [40], [16])
        rollout(policy, 40, [40], [16])
        assert (server.connections, server.memory.count) == (2, 57)


@pytest.mark.parametrize(("times", "status"), [(1, "fail"), (2, "error")])
def test_such_a_rollout_starts_again_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, times: int, status: str
) -> None:
    with compiling("prompt", times).running() as server:
        result = run_one(tmp_path / "run", policy=server.url, policy_options=NAMED)
    assert [(row.status, row.attempt) for row in result.rows] == [(status, 2)]
    messages = [line for line in caplog.text.splitlines() if "started again" in line]
    assert len(messages) == times
    assert all("MoveCube/test/0" in line and "keepalive" in line for line in messages)


# --- locks -------------------------------------------------------------------------------------


DRIVE = """
import pathlib, sys, time
from robomme_interference_data.evaluate.policies.identity import lock_servers
with lock_servers(sys.argv[1], pathlib.Path(sys.argv[2])):
    print("driving", flush=True)
    time.sleep(600)
"""


@contextmanager
def driven(url: str, out: Path) -> Iterator[int]:
    """Servers that a run in another process drives, which is killed at the end; its id."""
    line = [sys.executable, "-c", DRIVE, url, str(out)]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "driving\n"
            yield process.pid
        finally:
            process.kill()


def test_two_runs_never_drive_one_server(tmp_path: Path, server: PolicyServer) -> None:
    with driven(server.url, tmp_path / "first") as process:
        # Also in a list, and under another name of this machine.
        listed = f"websocket://127.0.0.1:1,localhost:{server.port}"
        for policy in (server.url, listed):
            with raises(PolicyServerError) as raised:
                run_one(tmp_path / "second", policy=policy, policy_options=NAMED)
            holder = f"the run in {tmp_path / 'first'} (process {process})"
            assert f":{server.port} is driven by {holder}" in raised.value.message
        assert server.connections == 0
    # A killed run holds no lock.
    result = run_one(tmp_path / "second", policy=server.url, policy_options=NAMED)
    assert result.counts["fail"] == 1


def test_a_run_works_without_a_folder_for_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with lock_servers("websocket://gpu1:8013", tmp_path):
        pass
    assert "Nothing keeps other runs from the policy server gpu1:8013" in caplog.text


# --- servers that workers start ----------------------------------------------------------------


def serve(out: Path, *words: object, **changes: Any) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
        return run(out, policy=f"websocket:{command(*words)}", **changes)


def test_a_worker_starts_its_server_and_ends_it(tmp_path: Path) -> None:
    result = serve(tmp_path / "run", "--pids", tmp_path / "pids")
    assert [(row.status, row.attempt) for row in result.rows] == [("fail", 1)] * 4
    pids = (tmp_path / "pids").read_text().split()
    assert len(pids) == 1  # one server answers for its metadata and plays the rollouts
    assert not any(psutil.pid_exists(int(pid)) for pid in pids)
    (log,) = (tmp_path / "run" / "servers").iterdir()
    assert log.name.endswith("-0.log") and log.read_text().startswith("serving at 18")
    (start,) = header(tmp_path / "run")["invocations"]
    line = command("--pids", tmp_path / "pids")
    assert start["settings"]["policy"] == f"websocket:{line}"
    assert start["policy"]["server"] == line
    identity = header(tmp_path / "run")["identity"]
    assert identity["policy"] == "websocket"  # the command is no part of the identity
    assert identity["policy_metadata"]["server_metadata"] == {"checkpoint": "tiny/1"}


def test_a_server_that_a_worker_starts_declares_its_memory(tmp_path: Path) -> None:
    said = json.dumps({"checkpoint": "a", "capabilities": {"memory": "window"}})
    result = serve(tmp_path / "run", "--metadata", said, conditions=("k0",), families=("MoveCube",))
    assert [(row.memory, row.evidence_kept) for row in result.rows] == [("window:32", 0.5)]
    assert header(tmp_path / "run")["identity"]["facts"]["memory"] == "window:32"


def test_a_server_that_dies_is_started_again(tmp_path: Path) -> None:
    result = serve(tmp_path / "run", "--dies", tmp_path / "died")
    assert sorted(row.attempt for row in result.rows) == [1, 1, 1, 2]
    assert result.counts["fail"] == 4
    first, second = sorted((tmp_path / "run" / "servers").iterdir())
    assert "out of memory" in first.read_text() and "out of memory" not in second.read_text()


def test_a_server_that_cannot_start_is_an_error_with_the_end_of_its_log(tmp_path: Path) -> None:
    with raises(ServerDiedError) as raised:
        serve(tmp_path / "run", "--metadata", "no JSON")
    assert "rror" in str(raised.value.hint)
    assert not (tmp_path / "run").exists()


def test_a_server_that_does_not_listen_is_an_error_with_the_end_of_its_log(tmp_path: Path) -> None:
    code = "print('loading {port}'); __import__('time').sleep(99)"
    served = {"policy": f"websocket:{shlex.join([sys.executable, '-uc', code])}"}
    with raises(PolicyServerError) as raised:
        run(tmp_path / "run", policy_options=("connect_s=1.5",), **served)
    hint = str(raised.value.hint)
    assert "listen at {port}" in hint and "connect_s" in hint and "loading 18" in hint


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"policy": "websocket"}, "websocket:COMMAND with {port}"),
        ({"policy": "websocket:serve 8000"}, "websocket:COMMAND with {port}"),
        ({"policy": "websocket:serve '{port}"}, "websocket:COMMAND with {port}"),
        ({"policy": "websocket:no-such-program {port}"}, "cannot be run"),
    ],
)
def test_invalid_commands_are_errors(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidOptionError) as raised:
        run(tmp_path / "run", **changes)
    assert words in raised.value.message
    assert not (tmp_path / "run").exists()


def test_a_worker_whose_server_reports_another_model_plays_no_rollout(tmp_path: Path) -> None:
    with raises(WorkerRetiredError):
        serve(tmp_path / "run", "--differs", tmp_path / "asked", "--dies", tmp_path / "died")
    assert (tmp_path / "run" / "rollouts.jsonl").read_text() == ""


def test_two_servers_of_one_machine_have_two_ports() -> None:
    with reserve_port() as first, reserve_port() as second:
        assert first != second
    policy = make_policy(f"websocket:{command()}")
    with reserve_port() as other:
        policy.close()
        with reserve_port() as again:
            assert len({other, again}) == 2


def test_a_server_that_a_script_starts_ends_with_the_script(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shell that waits for the server would leave it behind."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
    script = tmp_path / "serve.sh"
    line = command("--pids", tmp_path / "pids").replace("'{port}'", "$1")
    script.write_text(f"{line}\ntrue\n")
    policy: Any = make_policy(f"websocket:bash {script} {{port}}")
    assert policy.metadata()["server_metadata"] == {"checkpoint": "tiny/1"}
    pid = int((tmp_path / "pids").read_text())
    assert psutil.pid_exists(pid)
    policy.close()
    wait_until_gone([pid])


def test_the_end_of_a_long_log_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(websocket, "_LOG_BYTES", 5)
    policy: Any = make_policy("websocket:echo {port} is the port")
    try:
        with raises(InterferenceError):
            policy.metadata()
        assert policy.log() == b"port\n"
    finally:
        policy.close()
