"""Worker processes on this machine; see `executor.py`."""

import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import InvalidOptionError, WorkerError

from .executor import Executor, WorkerPool
from .process_worker import ProcessWorker, has_begun, read_remains, take_files
from .safe_path import safe_path
from .tasks import (
    STARTED_AGAIN,
    Outcome,
    Scheduler,
    TaskFunction,
    end_if_starting,
    unpickle_outcome,
)

CLOSE_S = 10.0
"""Seconds that idle workers have to release their resources."""

START_S = 300.0
"""Seconds that a worker has to start, which includes importing what its function needs."""

_LOOK_S = 5.0
"""Seconds between checks of workers that have not started yet."""


class WorkerProcess:
    """The caller's side of a worker process."""

    ready = True

    def __init__(self, function: TaskFunction, number: int):
        # "spawn": a fork of a process with threads (encoders, simulators) can hang.
        context = multiprocessing.get_context("spawn")
        self.number = number
        self.pipe, theirs = context.Pipe()
        self._late = time.monotonic() + START_S
        self._home = Path(tempfile.mkdtemp(prefix="robomme-interference-"))
        arguments = (function, theirs, number, self._home)
        self._process = context.Process(target=_serve, args=arguments, daemon=True)
        with safe_path():
            self._process.start()
        # With two ends open here, the death of the process would go unnoticed.
        theirs.close()

    def send(self, task: Any, time_limit: float | None) -> None:
        """Start a task."""
        with suppress(OSError):  # it died while idle: `receive` reports that
            self.pipe.send((task, time_limit))

    def receive(self) -> Outcome:
        """Return the outcome, which has arrived."""
        try:
            data = self.pipe.recv_bytes()
        except (EOFError, OSError):
            return self._death()
        return unpickle_outcome(data, take_files(self._home))

    def check_start(self) -> None:
        """Raise if it takes too long to start."""
        if time.monotonic() > self._late and not has_begun(self._home):
            raise WorkerError(
                f"a worker process did not start within {START_S:g} s",
                "Worker processes import the script that starts them, and what it imports.",
            )

    def kill(self) -> None:
        """Kill it; its guard kills the processes that it started."""
        self._process.kill()

    def stop(self) -> None:
        """Kill it, and release everything that it used."""
        self.kill()
        self.end(0.0)

    def end(self, seconds: float) -> None:
        """Kill it if it does not end within a time."""
        self.pipe.close()
        self._process.join(seconds)
        self._process.kill()
        self._process.join()
        shutil.rmtree(self._home, ignore_errors=True)

    def _death(self) -> Outcome:
        self._process.join()
        code = self._process.exitcode or 0
        if has_begun(self._home) or code < 0:  # a signal can come at any time
            outcome = read_remains(self._home)
            died = RuntimeError(f"the worker process died (exit code {code})")
            return replace(outcome, error=outcome.error or died)
        problem = f"ended before its first task (exit code {code}); its output is above"
        if code == STARTED_AGAIN:
            problem = "would start worker processes while it imports the script"
        raise WorkerError(
            f"a worker process {problem}",
            "Worker processes import the script that starts them: it must be a file that makes "
            'the call under  if __name__ == "__main__":',
        ) from None


class ProcessScheduler(Scheduler[WorkerProcess]):
    """Runs tasks in worker processes."""

    def start(self, number: int) -> WorkerProcess:
        """Start a worker process."""
        return WorkerProcess(self.function, number)

    def wait(self, workers: Sequence[WorkerProcess]) -> Iterable[WorkerProcess]:
        """Wait for outcomes; a worker that died has one, too."""
        answered = wait([worker.pipe for worker in workers], timeout=_LOOK_S)
        for worker in workers:
            worker.check_start()
        return [worker for worker in workers if worker.pipe in answered]

    def close(self) -> None:
        """End all worker processes."""
        for worker in self.workers:
            worker.pipe.close()
        # All release their resources at the same time.
        deadline = time.monotonic() + CLOSE_S
        for worker in self.workers:
            worker.end(max(0.0, deadline - time.monotonic()))


def _serve(function: TaskFunction, pipe: Connection, number: int, home: Path) -> None:
    """Work on tasks until the parent closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    multiprocessing.current_process().daemon = False  # a daemon may not start processes
    parent = multiprocessing.parent_process()
    worker = ProcessWorker(number, home, parent.sentinel if parent else -1)
    os.dup2(2, 1)  # stdout is reserved for the output of the command
    sys.stdout = sys.stderr
    with suppress(OSError, EOFError):
        while True:
            task, time_limit = pipe.recv()
            pipe.send_bytes(worker.work(function, task, time_limit))
    getattr(function, "close", lambda: None)()


@dataclass(frozen=True)
class Processes(Executor):
    """Runs tasks in worker processes, whose crashes and hangs do not stop the others.

    Workers print to stderr. Processes that they start end with them.

    Attributes:
        workers: Number of worker processes.
    """

    workers: int

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise InvalidOptionError.expected("workers", self.workers, "1 or more")
        if not hasattr(os, "setpgid"):  # a worker ends with its process group
            raise WorkerError(
                "worker processes need Linux or macOS",
                "Use one of them, such as the Windows Subsystem for Linux.",
            )

    @contextmanager
    def pool(self, function: TaskFunction) -> Iterator[WorkerPool]:
        """Keep worker processes in the block; see `Executor.pool`."""
        end_if_starting()
        with closing(ProcessScheduler(function, self.workers)) as scheduler:
            yield scheduler
