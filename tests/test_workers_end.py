"""Worker processes end, and with them what they started, however the work ends."""

import contextlib
import math
import operator
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from worker_calls import FOREVER, is_alive, run, script, wait_until_gone

from robomme_interference_data.workers import run_tasks

pytestmark = pytest.mark.timeout(150)


@pytest.fixture
def pid_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "pids"
    folder.mkdir()
    return folder


def hang_with_pid(folder: Path) -> Any:
    return partial(
        exec,
        f"import os, pathlib, time\npathlib.Path({str(folder)!r}, str(os.getpid())).touch()\n"
        f"time.sleep({FOREVER})\n",
    )


def pids_in(folder: Path, count: int) -> list[int]:
    """Wait for as many workers to say that they are at work."""
    deadline = time.monotonic() + 60
    while len(list(folder.iterdir())) < count:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return [int(path.name) for path in folder.iterdir()]


def test_closing_stops_the_workers(pid_folder: Path) -> None:
    tasks = [partial(math.sqrt, 4), *(hang_with_pid(pid_folder) for _ in range(3))]
    outcomes = run_tasks(operator.call, tasks, workers=3)
    assert next(outcomes).value == 2
    pids = pids_in(pid_folder, 2)
    assert all(map(is_alive, pids))
    outcomes.close()
    wait_until_gone(pids, seconds=5)


def test_an_error_of_the_caller_stops_the_workers(pid_folder: Path) -> None:
    tasks = [partial(math.sqrt, 4), hang_with_pid(pid_folder)]
    with (
        pytest.raises(ZeroDivisionError),
        contextlib.closing(run_tasks(operator.call, tasks, workers=2)) as outcomes,
    ):
        for _ in outcomes:
            pids = pids_in(pid_folder, 1)
            raise ZeroDivisionError
    wait_until_gone(pids, seconds=5)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_workers_end_with_their_parent(pid_folder: Path, how: signal.Signals) -> None:
    """However it ends, and though their tasks hang."""
    code = (
        "import operator, sys\n"
        "from functools import partial\n"
        "from robomme_interference_data.workers import run_tasks\n"
        "if __name__ == '__main__':\n"
        f"    task = partial(exec, {hang_with_pid(pid_folder).args[0]!r})\n"
        "    list(run_tasks(operator.call, [task] * 4, workers=2))\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as parent:
        try:
            pids = pids_in(pid_folder, 2)
            assert all(map(is_alive, pids))
            parent.send_signal(how)
            parent.wait(30)
        finally:
            parent.kill()
    wait_until_gone(pids, seconds=20)


def test_idle_workers_end_with_their_parent(pid_folder: Path) -> None:
    """One worker waits for work when the parent is killed."""
    script = (
        "import operator, os, pathlib, signal, time\n"
        "from functools import partial\n"
        "from robomme_interference_data.workers import run_tasks\n"
        "if __name__ == '__main__':\n"
        f"    folder = {str(pid_folder)!r}\n"
        f"    tasks = [partial(os.getpid), partial(exec, {hang_with_pid(pid_folder).args[0]!r})]\n"
        "    for outcome in run_tasks(operator.call, tasks, workers=2):\n"
        "        pathlib.Path(folder, str(outcome.value)).touch()\n"
    )
    with subprocess.Popen([sys.executable, "-c", script]) as parent:
        try:
            pids = pids_in(pid_folder, 2)
        finally:
            parent.kill()
    wait_until_gone(pids, seconds=20)


# --- what workers leave behind -----------------------------------------------------------------

STARTS = (
    "import multiprocessing, os, pathlib, time\n"
    "process = multiprocessing.get_context('{method}').Process(target=time.sleep, args=(1e5,))\n"
    "process.start()\n"
    "pathlib.Path('{folder}', str(process.pid)).touch()\n"
    "pathlib.Path('{folder}', str(os.getpid())).touch()\n"
)


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_may_start_processes_which_end_with_them(pid_folder: Path, method: str) -> None:
    started = STARTS.format(method=method, folder=pid_folder)
    (outcome,) = run([partial(exec, started)])
    assert outcome.error is None
    wait_until_gone(pids_in(pid_folder, 2), seconds=5)


def test_processes_of_a_worker_end_though_everything_above_is_killed(
    pid_folder: Path, tmp_path: Path
) -> None:
    started = STARTS.format(method="fork", folder=pid_folder) + "time.sleep(1e5)\n"
    command = script(
        tmp_path,
        "import operator\nfrom functools import partial\n"
        "from robomme_interference_data.workers import run_tasks\n"
        "if __name__ == '__main__':\n"
        f"    list(run_tasks(operator.call, [partial(exec, {started!r})], workers=1))\n",
    )
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as parent:
        try:
            pids = pids_in(pid_folder, 2)
            assert all(map(is_alive, pids))
        finally:
            parent.kill()
    wait_until_gone(pids, seconds=20)


def test_a_dead_worker_is_noticed_though_its_process_holds_the_pipe(pid_folder: Path) -> None:
    dies = STARTS.format(method="fork", folder=pid_folder) + "os._exit(3)\n"
    (outcome,) = run([partial(exec, dies)], attempts=1)
    assert str(outcome.error) == "the worker process died (exit code 3)"
    wait_until_gone(pids_in(pid_folder, 2), seconds=5)


def test_workers_without_work_close_what_they_hold_and_print_to_stderr(tmp_path: Path) -> None:
    (tmp_path / "held.py").write_text(
        "import os, subprocess, time\n"
        "class Held:\n"
        "    def __call__(self, task):\n"
        "        print('printed', task, flush=True)\n"
        "        subprocess.run(['echo', 'echoed'], check=True)\n"
        "        return task\n"
        "    def close(self):\n"
        "        print('closed', flush=True)\n"
    )
    command = script(
        tmp_path,
        "import held\nfrom robomme_interference_data.workers import run_tasks\n"
        "if __name__ == '__main__':\n"
        "    print([outcome.value for outcome in run_tasks(held.Held(), [1], workers=1)])\n",
    )
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[1]\n"
    assert done.stderr.split() == ["printed", "1", "echoed", "closed"]


def test_what_does_not_close_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from robomme_interference_data import workers

    monkeypatch.setattr(workers, "_CLOSE_S", 1.0)
    stays = (
        f"import threading, time\nthreading.Thread(target=time.sleep, args=({FOREVER},)).start()"
    )
    began = time.monotonic()
    (outcome,) = run([partial(exec, stays)])
    assert outcome.error is None
    assert time.monotonic() - began < 30
