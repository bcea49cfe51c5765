"""One worker process: what its parent holds of it, and what runs in it. See `execution.py`."""

import faulthandler
import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol

from robomme_interference_data.errors import InterferenceError, WorkerError

CLOSE_S = 10.0
"""Seconds that workers without work have to close what they hold."""

_LOOK_S = 5.0
"""Seconds between two looks for dead workers whose pipes their own children hold open."""

_WORDS_S = 2.0
"""Seconds that a hung worker has to tell where it hangs."""

_STARTED_AGAIN = 97
"""Exit code of a worker that came upon the call that started it."""


class Worker:
    """Which worker runs a task, and how the task talks to the caller while it runs.

    Attributes:
        number: From 0; a worker that takes the place of one that died has its number.
        folder: Where tasks may keep files while they run: it goes with the worker, however that
            ends. None for the system's folder of such files.
    """

    def __init__(
        self,
        number: int,
        tell: Callable[[Any], None] = lambda message: None,
        folder: str | None = None,
    ):
        self.number, self.folder = number, folder
        self._tell = tell

    def hand_in(self, path: str, data: bytes) -> None:
        """Hand a file to the caller, who alone writes: a worker may be on another machine.

        What a task has handed in arrives however it ends; of one path the last counts.
        """
        self._tell(("file", path, data))

    @contextmanager
    def limit(self, seconds: float, what: str) -> Iterator[None]:
        """End this worker if what is inside takes longer; `what` says what it was in the error.

        It is ended from outside, so also while foreign code, such as a renderer, holds the
        interpreter. In the process of the caller (`Serial`) there is no limit.
        """
        self._tell(("limit", what, seconds))
        try:
            yield
        finally:
            self._tell(("limit", what, None))


class Task(Protocol):
    """What is done of each task: a picklable function, which workers get a copy of.

    If it has a method `close`, a worker that ends in peace calls it. If it has a method `describe`,
    what that returns, text by name, has to be the same wherever it runs (see `describe`).
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
        files: What it handed in, see `Worker.hand_in`: path to bytes.
        node: Where in a cluster it was done; None on this machine.
    """

    task: Any
    value: Any = None
    error: BaseException | None = None
    trace: str | None = None
    attempts: int = 1
    files: Mapping[str, bytes] = field(default_factory=dict)
    node: str | None = None


def attempt(
    function: Task, task: Any, worker: Worker
) -> tuple[Any, BaseException | None, str | None]:
    """Return a task's value, or the error, and where it was raised."""
    try:
        return function(task, worker), None, None
    except InterferenceError as error:
        return None, error, traceback.format_exc()
    except Exception as error:
        # Foreign exceptions may not survive pickling; their text does.
        return None, RuntimeError(_text(error)), traceback.format_exc()


