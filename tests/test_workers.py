"""Worker processes: results exactly once, whatever the workers do."""

import math
import operator
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
from worker_calls import FOREVER, run, script, wait_until_gone

from robomme_interference_data.errors import InvalidIdError, InvalidOptionError, WorkerRetiredError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.workers import run_tasks

pytestmark = pytest.mark.timeout(150)


def test_every_task_once() -> None:
    """More tasks than workers; outcomes come in any order."""
    tasks = [partial(math.sqrt, number) for number in range(40)]
    outcomes = run(tasks, workers=3)
    assert Counter(outcome.task.args[0] for outcome in outcomes) == Counter(range(40))
    for outcome in outcomes:
        assert outcome.value == math.sqrt(outcome.task.args[0])
        assert outcome.error is None
        assert outcome.attempts == 1


def test_no_tasks_and_more_workers_than_tasks() -> None:
    assert run([], workers=4) == []
    (outcome,) = run([partial(math.sqrt, 4)], workers=4)
    assert outcome.value == 2


def test_other_processes_do_the_work() -> None:
    outcomes = run([partial(os.getpid) for _ in range(10)], workers=2)
    pids = {outcome.value for outcome in outcomes}
    assert os.getpid() not in pids
    assert 1 <= len(pids) <= 2
    wait_until_gone(list(pids))


@pytest.mark.parametrize("workers", [0, -1])
def test_workers_must_be_positive(workers: int) -> None:
    with pytest.raises(InvalidOptionError, match=f"--workers {workers}; expected 1 or more"):
        run([partial(math.sqrt, 4)], workers=workers)


def test_whatever_a_task_does_the_others_are_done(tmp_path: Path) -> None:
    """One worker meets every kind of trouble; what raised is final, what died is tried again."""
    marker = tmp_path / "died before"
    dies_once = (
        f"import os, pathlib\nmarker = pathlib.Path({str(marker)!r})\n"
        "if not marker.exists():\n    marker.touch()\n    os._exit(7)\n"
    )
    tasks = {
        "returns None": partial(exec, ""),
        "returns much": partial(bytes, 20_000_000),
        "raises": partial(int, "no number"),
        "raises ours": partial(EpisodeId.parse, "VideoRepick"),
        "exits": partial(os._exit, 3),
        "asks to exit": partial(sys.exit, 4),
        "is killed": partial(signal.raise_signal, signal.SIGKILL),
        "crashes": partial(signal.raise_signal, signal.SIGSEGV),
        "is interrupted": partial(signal.raise_signal, signal.SIGINT),
        "cannot be sent": partial(threading.Lock),
        "dies once": partial(exec, dies_once),
        "works": partial(math.sqrt, 9),
    }
    outcomes = run(list(tasks.values()), workers=2)
    # Tasks come back as copies: they are told apart by what they are made of.
    key = {(task.func, str(task.args)): name for name, task in tasks.items()}
    found = {key[outcome.task.func, str(outcome.task.args)]: outcome for outcome in outcomes}
    assert len(outcomes) == len(found) == len(tasks)

    for name in ("returns None", "is interrupted"):  # Ctrl-C is the parent's to handle
        assert (found[name].value, found[name].error, found[name].attempts) == (None, None, 1)
    assert found["returns much"].value == bytes(20_000_000)
    assert found["works"].value == 3

    error = found["raises"].error
    assert isinstance(error, RuntimeError)
    assert str(error).startswith("ValueError: invalid literal for int()")
    assert "Traceback" in str(error)
    error = found["raises ours"].error
    assert isinstance(error, InvalidIdError)
    assert error.hint == "Expected <Family>/<split>/<index>, for example VideoRepick/test/7."
    error = found["cannot be sent"].error
    assert isinstance(error, RuntimeError)
    assert "cannot pickle '_thread.lock' object" in str(error)
    for name in ("raises", "raises ours", "cannot be sent"):
        assert found[name].attempts == 1

    for name, code in (
        ("exits", 3),
        ("asks to exit", 4),
        ("is killed", -signal.SIGKILL),
        ("crashes", -signal.SIGSEGV),
    ):
        error = found[name].error
        assert isinstance(error, RuntimeError)
        assert str(error) == f"the worker process died (exit code {code})"
        assert (found[name].value, found[name].attempts) == (None, 2)
    assert (found["dies once"].error, found["dies once"].attempts) == (None, 2)


