"""Policy servers that workers start themselves."""

import shlex
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest
from support import runs
from support.serve_policy import command
from support.worker_calls import wait_until_gone

from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    PolicyServerError,
    ServerDiedError,
    WorkerRetiredError,
)
from robomme_interference_data.evaluate.policies import websocket
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.policies.server_lock import reserve_port

pytestmark = pytest.mark.usefixtures("world")


@pytest.fixture(autouse=True)
def _modules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))


def serve(out: Path, *words: object, **changes: Any) -> Any:
    return runs.run(out, policy="websocket", serve=command(*words), **changes)


def test_a_worker_starts_its_server_and_ends_it(tmp_path: Path) -> None:
    result = serve(tmp_path / "run", "--pids", tmp_path / "pids")
    assert [(row.status, row.attempt) for row in result.rows] == [("fail", 1)] * 4
    pids = (tmp_path / "pids").read_text().split()
    assert len(pids) == 1  # the one that was asked what it is serves the rollouts
    assert not any(psutil.pid_exists(int(pid)) for pid in pids)
    (log,) = (tmp_path / "run" / "servers").iterdir()
    assert log.name.endswith("-0.log") and log.read_text().startswith("serving at 18")
    header = runs.header(tmp_path / "run")
    (start,) = header["starts"]
    assert (
        start["settings"]["serve"]
        == start["policy"]["server"]
        == command("--pids", tmp_path / "pids")
    )
    identity = header["identity"]
    assert identity["policy"] == "websocket"  # whoever starts the server, the run is the same
    assert identity["policy_metadata"]["server_metadata"] == {"checkpoint": "tiny/1"}


def test_a_server_that_dies_is_started_again(tmp_path: Path) -> None:
    result = serve(tmp_path / "run", "--dies", tmp_path / "died")
    assert sorted(row.attempt for row in result.rows) == [1, 1, 1, 2]
    assert result.counts["fail"] == 4
    first, second = sorted((tmp_path / "run" / "servers").iterdir())
    assert "out of memory" in first.read_text() and "out of memory" not in second.read_text()


def test_one_that_cannot_start_is_told_with_its_last_words(tmp_path: Path) -> None:
    with pytest.raises(ServerDiedError, match="ended, exit code 1") as raised:
        serve(tmp_path / "run", "--metadata", "no JSON")
    assert "rror" in str(raised.value.hint)
    assert not (tmp_path / "run").exists()


def test_one_that_does_not_listen_is_told_with_its_last_words(tmp_path: Path) -> None:
    words = shlex.join(
        [sys.executable, "-uc", "print('loading {port}'); __import__('time').sleep(99)"]
    )
    with pytest.raises(PolicyServerError, match="cannot be reached") as raised:
        runs.run(
            tmp_path / "run", policy="websocket", serve=words, policy_options=("connect_s=1.5",)
        )
    hint = str(raised.value.hint)
    assert "listen at {port}" in hint and "connect_s" in hint and "loading 18" in hint


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"policy": "websocket"}, "websocket with serve="),
        ({"policy": "replay", "serve": "serve {port}"}, "has no server to start"),
        ({"policy": "websocket:serve {port}"}, "websocket with serve="),
        ({"policy": "websocket", "serve": "serve 8000"}, "a command with {port}"),
        ({"policy": "websocket", "serve": "serve '{port}"}, "a command with {port}"),
        ({"policy": "websocket", "serve": "no-such-program {port}"}, "cannot be run"),
        ({"policy": "websocket", "serve": "serve {port}", "system": None}, "need a name"),
    ],
)
def test_what_cannot_be_served_is_refused(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(InvalidOptionError) as raised:
        runs.run(tmp_path / "run", **changes)
    assert words in raised.value.message
    assert not (tmp_path / "run").exists()


def test_it_has_to_say_what_it_serves(tmp_path: Path) -> None:
    with pytest.raises(InvalidOptionError, match="does not report which checkpoint"):
        serve(tmp_path / "run", "--metadata", "{}")
    with pytest.raises(PolicyServerError, match="serves the checkpoint 'tiny/1', not 'mine'"):
        serve(tmp_path / "other", policy_options=("checkpoint=mine",))


def test_a_worker_whose_server_says_something_else_does_no_rollout(tmp_path: Path) -> None:
    with pytest.raises(WorkerRetiredError, match="'other'"):
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


def test_what_a_script_started_ends_with_it(tmp_path: Path) -> None:
    """A shell that waits for the server would leave it behind."""
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
        with pytest.raises(InterferenceError, match="ended"):
            policy.metadata()
        assert policy.log() == b"port\n"
    finally:
        policy.close()
