"""Tasks for worker processes, and whether these are gone."""

import ctypes
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import psutil

from robomme_interference_data.errors import (
    InterferenceError,
    SimulatorCrashError,
    WorkerRetiredError,
)
from robomme_interference_data.runtime.executor import Worker

FOREVER = 100_000.0


class OddError(InterferenceError):
    """Can be pickled, but not read again: it wants two words."""

    def __init__(self, one: str, other: str):
        super().__init__(one + other)


def once(mark: str) -> bool:
    """Whether this is the first call with this file."""
    if Path(mark).exists():
        return False
    Path(mark).touch()
    return True


def behave(task: tuple[str, Any], worker: Worker) -> Any:
    """Do what the task's first word says; where a file is given, only the first time."""
    what, more = task
    match what:
        case "value":
            return more
        case "pid":
            return os.getpid()
        case "number":
            return worker.number
        case "raise":
            raise ValueError(more)
        case "odd":
            raise OddError("odd", "error")
        case "lock":
            return threading.Lock()
        case "exit":
            sys.exit(more)
        case "signal":
            signal.raise_signal(more)
        case "die once":
            if once(more):
                os._exit(7)
        case "hang":
            Path(more, str(os.getpid())).touch()
            time.sleep(FOREVER)
        case "hang in a part":
            with worker.limit(0.3, "a part"):
                ctypes.PyDLL(None).sleep(int(FOREVER))  # in C, with the interpreter's lock held
        case "parts":
            for _ in range(3):
                with worker.limit(0.5, "a part"):
                    time.sleep(0.2)
        case "start":
            folder, end = more
            fork: Any = multiprocessing.get_context("fork")
            process = fork.Process(target=time.sleep, args=(FOREVER,))
            process.start()
            for pid in (process.pid, os.getpid()):
                Path(folder, str(pid)).touch()
            if end is not None:
                os._exit(end)
        case "retire":
            if worker.number in more:
                raise WorkerRetiredError(f"worker {worker.number} is gone", "Start it.")
            return worker.number
        case "crash":
            raise SimulatorCrashError("died")
    return None


class Held:
    """Prints, starts a program that prints, and closes."""

    def __call__(self, task: Any, worker: Worker) -> Any:
        sys.stdout.write(f"printed {task}\n")
        subprocess.run(["echo", "echoed"], check=True)
        return task

    def close(self) -> None:
        sys.stdout.write("closed\n")


class Marked:
    """Says of itself what its node's environment says."""

    def __call__(self, task: Any, worker: Worker) -> Any:
        return task

    def describe(self) -> dict[str, str]:
        return {"mark": os.environ.get("MARK", "none")}


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that ended and that nobody waited for does not."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def wait_until_gone(pids: list[int], seconds: float = 30) -> None:
    deadline = time.monotonic() + seconds
    while any(map(is_alive, pids)):
        assert time.monotonic() < deadline, f"still running: {list(filter(is_alive, pids))}"
        time.sleep(0.05)


def pids_in(folder: Path, count: int) -> list[int]:
    """Wait for as many processes to have left their number in a folder."""
    deadline = time.monotonic() + 60
    while len(list(folder.iterdir())) < count:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return [int(path.name) for path in folder.iterdir()]
