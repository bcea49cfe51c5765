"""Who runs tasks: this process (`Serial`) or worker processes (`Processes`).

Whatever has tasks is handed an executor, and gets outcomes as values. `concurrent.futures` gives
up on all work when one process dies and cannot stop a hung task; pebble stops one, but neither
tries it again, nor ends what the task had started, nor tells where it hung.
"""

import faulthandler
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from typing import Any, Protocol

from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    WorkerError,
    WorkerRetiredError,
)

__all__ = ["Executor", "Outcome", "Processes", "Serial", "Task", "Worker", "end_if_starting"]

_CLOSE_S = 10.0
"""Seconds that workers without work have to close what they hold."""

_LOOK_S = 5.0
"""Seconds between two looks for dead workers whose pipes their own children hold open."""

_WORDS_S = 2.0
"""Seconds that a hung worker has to tell where it hangs."""

_STARTED_AGAIN = 97
"""Exit code of a worker that came upon the call that started it."""


class Worker:
    """Which worker runs a task, and how the task says how long a part of it may take.

    Attributes:
        number: From 0; a worker that takes the place of one that died has its number.
    """

    def __init__(self, number: int, tell: Callable[[Any], None] = lambda message: None):
        self.number = number
        self._tell = tell

    @contextmanager
    def limit(self, seconds: float, what: str) -> Iterator[None]:
        """End this worker if what is inside takes longer; `what` says what it was in the error.

        It is ended from outside, so also while foreign code, such as a renderer, holds the
        interpreter. In the process of the caller (`Serial`) there is no limit.
        """
        self._tell(("limit", seconds, what))
        try:
            yield
        finally:
            self._tell(("limit", None, what))


class Task(Protocol):
    """What is done of each task: a picklable function, which workers get a copy of.

    If it has a method `close`, a worker that ends in peace calls it.
    """

    def __call__(self, task: Any, worker: Worker) -> Any:
        """Work on a task and return its value, which must be picklable."""
        ...


@dataclass(frozen=True)
class Outcome:
    """What became of a task.

    Attributes:
        task: The task.
        value: What the function returned, or None.
        error: Why there is no value, or None. An error of this package that the function raised
            is itself; another one, or the worker's death, is a `RuntimeError`; an exceeded limit
            is a `TimeoutError`.
        trace: Where it was raised, or where the worker hung; None if not known.
        attempts: How often the task was started.
    """

    task: Any
    value: Any = None
    error: BaseException | None = None
    trace: str | None = None
    attempts: int = 1


class Executor(Protocol):
    """Runs tasks."""

    def run(
        self,
        function: Task,
        tasks: Iterable[Any],
        *,
        time_limit: float | None = None,
        attempts: int = 2,
        again: tuple[type[Exception], ...] = (),
    ) -> Generator[Outcome]:
        """Call a function on every task; yield outcomes as they come.

        A worker that dies or exceeds a limit is replaced, and its task is started again, up to
        `attempts` times; so is a task that raises one of `again`. Any other exception is final. A
        worker whose function raises `WorkerRetiredError` gives its task back to the others and
        ends. When the tasks are done, or the generator is closed, all workers end: those without
        work may close what they hold, the others are stopped.

        Args:
            function: What to do of a task.
            tasks: Picklable tasks.
            time_limit: Seconds that one task may take; None for no limit.
            attempts: How often a task is started before what went wrong is reported.
            again: Errors after which a task is started again.

        Raises:
            WorkerError: A worker ended before its first task, as it does when the script that it
                imports starts work outside `if __name__ == "__main__":`.
            WorkerRetiredError: No worker is left for the tasks that are; why the last one retired.
        """
        ...


