"""`vla-eval run` with this benchmark, against vla-eval's own server on the loopback interface."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from support import runs, worlds
from support.lazy import lazy
from support.messages import raises
from typer.testing import CliRunner

from robomme_interference_data.cli.main import app
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    PolicyError,
    RunError,
    UnknownNameError,
)
from robomme_interference_data.evaluate.score.rows.reading import read_rows

pytestmark = pytest.mark.usefixtures("world")

TESTS = Path(__file__).parents[1]
BUFFERS = str(TESTS / "golden" / "buffer_set")
CONDITIONS = ("no-history", "k0", "k1")
benchmark = lazy("robomme_interference_data.evaluate.vla_eval.benchmark")
configuration = lazy("robomme_interference_data.evaluate.vla_eval.configuration")
connections = lazy("vla_eval.connection")
export = lazy("vla_eval.results.export")
orchestrator = lazy("vla_eval.orchestrator")
servers = lazy("support.vla_eval_servers")
specs = lazy("vla_eval.specs")


def run(folder: Path, server: str, conditions: str = "no-history,k0,k1") -> tuple[Any, Path]:
    """What `vla-eval run` printed, and the file of its results."""
    arguments = ["vla-eval-config", BUFFERS, "--system", "mine", "--simulator", runs.WORLD]
    arguments += ["--families", ",".join(worlds.FAMILIES), "--conditions", conditions]
    arguments += ["--url", server, "--output-dir", str(folder)]
    printed = CliRunner().invoke(app, arguments)
    assert printed.exit_code == 0, printed.output
    folder.mkdir()
    (folder / "config.yaml").write_text(printed.output)
    program = Path(sys.executable).with_name("vla-eval")
    command = [program, "run", "--no-docker", "-c", folder / "config.yaml"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    return done, folder / "RoboMMEInterference_aggregate.json"


@pytest.mark.slow
def test_its_rows_are_those_of_evaluate(tmp_path: Path) -> None:
    policy = "python:support.shared_policies:Remembering"
    expected = runs.untimed(runs.run(tmp_path / "own", policy=policy, conditions=CONDITIONS).rows)
    with servers.serving("Remembering") as server:
        done, results = run(tmp_path / "results", server)
    assert done.returncode == 0, done.stderr
    tasks = json.loads(results.read_text())["tasks"]
    rows = [episode["metrics"] for task in tasks for episode in task["episodes"]]
    timed = {name for name in rows[0] if name not in expected[0]}
    found = [{name: value for name, value in row.items() if name not in timed} for row in rows]

    def key(row: Any) -> Any:
        return row["family"], row["condition"]

    assert {row["policy"] for row in found} == {"vla-eval"}
    assert sorted(runs.of_any_policy(found), key=key) == sorted(
        runs.of_any_policy(expected), key=key
    )
    assert {(row["condition"], row["status"]) for row in found} == {
        *(("no-history", "fail"), ("k0", "success"), ("k1", "success"))
    }
    # They are scored together with those of runs.
    scored = read_rows([results])
    same = dict.fromkeys(("video", "policy", "policy_id", "history_s", "policy_s", "model_s"))
    own = {row._replace(**same) for row in read_rows([tmp_path / "own"])}
    assert {row._replace(**same) for row in scored} == own


@pytest.mark.slow
def test_a_server_without_memory_gets_no_history(tmp_path: Path) -> None:
    with servers.serving("Blind") as server:
        done, results = run(tmp_path / "refused", server)
        assert done.returncode != 0 and not results.exists()
        assert "did not ask for histories" in done.stderr and "no-history" in done.stderr
        done, results = run(tmp_path / "results", server, "no-history")
    assert [row.status for row in read_rows([results])] == ["fail", "fail"]


@pytest.mark.slow
def test_what_fails_is_an_error_and_the_next_rollout_runs(tmp_path: Path) -> None:
    (tmp_path / "MoveCube-0").write_text("raise once")
    with servers.serving("Refusing") as server:
        done, results = run(tmp_path / "results", server, "no-history,k0")
    assert done.returncode == 0, done.stderr
    statuses = {(row.family, row.condition): row.status for row in read_rows([results])}
    assert statuses == {
        ("VideoRepick", "no-history"): "error",  # the server raised
        ("VideoRepick", "k0"): "error",
        ("MoveCube", "no-history"): "error",  # the simulator broke
        ("MoveCube", "k0"): "success",
    }
    text = results.read_text()
    assert "this goal is odd" in text and "the world fell apart" in text


def orchestrate(folder: Path, port: int, **params: Any) -> list[Any]:
    """The rows that are scored after vla-eval's orchestrator ran in this process."""
    given = {"buffer_set": BUFFERS, "system": "mine", "simulator": runs.WORLD, "episodes": "0"}
    entry = {"benchmark": configuration.BENCHMARK, "episodes_per_task": 1}
    entry["params"] = given | {"families": [*worlds.FAMILIES]} | params
    settings: dict[str, Any] = {"server": {"url": f"ws://127.0.0.1:{port}", "timeout": 20}}
    settings |= {"output_dir": str(folder), "benchmarks": [entry]}
    played = orchestrator.Orchestrator(settings)
    anyio.run(played.run)
    export.export_eval(folder, played.eval_id)
    return list(read_rows([folder / "RoboMMEInterference_aggregate.json"]))


