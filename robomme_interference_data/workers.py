"""Run tasks in worker processes that may hang or die without taking the work with them.

`concurrent.futures` gives up on all work when one process dies and cannot stop a hung task; here
such a worker is replaced and its task tried again, then reported.
"""

import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from typing import Any

from robomme_interference_data.errors import InterferenceError, InvalidOptionError

__all__ = ["Outcome", "run_tasks", "worker_number"]


@dataclass(frozen=True)
class Outcome:
    """What became of a task.

    Attributes:
        task: The task.
        value: What the function returned, or None.
        error: Why there is no value, or None. An error that the function raised is itself; a
            death or a time-out of the worker is a `RuntimeError` or `TimeoutError`.
        attempts: How often the task was started.
    """

    task: Any
    value: Any
    error: BaseException | None
    attempts: int


class _Worker:
    """A process, the parent's end of its pipe, and the task that it works on."""

    def __init__(self, context: Any, function: Callable[[Any], Any], number: int):
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=_serve, args=(function, other, number), daemon=True)
        self.process.start()
        other.close()
        self.task: Any = None
        self.attempts = 0
        self.started = 0.0
        self.busy = False

    def give(self, task: Any, attempts: int) -> None:
        self.task, self.attempts, self.busy = task, attempts, True
        self.started = time.monotonic()
        with suppress(OSError):  # it died while idle: `settle` finds out
            self.pipe.send(task)

    def settle(self, time_limit: float | None) -> Outcome | Exception | None:
        """Return the outcome, why there will be none, or None while there is nothing to say."""
        if not self.busy:
            return None
        if not self.pipe.poll():
            if time_limit is None or time.monotonic() - self.started <= time_limit:
                return None
            return TimeoutError(f"still running after {time_limit:g} s")
        try:
            value, error = self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            return RuntimeError(f"the worker process died (exit code {self.process.exitcode})")
        self.busy = False
        return Outcome(self.task, value, error, self.attempts)

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def run_tasks(
    function: Callable[[Any], Any],
    tasks: Iterable[Any],
    *,
    workers: int,
    time_limit: float | None = None,
    attempts: int = 2,
) -> Generator[Outcome]:
    """Call a function on every task in worker processes; yield outcomes as they come.

    An exception that the function raises is final. A worker that dies or exceeds the time limit
    is replaced, and its task is started again up to `attempts` times. When the generator is
    closed, all workers are stopped.

    Args:
        function: Picklable function of one task; it is sent to each worker once.
        tasks: Picklable tasks.
        workers: Number of processes.
        time_limit: Seconds that one task may take; None for no limit.
        attempts: How often a task is started before its death or time-out is reported.

    Raises:
        InvalidOptionError: `workers` is not positive.
    """
    if workers < 1:
        raise InvalidOptionError(f"--workers {workers}; expected 1 or more")
    waiting = deque((task, 1) for task in tasks)
    # "spawn": a fork of a process with threads (encoders, simulators) can hang.
    context = multiprocessing.get_context("spawn")
    running = [_Worker(context, function, n) for n in range(min(workers, len(waiting)))]
    try:
        while waiting or any(worker.busy for worker in running):
            for worker in running:
                if waiting and not worker.busy:
                    worker.give(*waiting.popleft())
            pipes: list[Connection] = [worker.pipe for worker in running if worker.busy]
            wait(pipes, timeout=_patience(running, time_limit))
            for place, worker in enumerate(running):
                result = worker.settle(time_limit)
                if result is None:
                    continue
                if isinstance(result, Outcome):
                    yield result
                    continue
                worker.stop()
                running[place] = _Worker(context, function, place)
                if worker.attempts < attempts:
                    waiting.append((worker.task, worker.attempts + 1))
                else:
                    yield Outcome(worker.task, None, result, worker.attempts)
    finally:
        for worker in running:
            worker.stop()


def _patience(running: list[_Worker], time_limit: float | None) -> float | None:
    """Return the seconds until the first busy worker exceeds its time."""
    if time_limit is None:
        return None
    first = min(worker.started for worker in running if worker.busy)
    return max(0.05, first + time_limit - time.monotonic())


def worker_number() -> int:
    """Return which of the workers this process is, from 0; its replacement has the same number."""
    return _number


_number = 0


def _serve(function: Callable[[Any], Any], pipe: Connection, number: int) -> None:
    """Work on tasks until the parent is gone."""
    global _number  # noqa: PLW0603, a process is one worker
    _number = number
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    # A parent that was killed cannot stop a task that hangs.
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            task = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            message = ForkingPickler.dumps((function(task), None))
        except InterferenceError as error:
            message = ForkingPickler.dumps((None, error))
        except Exception as error:
            # Foreign exceptions may not survive pickling; their text does.
            text = "".join(traceback.format_exception(error))
            text = f"{type(error).__name__}: {error}\n{text}"
            message = ForkingPickler.dumps((None, RuntimeError(text)))
        try:
            pipe.send_bytes(message)
        except OSError:
            return


def _end_with_parent() -> None:
    """End this process when its parent is gone, whatever it is doing."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
