"""Worker processes: each outcome once after any failure, and no process left behind."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from support.lazy import lazy
from support.messages import raises
from support.worker_calls import behave, is_alive, pids_in, wait_until_gone

from robomme_interference_data.errors import SimulatorCrashError, WorkerError, WorkerRetiredError
from robomme_interference_data.runtime import process
from robomme_interference_data.runtime.executor import Outcome
from robomme_interference_data.runtime.process import Processes

ray_cluster = lazy("support.ray_cluster")
ray_workers = lazy("robomme_interference_data.runtime.ray_cluster")
pytestmark = pytest.mark.timeout(150)

TESTS = Path(__file__).parent.parent

DIED = {"the worker process died"}  # on a cluster, which does not know the exit code

Run = Callable[..., list[Outcome]]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with ray_cluster.running_cluster(3) as made:
        yield made


@pytest.fixture(params=["processes", pytest.param("ray", marks=pytest.mark.slow)])
def run(request: pytest.FixtureRequest) -> Run:
    """The same holds of workers on this machine and on three nodes of a cluster."""
    cluster = request.getfixturevalue("cluster") if request.param == "ray" else None

    def all_of(tasks: list[Any], workers: int = 1, **options: Any) -> list[Outcome]:
        executor = (
            Processes(workers)
            if cluster is None
            else ray_workers.RayWorkers(workers, cluster.address)
        )
        return list(executor.run(behave, tasks, **options))

    return all_of


def script(folder: Path, text: str) -> tuple[list[str], dict[str, str]]:
    """Return the command that runs a script, and its environment."""
    path = folder / "script.py"
    path.write_text("from robomme_interference_data.runtime.process import Processes\n" + text)
    return [sys.executable, str(path)], {**os.environ, "PYTHONPATH": str(TESTS)}


def test_every_task_once_in_other_processes(run: Run) -> None:
    """More tasks than workers; outcomes come in any order."""
    outcomes = run([*[("value", number) for number in range(30)], *[("pid", 0)] * 10], workers=2)
    values = [outcome.value for outcome in outcomes if outcome.task[0] == "value"]
    pids = {outcome.value for outcome in outcomes if outcome.task[0] == "pid"}
    assert sorted(values) == list(range(30))
    assert all(outcome.attempts == 1 and outcome.error is None for outcome in outcomes)
    assert os.getpid() not in pids and 1 <= len(pids) <= 2
    wait_until_gone(list(pids))
    assert run([]) == []


@pytest.mark.slow
def test_failing_tasks_do_not_stop_others(tmp_path: Path, run: Run) -> None:
    """Two workers meet every kind of trouble; what raised is final, what died is tried again."""
    tasks = [
        ("value", b"much" * 5_000_000),
        ("raise", "no number"),
        ("odd", None),
        ("lock", None),
        ("exit", 4),
        ("signal", signal.SIGKILL),
        ("signal", signal.SIGINT),
        ("die once", str(tmp_path / "died")),
    ]
    outcomes = run(tasks, workers=2)
    found = {(o.task[0], o.task[1]): o for o in outcomes}
    assert len(outcomes) == len(tasks)
    assert found["value", tasks[0][1]].value == tasks[0][1]
    assert found["die once", tasks[-1][1]].attempts == 2
    assert found["die once", tasks[-1][1]].error is None
    assert found["signal", signal.SIGINT].error is None  # Ctrl-C is the parent's to handle

    errors = {key: str(outcome.error) for key, outcome in found.items()}
    assert errors["raise", "no number"] == "ValueError: no number"
    assert "raise ValueError" in (found["raise", "no number"].trace or "")
    # What cannot be sent, or not be read, is an outcome too: the worker lives on.
    assert "cannot pickle '_thread.lock'" in errors["lock", None]
    assert "missing 1 required positional argument" in errors["odd", None]
    for key in (("raise", "no number"), ("lock", None), ("odd", None)):
        assert (found[key].attempts, type(found[key].error)) == (1, RuntimeError)
    for key, code in ((("exit", 4), 4), (("signal", signal.SIGKILL), -9)):
        assert errors[key] in DIED | {f"the worker process died (exit code {code})"}
        assert found[key].attempts == 2


def test_a_task_that_exceeds_its_limit_is_given_up(tmp_path: Path, run: Run) -> None:
    (hung,) = run([("hang", str(tmp_path))], time_limit=0.5)
    assert isinstance(hung.error, TimeoutError)
    assert (str(hung.error), hung.attempts) == ("the task took more than 0.5 s", 1)
    (hung,) = run([("hang", str(tmp_path))], time_limit=0.5, again=(TimeoutError,))
    assert hung.attempts == 2
    wait_until_gone(pids_in(tmp_path, 0), seconds=5)


def test_a_part_of_a_task_has_a_limit_of_its_own(run: Run) -> None:
    """Though it holds the interpreter's lock, in C, so that nothing in the worker could end it."""
    hung, fine = run([("hang in a part", 0), ("parts", 0)], attempts=1)
    assert (type(hung.error), str(hung.error)) == (TimeoutError, "a part took more than 0.3 s")
    assert hung.trace is not None and "in behave" in hung.trace
    assert fine.error is None