def end_if_starting() -> None:
    """End this process, without a word, if it is a worker that is only importing the script.

    So a script that starts work at its top, which each worker would start again, gets one error
    from its own process: see `Executor.run`.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        sys.exit(_STARTED_AGAIN)


# --- the parent's side -------------------------------------------------------------------------


class WorkerProcess:
    """A worker process, the parent's ends of its pipes, and the task that it works on.

    Args:
        function: What it does of its tasks.
        number: Its number.

    Attributes:
        busy: Whether it has a task.
        over: Whether it died or hung, so that it can only be stopped.
    """

    def __init__(self, function: Task, number: int):
        # "spawn": a fork of a process with threads (encoders, simulators) can hang.
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._words, their_words = context.Pipe(duplex=False)
        self._folder = tempfile.mkdtemp(prefix="robomme-interference-")
        arguments = (function, theirs, their_words, number, self._folder)
        self._process = context.Process(target=_serve, args=arguments, daemon=True)
        self._process.start()
        assert self._process.pid is not None
        self._pid = self._process.pid
        theirs.close()
        their_words.close()
        self.number = number
        self.busy = self.over = self._ready = False
        self._task: Any = None
        self._attempts = 0
        self._limits: dict[str, tuple[float, float]] = {}
        self._files: dict[str, bytes] = {}

    def give(self, task: Any, attempts: int, time_limit: float | None) -> None:
        """Let it work on a task; `attempts` counts this one."""
        self._task, self._attempts, self.busy = task, attempts, True
        self._limits, self._files = {}, {}
        if time_limit is not None:
            self._limit("the task", time_limit)
        with suppress(OSError):  # it died while idle: `settle` finds out
            self._pipe.send(task)

    def settle(self) -> Outcome | None:
        """Return what became of the task, or None while there is nothing to say.

        Raises:
            WorkerError: The worker ended before it was ready for a task.
        """
        while self.busy:
            if not self._pipe.poll() and self._process.is_alive():
                return self._late() if self._left() < 0 else None
            message = self._receive()
            if message is None:
                self.over = True
                return self._outcome(None, self._death(), None)
            kind, *rest = message
            if kind == "ready":
                self._ready = True
                for what, (seconds, _) in self._limits.items():
                    self._limit(what, seconds)
            elif kind == "limit":
                self._limit(*rest)
            elif kind == "file":
                self._files.update([rest])
            else:
                self.busy = False
                return self._outcome(*rest)
        return None

    def stop(self) -> None:
        """End it now, and what it has started."""
        self._process.kill()
        with suppress(ProcessLookupError, PermissionError):  # no process of the group is left
            os.killpg(self._pid, signal.SIGKILL)
        self._process.join()
        self._pipe.close()
        self._words.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _outcome(self, value: Any, error: BaseException | None, trace: str | None) -> Outcome:
        return Outcome(self._task, value, error, trace, self._attempts, self._files)

    def _limit(self, what: str, seconds: float | None) -> None:
        if seconds is None:
            self._limits.pop(what, None)
        else:
            self._limits[what] = seconds, time.monotonic() + seconds

    def _left(self) -> float:
        """Return the seconds until the first limit is exceeded."""
        ends = [end for _, end in self._limits.values()]
        return min(ends, default=float("inf")) - time.monotonic()

    def _receive(self) -> Any:
        """Return the next message of the worker; None if it is dead."""
        try:
            # What a dead worker started may hold its pipe open.
            data = self._pipe.recv_bytes() if self._pipe.poll() else None
        except (EOFError, OSError):
            data = None
        try:
            return data and pickle.loads(data)
        except Exception as error:
            return "done", None, RuntimeError(f"the task's outcome: {_text(error)}"), None

    def _late(self) -> Outcome:
        """Ask a hung worker where it hangs, and give it up."""
        what, (seconds, _) = min(self._limits.items(), key=lambda item: item[1][1])
        self.over = True
        trace = b""
        with suppress(ProcessLookupError, OSError):
            os.kill(self._pid, signal.SIGUSR1)
            while wait([self._words], timeout=_WORDS_S if not trace else 0.2):
                found = os.read(self._words.fileno(), 1 << 16)
                if not found:
                    break
                trace += found
        error = TimeoutError(f"{what} took more than {seconds:g} s")
        return self._outcome(None, error, trace.decode(errors="replace") or None)

    def _death(self) -> Exception:
        self._process.join()
        code = self._process.exitcode or 0
        if self._ready or code < 0:  # a signal can come at any time
            return RuntimeError(f"the worker process died (exit code {code})")
        what = f"ended before its first task (exit code {code}); what it said is above"
        if code == _STARTED_AGAIN:
            what = "came upon the call that started it"
        raise WorkerError(
            f"a worker process {what}",
            "Worker processes import the script that starts them: it has to be a file, with the "
            'call under  if __name__ == "__main__":',
        )


def wait_for(workers: Sequence[WorkerProcess]) -> None:
    """Wait until a busy worker has something to say, or is late."""
    busy = [worker for worker in workers if worker.busy]
    patience = min([_LOOK_S, *(worker._left() for worker in busy)])
    wait([worker._pipe for worker in busy], timeout=max(0.05, patience))


def end_workers(workers: Sequence[WorkerProcess]) -> None:
    """End workers: those without work may close what they hold, within a time."""
    for worker in workers:
        if worker.busy:
            worker.stop()
        else:
            worker._pipe.close()
    deadline = time.monotonic() + CLOSE_S
    for worker in workers:
        worker._process.join(max(0.0, deadline - time.monotonic()))
        worker.stop()


# --- the worker's side -------------------------------------------------------------------------


def _serve(function: Task, pipe: Connection, words: Connection, number: int, folder: str) -> None:
    """Work on tasks until there are no more, or the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    # Written by a signal handler in C: also of a process whose interpreter is locked.
    faulthandler.register(signal.SIGUSR1, file=words.fileno())
    # A group of its own, so that what it starts ends with it; a daemon may not start processes.
    os.setpgid(0, 0)
    multiprocessing.current_process().daemon = False
    # A parent that was killed cannot stop a task that hangs.
    threading.Thread(target=_end_with_parent, args=(folder,), daemon=True).start()
    # Stdout is for what the command writes.
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    worker = Worker(number, pipe.send, folder)
    with suppress(OSError, EOFError):
        pipe.send(("ready",))
        while True:
            _send(pipe, *attempt(function, pipe.recv(), worker))
    getattr(function, "close", lambda: None)()


def _send(pipe: Connection, value: Any, error: BaseException | None, trace: str | None) -> None:
    """Send an outcome; one that cannot be sent is an error."""
    try:
        pipe.send(("done", value, error, trace))
    except OSError:
        raise
    except Exception as problem:
        told = RuntimeError(f"the task's outcome: {_text(problem)}" if not error else _text(error))
        pipe.send(("done", None, told, trace))


def _end_with_parent(folder: str) -> None:
    """End this process and its own when its parent is gone, whatever they are doing."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        shutil.rmtree(folder, ignore_errors=True)
        os.killpg(0, signal.SIGKILL)


def _text(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"