def test_attempts() -> None:
    (outcome,) = run([partial(os._exit, 1)], attempts=1)
    assert outcome.attempts == 1
    (outcome,) = run([partial(os._exit, 1)], attempts=3)
    assert outcome.attempts == 3


def test_time_limit(tmp_path: Path) -> None:
    marker = tmp_path / "hung before"
    hangs_once = (
        f"import pathlib, time\nmarker = pathlib.Path({str(marker)!r})\n"
        f"if not marker.exists():\n    marker.touch()\n    time.sleep({FOREVER})\n"
    )
    pids = tmp_path / "pids"
    hangs = (
        "import os, pathlib, time\n"
        f"pathlib.Path({str(pids)!r}).open('a').write(f'{{os.getpid()}} ')\n"
        f"time.sleep({FOREVER})\n"
    )
    tasks = [partial(exec, hangs), partial(exec, hangs_once), partial(math.sqrt, 4)]
    started = time.monotonic()
    outcomes = run(tasks, workers=2, time_limit=5)
    assert time.monotonic() - started < 60
    found = {str(outcome.task.args): outcome for outcome in outcomes}
    assert len(found) == len(outcomes) == 3
    outcome = found[str((hangs,))]
    assert isinstance(outcome.error, TimeoutError)
    assert str(outcome.error) == "still running after 5 s"
    assert outcome.attempts == 2
    outcome = found[str((hangs_once,))]
    assert (outcome.error, outcome.attempts) == (None, 2)
    assert found["(4,)"].value == 2
    # The hung processes were ended, not left to themselves.
    hung = list(map(int, pids.read_text().split()))
    assert len(hung) == 2
    wait_until_gone(hung)


def test_a_worker_that_retires_leaves_its_task_to_the_others(tmp_path: Path) -> None:
    """Worker 0 retires at its first task, worker 1 never, then after three of them."""
    retires = (
        "import os, pathlib\n"
        "from robomme_interference_data.errors import WorkerRetiredError\n"
        "from robomme_interference_data.workers import worker_number\n"
        f"log = pathlib.Path({str(tmp_path)!r}, 'log')\n"
        "done = log.read_text() if log.exists() else ''\n"
        "if worker_number() == 0 or len(done) == {last}:\n"
        "    raise WorkerRetiredError(f'worker {{worker_number()}} is gone', 'Start it.')\n"
        "log.write_text(done + 'x')\n"
    )
    outcomes = run([partial(exec, retires.format(last=9))] * 5, workers=2)
    assert [(o.error, o.attempts, o.worker) for o in outcomes] == [(None, 1, 1)] * 5
    (tmp_path / "log").unlink()
    ended = []
    with pytest.raises(WorkerRetiredError, match=r"worker [01] is gone") as raised:
        for outcome in run_tasks(
            operator.call, [partial(exec, retires.format(last=3))] * 5, workers=2
        ):
            ended.append(outcome.error)
    assert ended == [None] * 3
    assert raised.value.hint == "Start it."


AGAIN = "the worker processes came upon the call that starts them"


def test_a_script_without_the_guard_gets_one_error(tmp_path: Path) -> None:
    command = script(
        tmp_path,
        "import math\nfrom robomme_interference_data.workers import run_tasks\n"
        "list(run_tasks(math.sqrt, [4, 9], workers=2))\n",
    )
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert done.stderr.count("Traceback") == 1
    assert done.stderr.count(AGAIN) == 1
    assert 'if __name__ == "__main__":' in done.stderr.splitlines()[-1]


def test_a_worker_that_cannot_start_stops_the_work(tmp_path: Path) -> None:
    """A script from stdin is no file that workers could import."""
    done = subprocess.run(
        [sys.executable, "-"],
        input="import math\nfrom robomme_interference_data.workers import run_tasks\n"
        "list(run_tasks(math.sqrt, [4, 9, 16], workers=1))\n",
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.count("No such file or directory") == 1  # its last words
    assert "ended before its first task (exit code 1); what it said is above" in done.stderr