def test_a_connection_that_is_closed_within_an_episode_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    receive = connections.Connection.recv

    async def late(*given: Any, **settings: Any) -> Any:
        message = await receive(*given, **settings)
        await anyio.sleep(0.02)  # the client notices the end before the next observation
        return message

    monkeypatch.setattr("vla_eval.connection.Connection.recv", late)
    with servers.running(servers.Leaving(1, 3)) as port:
        rows = orchestrate(tmp_path, port, conditions=["k0", "k1"])
    assert sorted((row.condition, row.status) for row in rows) == [
        *[("k0", "error")] * 2,
        *[("k1", "success")] * 2,
    ]


def test_an_unread_answer_is_not_taken_for_a_later_one(tmp_path: Path) -> None:
    with servers.running(servers.Full(1)) as port:
        rows = orchestrate(tmp_path, port, conditions=["k0", "k1"])
    assert sorted((row.status, row.steps) for row in rows) == [
        ("error", 0),
        *[("success", 5)] * 3,  # not one step later, as with the answer to the observation before
    ]


def test_another_server_ends_the_run(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with servers.running(servers.Reloading(1)) as port:
        rows = orchestrate(tmp_path, port, conditions=["k0", "k1"])
    assert [row.status for row in rows] == ["error", "error"]
    assert "'checkpoint': 1" in caplog.text and "it began with" in caplog.text


@pytest.mark.parametrize("fault", ["version", "actions", "wrist"])
def test_a_server_that_does_not_fit_ends_before_the_first_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    server = servers.Noting(actions={"position": specs.POSITION_DELTA})
    if fault == "wrist":
        server = servers.Noting(observations={"wrist": specs.IMAGE_RGB})
    if fault == "version":
        assert benchmark.RoboMMEInterference  # imported with the version of this side
        monkeypatch.setattr("vla_eval.protocol.messages.PROTOCOL_VERSION", 2)
        server = servers.Noting()
    with servers.running(server) as port, pytest.raises(SystemExit) as raised:
        orchestrate(tmp_path, port, conditions=["no-history"])
    words = {
        "version": "speaks version 2",
        "actions": "action position (3 values, delta_xyz)",
        "wrist": "send_wrist_image: true",
    }
    assert words[fault] in str(raised.value.code)
    assert not [*tmp_path.glob("*.json")]


def test_a_robot_of_another_size_is_refused() -> None:
    with raises(InvalidOptionError):
        make(conditions=["no-history"], simulator="support.own_simulators:TwoArms")


def test_the_configuration(tmp_path: Path) -> None:
    command = ["vla-eval-config", BUFFERS, "--system", "mine", "--simulator", "robomme"]
    command += ["--families", "MoveCube,PatternLock", "--conditions", "k1,k0", "--episodes", "0"]
    assert CliRunner().invoke(app, [*command, "--out", str(tmp_path / "c.yaml")]).exit_code == 0
    expected = f"""server:
  url: ws://localhost:8000
  timeout: 600.0
output_dir: results
benchmarks:
- benchmark: robomme_interference_data.evaluate.vla_eval.benchmark:RoboMMEInterference
  episodes_per_task: 1
  params:
    buffer_set: {BUFFERS}
    system: mine
    simulator: robomme
    conditions:
    - k0
    - k1
    episodes: '0'
    families:
    - MoveCube
    - PatternLock
"""
    assert (tmp_path / "c.yaml").read_text() == expected
    for option, value in (("--conditions", "k5"), ("--system", "perceptual-framesamp-modul")):
        refused = CliRunner().invoke(app, [*command, option, value])
        assert isinstance(refused.exception, InterferenceError) and value in str(refused.exception)


def make(**settings: Any) -> Any:
    given = {"buffer_set": BUFFERS, "system": "mine", "simulator": runs.WORLD}
    return benchmark.RoboMMEInterference(**given | settings)


def test_bad_settings_are_refused() -> None:
    with raises(InvalidOptionError):
        make(conditions=["k0"])
    with raises(InvalidOptionError):
        make(system="perceptual-framesamp-modul")
    with raises(UnknownNameError):
        make(condition=["k0"])
    with raises(UnknownNameError):
        make(conditions=["k5"], send_video_history=True)
    # YAML has other types than a command line.
    others = {"conditions": "k0", "families": None, "episodes": 0, "system": 5, "send_state": "yes"}
    for name, value in others.items():
        with raises(InvalidOptionError):
            make(**{name: value})


def test_an_episode_beyond_the_last_and_one_that_is_cut_short() -> None:
    played = make(conditions=["no-history"], families=["MoveCube"], episodes="0")
    (task,) = played.get_tasks()
    assert task["name"] == "MoveCube/no-history" and task["episode"] == "0"
    with raises(InvalidOptionError):
        played.reset({**task, "episode_idx": 1})
    first = played.make_obs(played.reset({**task, "episode_idx": 0}), task)
    assert sorted(first["images"]) == ["agentview"] and "video_history" not in first
    result = played.step({"actions": first["states"]})
    assert not result.done
    with raises(RunError):
        played.get_step_result(result)
    played.cleanup()  # while the rollout waits for an action


def test_a_simulator_that_exits_breaks_one_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    played = make(conditions=["no-history"], families=["MoveCube"], episodes="0")
    (task,) = played.get_tasks()
    with monkeypatch.context() as patch:
        patch.setattr(worlds.World, "step", lambda *_, **__: sys.exit("gone"))
        first = played.make_obs(played.reset({**task, "episode_idx": 0}), task)
        with raises(RunError):
            played.step({"actions": first["states"]})
    again = played.make_obs(played.reset({**task, "episode_idx": 0}), task)
    assert again["episode_restart"]
    played.cleanup()


def test_a_chunk_is_carried_out_action_by_action() -> None:
    played = make(conditions=["no-history"], families=["MoveCube"], episodes="0")
    (task,) = played.get_tasks()
    observation = played.make_obs(played.reset({**task, "episode_idx": 0}), task)
    chunk = [observation["states"]] * 25  # 16 are executed
    results = [played.step({"actions": chunk}) for _ in range(3)]
    assert [one.done for one in results] == [False, False, True]
    row = played.get_step_result(results[-1])
    assert (row["steps"], row["status"], row["success"]) == (worlds.STEPS, "fail", False)
    played.reset({**task, "episode_idx": 0})
    with raises(PolicyError):
        played.step({"actions": [[*observation["states"][:7], np.nan]]})
    played.cleanup()
