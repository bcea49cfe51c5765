"""Runs that share a policy, in real processes: same rows, faults, no process left behind."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from support import runs, worlds
from support.lazy import lazy
from support.messages import raises
from support.worker_calls import wait_until_gone

from robomme_interference_data.errors import (
    InvalidOptionError,
    LeakError,
    PolicyError,
    ServerDiedError,
)
from robomme_interference_data.evaluate import run_evaluation
from robomme_interference_data.evaluate.policies.process import policy_processes
from robomme_interference_data.evaluate.policies.shared import SharedPolicy
from robomme_interference_data.runtime.process import Processes

pytestmark = pytest.mark.usefixtures("world")

SHARED = "python:support.shared_policies:"
THREE = ("no-history", "k0", "k1")
small = lazy("support.lerobot_policies")


def run(out: Path, policy: str = "Remembering", **changes: Any) -> Any:
    shared = {"workers": 2, "policies": 1, "conditions": THREE}
    policy = policy if ":" in policy else SHARED + policy
    return runs.run(out, Processes(2), **{"policy": policy, **shared, **changes})


@pytest.mark.slow
def test_rows_are_those_of_policies_that_are_not_shared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs.run(tmp_path / "own", policy=f"{SHARED}Remembering", conditions=THREE)
    expected = runs.finished_rows(tmp_path / "own")
    assert {(row["condition"], row["status"]) for row in expected} == {
        *(("no-history", "fail"), ("k0", "success"), ("k1", "success"))
    }
    # A run resumes with shared policies: they are no part of its identity.
    runs.run(tmp_path / "run", policy=f"{SHARED}Remembering", conditions=THREE[:1])
    run(tmp_path / "run", max_batch_size=1)
    assert runs.finished_rows(tmp_path / "run") == expected
    assert not (tmp_path / "batches").exists()
    # Rollouts last until both workers have started.
    monkeypatch.setenv(worlds.PAUSE, "0.5")
    run(tmp_path / "batched", batch_wait_timeout_s=1.0)
    assert runs.finished_rows(tmp_path / "batched") == expected
    assert {*(tmp_path / "batches").read_text().split()} == {"2"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "words"),
    [
        ("Leaky", "under no-history has another action at step 0 after"),
        # Its reset clears the memory that all sessions have: two of them at once disturb it.
        ("OneMemory", "while another client plays"),
    ],
)
def test_a_leak_of_a_shared_policy_is_an_error_before_the_run(
    tmp_path: Path, policy: str, words: str
) -> None:
    with pytest.raises(LeakError) as raised:
        run(tmp_path / "run", policy=f"python:support.leaky:{policy}", no_probe=False)
    assert raised.value.component == "policy" and words in raised.value.message
    assert not (tmp_path / "run" / "run.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["die", "hang"])
def test_a_process_that_dies_or_hangs_costs_no_rollout(tmp_path: Path, fault: str) -> None:
    (tmp_path / fault).write_text("")
    limit = 30.0 if fault == "hang" else 600.0
    result = run(tmp_path / "run", policy_options=(f"fault={fault}",), rollout_timeout_s=limit)
    assert result.counts == {"success": 4, "fail": 2} | dict.fromkeys(("timeout", "error"), 0)
    assert not (tmp_path / fault).exists()
    repeated = [row.attempt for row in result.rows if row.attempt > 1]
    assert repeated in ([2], [2, 2])  # at most what the two workers ran


@pytest.mark.slow
def test_one_bad_rollout_fails_alone(tmp_path: Path) -> None:
    result = run(tmp_path / "run", policy_options=("fault=goal",), batch_wait_timeout_s=1.0)
    errors = {row.family: row.error for row in result.rows if row.status == "error"}
    assert errors == {"MoveCube": "RuntimeError: Odd: this goal is odd"}
    assert result.counts["error"] == 3 and result.counts["success"] == 2
    log = (tmp_path / "run" / "errors.log").read_text()
    assert "In the policy's process" in log and "shared_policies.py" in log


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "kind"), [("Unloadable", PolicyError), ("Dying", ServerDiedError)]
)
def test_a_policy_that_cannot_be_loaded_is_one_error(
    tmp_path: Path, policy: str, kind: type[Exception]
) -> None:
    with raises(kind):
        run(tmp_path / "run", policy)
    assert not (tmp_path / "run" / "rollouts.jsonl").exists()


@pytest.mark.parametrize(
    "changes",
    [
        {"policy": f"{SHARED}Bare"},
        {"policy": "replay"},
        {"policy": f"{SHARED}Seeing"},
        {"policies": 3},
        {"policies": 0},
        {"max_batch_size": 0},
        {"batch_wait_timeout_s": -1.0},
        {"policies": None, "max_batch_size": 2},
        {"policy_resources": ("gpus=0.5",)},
        {"executor": "ray", "policy_resources": ("gpus=1.5",)},
    ],
)
def test_what_cannot_be_shared_is_an_error(tmp_path: Path, changes: dict[str, Any]) -> None:
    usual = {"policy": f"{SHARED}Remembering", "workers": 2, "policies": 1}
    with raises(InvalidOptionError):
        run_evaluation(runs.config(out=tmp_path / "run", **{**usual, "system": None, **changes}))


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGINT])
def test_no_process_outlives_the_command(tmp_path: Path, sent: signal.Signals) -> None:
    usual = f"evaluate {os.environ[worlds.BUFFER_SET]} --policy {SHARED}Remembering --system mine"
    usual += f" --simulator {runs.WORLD} --no-probe --workers 2 --policies 2 --json"
    usual += f" --out {tmp_path / 'run'}"
    command = [sys.executable, "-m", "robomme_interference_data.cli.main", *usual.split()]
    running = subprocess.Popen(
        command,
        env=os.environ | {worlds.PAUSE: "0.05"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    runs.wait_for_rows(tmp_path / "run", 1, running)
    started = [one.pid for one in psutil.Process(running.pid).children(recursive=True)]
    assert len(started) >= 8  # two workers, two policies, and a guard beside each
    os.kill(running.pid, sent)
    _, err = running.communicate(timeout=180)
    wait_until_gone(started)
    if sent == signal.SIGINT:
        assert running.returncode == 130 and "Traceback" not in err
        assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "incomplete"


@pytest.mark.slow
def test_a_shared_act_returns_the_same_bits(tmp_path: Path) -> None:
    lerobot = pytest.importorskip("robomme_interference_data.evaluate.policies.lerobot.policy")
    for kind in ("act", "vqbet"):
        folder = small.save_policy(
            tmp_path / kind, kind, *(() if kind == "act" else [("observation.images.front",)])
        )
        own = lerobot.LeRobotPolicy(str(folder), device="cpu")
        config = runs.config(
            policy=f"lerobot:{folder}", policy_options=("device=cpu",), policies=1, max_batch_size=1
        )
        with policy_processes(config) as (address,):
            shared = SharedPolicy.open(address, 0)
            assert (shared.cameras, shared.every_frame) == (own.cameras, own.every_frame)
            assert shared.metadata() == own.metadata()
            for _ in range(2):
                pairs = [small.play(one, 3, [1, 2, 1]) for one in (shared, own)]
                for one, other in zip(*pairs, strict=True):
                    np.testing.assert_array_equal(one, other)
            shared.close()
