"""Policy servers of a run: named, of the right kind, locked, and started by workers."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.policy_calls import client, rollout
from support.policy_server import Memoryless, PolicyServer
from support.runs import header, run, run_one

from robomme_interference_data.errors import (
    InvalidOptionError,
    PolicyServerError,
    RunError,
    ServerKeepaliveError,
)
from robomme_interference_data.evaluate.policies.identity import check_servers_memory, lock_servers
from robomme_interference_data.evaluate.systems import PAPER_SYSTEMS, name_system

NAMED = ("checkpoint=a",)
FRAMES, NONE = "perceptual-framesamp-modul", "pi05_baseline"

# --- which checkpoint --------------------------------------------------------------------------


def test_a_server_that_says_nothing_needs_a_checkpoint(
    tmp_path: Path, world: None, server: PolicyServer
) -> None:
    for said in ({}, {"reset_pose": [0.0]}):
        server.metadata = said
        with pytest.raises(InvalidOptionError, match="does not report which checkpoint") as raised:
            run_one(tmp_path / "run", policy=server.url)
        assert "checkpoint=TEXT" in (raised.value.hint or "")
    assert server.calls == [] and not (tmp_path / "run").exists()
    run_one(tmp_path / "run", policy=server.url, policy_options=NAMED)
    assert header(tmp_path / "run")["identity"]["policy_options"]["checkpoint"] == "a"
    # What was said is text, whatever it looks like.
    difference = r"policy_options\.checkpoint is 'a' there, '79999' here"
    with pytest.raises(RunError, match=difference):
        run_one(tmp_path / "run", policy=server.url, policy_options=("checkpoint=79999",))


def test_a_server_that_names_its_checkpoint_needs_no_option(
    tmp_path: Path, world: None, server: PolicyServer
) -> None:
    server.metadata = {"checkpoint": "a"}
    assert run_one(tmp_path / "run", policy=server.url).counts["fail"] == 1
    run_one(tmp_path / "same", policy=server.url, policy_options=NAMED)
    with pytest.raises(PolicyServerError, match="serves the checkpoint 'a', not 'b'"):
        run_one(tmp_path / "other", policy=server.url, policy_options=("checkpoint=b",))
    with pytest.raises(InvalidOptionError, match="checkpoint ' '; expected its name"):
        run_one(tmp_path / "empty", policy=server.url, policy_options=("checkpoint= ",))


# --- which kind --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("memory", "right", "wrong", "found"),
    [
        (None, FRAMES, NONE, "refuses to act without frames, and that of pi05_baseline acts"),
        (Memoryless(), NONE, FRAMES, f"acts without any frame, and that of {FRAMES} refuses to"),
    ],
)
def test_a_server_of_the_other_kind_is_refused(
    tmp_path: Path, world: None, memory: Any, right: str, wrong: str, found: str
) -> None:
    asked: dict[str, Any] = {"policy_options": NAMED, "conditions": ("no-history",)}
    with PolicyServer(memory).running() as server:
        result = run(tmp_path / "right", policy=server.url, system=right, **asked)
        assert result.counts["fail"] == 2
        with pytest.raises(PolicyServerError, match=found):
            run(tmp_path / "wrong", policy=server.url, system=wrong, **asked)
        assert not (tmp_path / "wrong").exists()
        asked_before = len(server.calls)
        check_servers_memory(server.url, NAMED, name_system("mine"))  # of which nothing is known
        assert len(server.calls) == asked_before


def test_another_error_says_nothing_of_the_kind(server: PolicyServer) -> None:
    server.before = lambda message: "no key 'x'" if "prompt" in message else None
    with pytest.raises(PolicyServerError, match="reports: no key 'x'"):
        check_servers_memory(server.url, NAMED, name_system(FRAMES))


def test_the_kinds_of_the_released_servers() -> None:
    without = {NONE, "symbolic-simplesg", "symbolic-groundsg", "memer"}
    assert {one.name: one.keeps_frames for one in PAPER_SYSTEMS} == {
        one.name: one.name not in without for one in PAPER_SYSTEMS
    }
    assert name_system("mine").keeps_frames is name_system("replay-full").keeps_frames is None


# --- keepalive ---------------------------------------------------------------------------------


def compiling(memory: Any, call: str, times: int = 1) -> PolicyServer:
    """A server whose first answers take so long that its keepalive closes the connection."""
    server, left = PolicyServer(memory), iter([PolicyServer.COMPILE] * times)
    server.options |= {"ping_interval": 0.1, "ping_timeout": 0.1}
    server.before = lambda message: next(left, None) if call in message else None
    return server


@pytest.mark.parametrize("call", ["add_buffer", "prompt"])
def test_keepalive_ends_a_rollout_by_an_error_of_its_own(call: str) -> None:
    with compiling(None, call).running() as server, client(server) as policy:
        with pytest.raises(ServerKeepaliveError, match="received 1011 .* keepalive ping timeout"):
            rollout(policy, 40, [40], [16])
        rollout(policy, 40, [40], [16])
        assert (server.connections, server.memory.count) == (2, 57)


@pytest.mark.parametrize(
    ("times", "status", "attempt"), [(1, "fail", 2), (2, "error", 2), (0, "fail", 1)]
)
def test_such_a_rollout_is_begun_again_once(
    tmp_path: Path,
    world: None,
    caplog: pytest.LogCaptureFixture,
    times: int,
    status: str,
    attempt: int,
) -> None:
    with compiling(None, "prompt", times).running() as server:
        result = run_one(tmp_path / "run", policy=server.url, policy_options=NAMED)
    assert [(row.status, row.attempt) for row in result.rows] == [(status, attempt)]
    told = [line for line in caplog.text.splitlines() if "started again" in line]
    assert len(told) == times
    assert all("MoveCube/test/0" in line and "keepalive" in line for line in told)


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
    command = [sys.executable, "-c", DRIVE, url, str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "driving\n"
            yield process.pid
        finally:
            process.kill()


def test_two_runs_never_drive_one_server(tmp_path: Path, world: None, server: PolicyServer) -> None:
    with driven(server.url, tmp_path / "first") as process:
        # Whatever else is in the list, and by another name of this machine.
        also = f"websocket://127.0.0.1:1,localhost:{server.port}"
        for policy in (server.url, also):
            with pytest.raises(PolicyServerError, match="two runs spoil each other") as raised:
                run_one(tmp_path / "second", policy=policy, policy_options=NAMED)
            holder = f"the run in {tmp_path / 'first'} (process {process})"
            assert f":{server.port} is driven by {holder}" in raised.value.message
        assert server.connections == 0
    # A killed run holds nothing.
    result = run_one(tmp_path / "second", policy=server.url, policy_options=NAMED)
    assert result.counts["fail"] == 1


def test_without_a_place_for_locks_a_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with lock_servers("websocket://gpu1:8013", tmp_path):
        pass
    assert "Nothing keeps other runs from the policy server gpu1:8013" in caplog.text
