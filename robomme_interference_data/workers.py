"""Run tasks in worker processes that may hang or die without taking the work with them.

`concurrent.futures` gives up on all work when one process dies and cannot stop a hung task; here
such a worker is replaced and its task tried again, then reported.
"""

import multiprocessing
import os
import signal
import sys
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

from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    WorkerError,
    WorkerRetiredError,
)

__all__ = ["Outcome", "end_if_starting", "run_tasks", "worker_number"]

_CLOSE_S = 10.0
"""Seconds that workers without work have to close what they hold."""

_LOOK_S = 5.0
"""Seconds between two looks for dead workers whose pipes their own children hold open."""

_STARTED_AGAIN = 97
"""Exit code of a worker that came upon the call that started it."""


@dataclass(frozen=True)
class Outcome:
    """What became of a task.

    Attributes:
        task: The task.
        value: What the function returned, or None.
        error: Why there is no value, or None. An error that the function raised is itself; a
            death or a time-out of the worker is a `RuntimeError` or `TimeoutError`.
        attempts: How often the task was started.
        worker: `worker_number` of the worker that had it last.
    """

    task: Any
    value: Any
    error: BaseException | None
    attempts: int
    worker: int = 0


class _Worker:
    """A process, the parent's end of its pipe, and the task that it works on."""

    def __init__(self, context: Any, function: Callable[[Any], Any], number: int):
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=_serve, args=(function, other, number), daemon=True)
        self.process.start()
        other.close()
        self.number = number
        self.task: Any = None
        self.attempts = 0
        self.started = 0.0
        self.ready = self.busy = False
        self.retired: WorkerRetiredError | None = None

    def give(self, task: Any, attempts: int) -> None:
        self.task, self.attempts, self.busy = task, attempts, True
        self.started = time.monotonic()
        with suppress(OSError):  # it died while idle: `settle` finds out
            self.pipe.send(task)

    def settle(self, time_limit: float | None) -> Outcome | Exception | None:
        """Return the outcome, why there will be none, or None while there is nothing to say."""
        if not self.busy:
            return None
        if not self.pipe.poll() and self.process.is_alive():
            late = time_limit is not None and time.monotonic() - self.started > time_limit
            return TimeoutError(f"still running after {time_limit:g} s") if late else None
        try:
            # What a dead worker started may hold its pipe open.
            message = self.pipe.recv() if self.pipe.poll() else None
        except (EOFError, OSError):
            message = None
        if message is None:
            return self._died()
        if not self.ready:  # the first message says that it is
            self.ready = True
            return None
        value, error = message
        self.busy = False
        return Outcome(self.task, value, error, self.attempts, self.number)

    def stop(self) -> None:
        """End it now, and what it has started."""
        self.process.kill()
        with suppress(ProcessLookupError, PermissionError):  # no process of the group is left
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.join()
        self.pipe.close()

    def _died(self) -> Exception:
        self.process.join()
        code = self.process.exitcode
        if self.ready or code < 0:  # a signal can come at any time
            return RuntimeError(f"the worker process died (exit code {code})")
        if code == _STARTED_AGAIN:
            raise WorkerError(
                "the worker processes came upon the call that starts them: each imports the "
                "script that is running",
                'Put the call into the script under  if __name__ == "__main__":',
            )
        raise WorkerError(
            f"a worker process ended before its first task (exit code {code}); what it said is "
            "above",
            "Worker processes import the script that starts them: it has to be a file, with the "
            'call under  if __name__ == "__main__":',
        )


def end_if_starting() -> None:
    """End this process, without a word, if it is a worker that is only importing the script.

    So a script that starts work at its top, which each worker would start again, gets one error
    from its own process: see `run_tasks`.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        sys.exit(_STARTED_AGAIN)


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
    is replaced, and its task is started again up to `attempts` times. A worker whose function
    raises `WorkerRetiredError` gives its task back to the others and ends. When the tasks are
    done, or the generator is closed, all workers end: those without work may close what they
    hold, the others are stopped.

    What workers print goes to stderr. They may start processes of their own, which end with them.

    Args:
        function: Picklable function of one task; it is sent to each worker once. If it has a
            method `close`, a worker that ends in peace calls it.
        tasks: Picklable tasks.
        workers: Number of processes.
        time_limit: Seconds that one task may take; None for no limit.
        attempts: How often a task is started before its death or time-out is reported.

    Raises:
        InvalidOptionError: `workers` is not positive.
        WorkerError: A worker ended before its first task, as it does when the script that it
            imports starts work outside `if __name__ == "__main__":`.
        WorkerRetiredError: No worker is left for the tasks that are; why the last one retired.
    """
    end_if_starting()
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
                if not isinstance(result, Outcome):
                    worker.stop()
                    running[place] = _Worker(context, function, worker.number)
                    if worker.attempts < attempts:
                        waiting.append((worker.task, worker.attempts + 1))
                        continue
                    result = Outcome(worker.task, None, result, worker.attempts, worker.number)
                elif isinstance(result.error, WorkerRetiredError):
                    waiting.appendleft((worker.task, worker.attempts))
                    worker.retired = result.error
                    continue
                yield result
            _drop_retired(running)
    finally:
        _end(running)


def _drop_retired(running: list[_Worker]) -> None:
    """End workers that have retired, and raise why the last one did if none is left."""
    for worker in list(running):
        if worker.retired is not None:
            worker.stop()
            running.remove(worker)
            if not running:
                raise worker.retired


def _end(running: list[_Worker]) -> None:
    """End workers: those without work may close what they hold, within a time."""
    for worker in running:
        if worker.busy:
            worker.stop()
        else:
            worker.pipe.close()
    deadline = time.monotonic() + _CLOSE_S
    for worker in running:
        worker.process.join(max(0.0, deadline - time.monotonic()))
        worker.stop()


def _patience(running: list[_Worker], time_limit: float | None) -> float:
    """Return the seconds until the first busy worker exceeds its time, or may have died."""
    if time_limit is None:
        return _LOOK_S
    first = min(worker.started for worker in running if worker.busy)
    return min(_LOOK_S, max(0.05, first + time_limit - time.monotonic()))


def worker_number() -> int:
    """Return which of the workers this process is, from 0; its replacement has the same number."""
    return _number


_number = 0


def _serve(function: Callable[[Any], Any], pipe: Connection, number: int) -> None:
    """Work on tasks until there are no more, or the parent is gone."""
    global _number  # noqa: PLW0603, a process is one worker
    _number = number
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    # A group of its own, so that what it starts ends with it; a daemon may not start processes.
    os.setpgid(0, 0)
    multiprocessing.current_process().daemon = False
    # A parent that was killed cannot stop a task that hangs.
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # Stdout is for what the command writes.
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    with suppress(OSError):
        pipe.send("ready")
    _work(function, pipe)
    if (close := getattr(function, "close", None)) is not None:
        close()


def _work(function: Callable[[Any], Any], pipe: Connection) -> None:
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
    """End this process and its own when its parent is gone, whatever they are doing."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.killpg(0, signal.SIGKILL)