@dataclass(frozen=True)
class Serial:
    """Runs tasks in this process, one after the other; there are no time limits."""

    def run(
        self,
        function: Task,
        tasks: Iterable[Any],
        *,
        time_limit: float | None = None,
        attempts: int = 2,
        again: tuple[type[Exception], ...] = (),
    ) -> Generator[Outcome]:
        """Call a function on every task; see `Executor.run`."""
        worker = Worker(0)
        try:
            for task in tasks:
                attempt = 1
                result = _attempt(function, task, worker)
                while isinstance(result[1], again) and attempt < attempts:
                    attempt += 1
                    result = _attempt(function, task, worker)
                if isinstance(result[1], WorkerRetiredError):
                    raise result[1]
                yield Outcome(task, *result, attempt)
        finally:
            _close(function)


@dataclass(frozen=True)
class Processes:
    """Runs tasks in worker processes that may hang or die without taking the work with them.

    What workers print goes to stderr. They may start processes of their own, which end with them.

    Attributes:
        workers: How many.

    Raises:
        InvalidOptionError: `workers` is not positive.
    """

    workers: int

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise InvalidOptionError.expected("workers", self.workers, "1 or more")

    def run(
        self,
        function: Task,
        tasks: Iterable[Any],
        *,
        time_limit: float | None = None,
        attempts: int = 2,
        again: tuple[type[Exception], ...] = (),
    ) -> Generator[Outcome]:
        """Call a function on every task in worker processes; see `Executor.run`."""
        end_if_starting()
        waiting = deque((task, 1) for task in tasks)
        # "spawn": a fork of a process with threads (encoders, simulators) can hang.
        context = multiprocessing.get_context("spawn")
        count = min(self.workers, len(waiting))
        running = [_Process(context, function, number) for number in range(count)]
        try:
            while waiting or any(process.busy for process in running):
                for process in running:
                    if waiting and not process.busy:
                        process.give(*waiting.popleft(), time_limit)
                busy = [process for process in running if process.busy]
                patience = min(_LOOK_S, *(process.left() for process in busy))
                wait([process.pipe for process in busy], timeout=max(0.05, patience))
                for place, process in enumerate(running):
                    outcome = process.settle()
                    if outcome is None:
                        continue
                    if isinstance(outcome.error, WorkerRetiredError):
                        waiting.appendleft((outcome.task, outcome.attempts))
                        process.retired = outcome.error
                        continue
                    if process.over:
                        process.stop()
                        running[place] = _Process(context, function, process.number)
                    if outcome.attempts < attempts and (
                        process.over or isinstance(outcome.error, again)
                    ):
                        waiting.append((outcome.task, outcome.attempts + 1))
                        continue
                    yield outcome
                _drop_retired(running)
        finally:
            _end(running)