def test_errors_after_which_a_task_is_started_again(run: Run) -> None:
    (outcome,) = run([("crash", 0)], attempts=3, again=(SimulatorCrashError,))
    assert (type(outcome.error), outcome.attempts) == (SimulatorCrashError, 3)


def test_a_worker_that_retires_leaves_its_task_to_the_others(run: Run) -> None:
    outcomes = run([("retire", (0,))] * 5, workers=2)
    assert [(o.value, o.error, o.attempts) for o in outcomes] == [(1, None, 1)] * 5
    with pytest.raises(WorkerRetiredError) as raised:
        run([("retire", (0, 1))] * 5, workers=2)
    assert raised.value.hint == "Start it."


def test_a_worker_that_does_not_start_is_one_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "START_S", 0.0)
    monkeypatch.setattr(process, "_LOOK_S", 0.0)
    with raises(WorkerError):
        list(Processes(1).run(behave, [("value", 7)]))


def test_work_that_is_given_up_stops_its_workers(tmp_path: Path) -> None:
    tasks = [("value", 2), *[("hang", str(tmp_path))] * 2]
    with closing(Processes(3).run(behave, tasks)) as outcomes:
        assert next(outcomes).value == 2
        pids = pids_in(tmp_path, 2)
        assert all(map(is_alive, pids))
    wait_until_gone(pids, seconds=5)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_workers_and_what_they_started_end_with_their_parent(
    tmp_path: Path, how: signal.Signals
) -> None:
    folder = tmp_path / "pids"
    folder.mkdir()
    tasks = [("start", (str(folder), None)), ("hang", str(folder))]
    command, environment = script(
        tmp_path,
        "from support.worker_calls import behave\n"
        f"if __name__ == '__main__':\n    list(Processes(1).run(behave, {tasks}))\n",
    )
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as parent:
        try:
            pids = pids_in(folder, 2)
            time.sleep(0.2)  # until the second task hangs
            assert all(map(is_alive, pids))
            parent.send_signal(how)
            parent.wait(30)
        finally:
            parent.kill()
    wait_until_gone(pids, seconds=20)


def test_processes_of_a_dead_worker_end_though_they_hold_its_pipe(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a signal to its process group, whose number may belong to other processes by then."""
    monkeypatch.delattr(os, "killpg")
    (outcome,) = run([("start", (str(tmp_path), 3))], attempts=1)
    assert str(outcome.error) in DIED | {"the worker process died (exit code 3)"}
    wait_until_gone(pids_in(tmp_path, 2), seconds=5)


def test_workers_close_what_they_hold_and_print_to_stderr(tmp_path: Path) -> None:
    command, environment = script(
        tmp_path,
        "from support.worker_calls import Held\n"
        "if __name__ == '__main__':\n"
        "    print([outcome.value for outcome in Processes(1).run(Held(), [1])])\n",
    )
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=180, check=True
    )
    assert done.stdout == "[1]\n"
    assert done.stderr.split() == ["printed", "1", "echoed", "closed"]


@pytest.mark.parametrize("from_stdin", [False, True])
def test_a_script_that_workers_cannot_import_gets_one_error(
    tmp_path: Path, from_stdin: bool
) -> None:
    """One that starts work at its top, and one that is no file."""
    text = (
        "from support.worker_calls import behave\nlist(Processes(2).run(behave, [('pid', 0)] * 2))"
    )
    command, environment = script(tmp_path, text)
    done = subprocess.run(
        [sys.executable, "-"] if from_stdin else command,
        input=Path(command[1]).read_text(),
        env=environment,
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.count("errors.WorkerError: ") == 1
    assert 'if __name__ == "__main__":' in done.stderr.splitlines()[-1]