def end_if_starting() -> None:
    """End this process, without a word, if it is a worker that is only importing the script.

    So a script that starts work at its top, which each worker would start again, gets one error
    from its own process: see `Executor.run`.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        sys.exit(_STARTED_AGAIN)


# --- the parent's side -------------------------------------------------------------------------


class _Process:
    """A worker process, the parent's ends of its pipes, and the task that it works on."""

    def __init__(self, context: Any, function: Task, number: int):
        self.pipe, theirs = context.Pipe()
        self._words, their_words = context.Pipe(duplex=False)
        arguments = (function, theirs, their_words, number)
        self.process = context.Process(target=_serve, args=arguments, daemon=True)
        self.process.start()
        theirs.close()
        their_words.close()
        self.number = number
        self.busy = self.ready = self.over = False
        self.retired: WorkerRetiredError | None = None
        self._task: Any = None
        self._attempts = 0
        self._limits: dict[str, tuple[float, float]] = {}

    def give(self, task: Any, attempts: int, time_limit: float | None) -> None:
        self._task, self._attempts, self.busy = task, attempts, True
        self._limits = {}
        if time_limit is not None:
            self._limits["the task"] = time_limit, time.monotonic() + time_limit
        with suppress(OSError):  # it died while idle: `settle` finds out
            self.pipe.send(task)

    def left(self) -> float:
        """Return the seconds until the first limit is exceeded."""
        ends = [end for _, end in self._limits.values()]
        return min(ends, default=float("inf")) - time.monotonic()

    def settle(self) -> Outcome | None:
        """Return what became of the task, or None while there is nothing to say."""
        while self.busy:
            if not self.pipe.poll() and self.process.is_alive():
                return self._late() if self.left() < 0 else None
            try:
                # What a dead worker started may hold its pipe open.
                message = self.pipe.recv() if self.pipe.poll() else None
            except (EOFError, OSError):
                message = None
            if message is None:
                self.over = True
                return self._outcome(self._death())
            kind, *rest = message
            if kind == "ready":
                self.ready = True
            elif kind == "limit":
                seconds, what = rest
                if seconds is None:
                    self._limits.pop(what, None)
                else:
                    self._limits[what] = seconds, time.monotonic() + seconds
            else:
                self.busy = False
                return Outcome(self._task, *rest, self._attempts)
        return None

    def stop(self) -> None:
        """End it now, and what it has started."""
        self.process.kill()
        with suppress(ProcessLookupError, PermissionError):  # no process of the group is left
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.join()
        self.pipe.close()
        self._words.close()

    def _outcome(self, error: Exception, trace: str | None = None) -> Outcome:
        return Outcome(self._task, None, error, trace, self._attempts)

    def _late(self) -> Outcome:
        """Ask a hung worker where it hangs, and give it up."""
        what, (seconds, _) = min(self._limits.items(), key=lambda item: item[1][1])
        self.over = True
        trace = b""
        with suppress(ProcessLookupError, OSError):
            os.kill(self.process.pid, signal.SIGUSR1)
            while wait([self._words], timeout=_WORDS_S if not trace else 0.2):
                found = os.read(self._words.fileno(), 1 << 16)
                if not found:
                    break
                trace += found
        error = TimeoutError(f"{what} took more than {seconds:g} s")
        return self._outcome(error, trace.decode(errors="replace") or None)

    def _death(self) -> Exception:
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


def _drop_retired(running: list[_Process]) -> None:
    """End workers that have retired, and raise why the last one did if none is left."""
    for process in list(running):
        if process.retired is not None:
            process.stop()
            running.remove(process)
            if not running:
                raise process.retired


def _end(running: list[_Process]) -> None:
    """End workers: those without work may close what they hold, within a time."""
    for process in running:
        if process.busy:
            process.stop()
        else:
            process.pipe.close()
    deadline = time.monotonic() + _CLOSE_S
    for process in running:
        process.process.join(max(0.0, deadline - time.monotonic()))
        process.stop()


# --- the worker's side -------------------------------------------------------------------------


def _serve(function: Task, pipe: Connection, words: Connection, number: int) -> None:
    """Work on tasks until there are no more, or the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    # Written by a signal handler in C: also of a process whose interpreter is locked.
    faulthandler.register(signal.SIGUSR1, file=words.fileno())
    # A group of its own, so that what it starts ends with it; a daemon may not start processes.
    os.setpgid(0, 0)
    multiprocessing.current_process().daemon = False
    # A parent that was killed cannot stop a task that hangs.
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # Stdout is for what the command writes.
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    worker = Worker(number, pipe.send)
    with suppress(OSError, EOFError):
        pipe.send(("ready",))
        while True:
            task = pipe.recv()
            pipe.send_bytes(ForkingPickler.dumps(("done", *_attempt(function, task, worker))))
    _close(function)


def _attempt(
    function: Task, task: Any, worker: Worker
) -> tuple[Any, BaseException | None, str | None]:
    """Return a task's value, or the error, and where it was raised."""
    try:
        return function(task, worker), None, None
    except InterferenceError as error:
        return None, error, traceback.format_exc()
    except Exception as error:
        # Foreign exceptions may not survive pickling; their text does.
        return None, RuntimeError(f"{type(error).__name__}: {error}"), traceback.format_exc()


def _close(function: Task) -> None:
    if (close := getattr(function, "close", None)) is not None:
        close()


def _end_with_parent() -> None:
    """End this process and its own when its parent is gone, whatever they are doing."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.killpg(0, signal.SIGKILL)
