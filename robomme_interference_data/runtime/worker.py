"""What a task can use of its worker, its outcome, and what a worker that died leaves on disk."""

import faulthandler
import os
import pickle
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Protocol
from urllib.parse import quote, unquote

from robomme_interference_data.errors import InterferenceError

from . import guard

_SCRATCH, _FILES, _LIMIT = "scratch", "files", "limit"


class Worker:
    """The worker that runs a task. This class is the worker in the caller's own process.

    Attributes:
        number: From 0; a worker that replaces one that died has its number.
        folder: Where tasks may keep files while they run; removed when the worker ends. None for
            the system's temporary folder.
    """

    def __init__(self, number: int = 0, folder: str | None = None):
        self.number, self.folder = number, folder
        self._sent: dict[str, bytes] = {}

    def send_file(self, path: str, data: bytes) -> None:
        """Send a file to the caller; a worker may run on another machine, so only callers write.

        Files arrive even if the task fails. A file replaces an earlier one with the same path.
        """
        self._sent[path] = data

    def take_files(self) -> dict[str, bytes]:
        """Return the files that were sent since the last call."""
        files, self._sent = self._sent, {}
        return files

    @contextmanager
    def limit(self, seconds: float | None, what: str) -> Iterator[None]:
        """End the worker if the block takes longer; `what` names the block in the error.

        There is no limit in the caller's own process.
        """
        yield


class ProcessWorker(Worker):
    """A worker process, which ends together with all processes that it starts.

    `home` is its empty folder; `parent` a file descriptor that closes when the parent ends, or -1.
    """

    def __init__(self, number: int, home: Path, parent: int = -1):
        super().__init__(number, str(home / _SCRATCH))
        self._home, self._limits = home, list[tuple[float, float, str]]()
        for name in (_SCRATCH, _FILES):
            (home / name).mkdir()
        self._late = (home / _LIMIT).open("wb", buffering=0)
        if os.getpgrp() != os.getpid():
            os.setpgid(0, 0)
        arguments = ["--worker", str(os.getpid()), str(parent), str(home)]
        subprocess.Popen(
            [sys.executable, "-I", "-S", guard.__file__, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=[parent] if parent >= 0 else [],
        )

    def send_file(self, path: str, data: bytes) -> None:
        """Keep a file where it outlives this process."""
        partial = self._home / "partial"
        partial.write_bytes(data)
        partial.replace(self._home / _FILES / quote(path, safe=""))

    def take_files(self) -> dict[str, bytes]:
        """Return the files that were sent since the last call."""
        return take_files(self._home)

    @contextmanager
    def limit(self, seconds: float | None, what: str) -> Iterator[None]:
        """End this process if the block takes longer, even while C code holds the GIL."""
        if seconds is None:
            yield
            return
        limit = (time.monotonic() + seconds, seconds, what)
        self._limits.append(limit)
        self._set_alarm()
        try:
            yield
        finally:
            self._limits.remove(limit)
            self._set_alarm()

    def _set_alarm(self) -> None:
        faulthandler.cancel_dump_traceback_later()
        if self._limits:
            end, seconds, what = min(self._limits)
            os.ftruncate(self._late.fileno(), 0)
            self._late.seek(0)
            self._late.write(f"{what} took more than {seconds:g} s\n".encode())
            left = max(end - time.monotonic(), 0.001)
            faulthandler.dump_traceback_later(left, exit=True, file=self._late)

    def work(self, function: "Task", task: Any, time_limit: float | None) -> bytes:
        """Run a task; return its outcome, without the task and its files, pickled."""
        with self.limit(time_limit, _WHOLE_TASK):
            outcome = replace(attempt(function, task, self), task=None)
            try:
                return pickle.dumps(outcome)
            except Exception as problem:
                return pickle.dumps(_unreadable(outcome.error or problem, outcome.trace))


_WHOLE_TASK = "the task"
"""What the error about an exceeded limit names, if it was that of a whole task."""


class Task(Protocol):
    """What to do with each task: a picklable function, of which each worker gets a copy.

    If it has a method `close`, a worker that is no longer needed calls it. If it has a method
    `describe`, the names and texts that it returns must be the same on all machines.
    """

    def __call__(self, task: Any, worker: Worker) -> Any:
        """Work on a task and return its value, which must be picklable."""
        ...


@dataclass(frozen=True)
class Outcome:
    """The outcome of a task.

    Attributes:
        task: The task.
        value: What the function returned, or None.
        error: Why there is no value, or None. Errors of this package are unchanged; any other
            error, or the worker's death, is a `RuntimeError`; an exceeded limit is a
            `TimeoutError`.
        progress: What the function attached to the error, `error.progress`: plain values by name.
        trace: Traceback of the error, or of the worker that exceeded a limit; None if unknown.
        attempts: How often the task was started.
        files: Files that the task sent (see `Worker.send_file`), by path.
        node: The node of a cluster that ran it; None on this machine.
        worker: `alive` after the task; `dead` because of it; `late` if the task exceeded its own
            limit, which ends the worker too; or `lost` with its node.
    """

    task: Any = None
    value: Any = None
    error: BaseException | None = None
    progress: Mapping[str, Any] = field(default_factory=dict)
    trace: str | None = None
    attempts: int = 1
    files: dict[str, bytes] = field(default_factory=dict)
    node: str | None = None
    worker: Literal["alive", "dead", "late", "lost"] = "alive"


def attempt(function: Task, task: Any, worker: Worker) -> Outcome:
    """Call the function on a task once."""
    try:
        return Outcome(task, function(task, worker))
    except Exception as error:
        # Foreign exceptions may not survive pickling; their text does.
        known = isinstance(error, InterferenceError)
        described = error if known else RuntimeError(f"{type(error).__name__}: {error}")
        progress = getattr(error, "progress", {})
        return Outcome(task, error=described, progress=progress, trace=traceback.format_exc())


def unpickle_outcome(data: bytes, files: dict[str, bytes], node: str | None = None) -> Outcome:
    """Return the outcome that `ProcessWorker.work` pickled; an unreadable one is an error."""
    try:
        outcome = pickle.loads(data)
    except Exception as problem:
        outcome = _unreadable(problem)
    return replace(outcome, files=files, node=node)


def _unreadable(error: BaseException, trace: str | None = None) -> Outcome:
    text = f"the task's outcome cannot be sent: {type(error).__name__}: {error}"
    return Outcome(error=RuntimeError(text), trace=trace)


def has_begun(home: Path) -> bool:
    """Whether a worker was ready for its first task."""
    return (home / _LIMIT).exists()


def read_remains(home: Path) -> Outcome:
    """Return the outcome of the task that killed a worker, from what is left in its folder."""
    if not has_begun(home):
        return Outcome(worker="dead")
    message, _, trace = (home / _LIMIT).read_bytes().decode(errors="replace").partition("\n")
    files = take_files(home)
    if not trace:
        return Outcome(files=files, worker="dead")
    late = message.startswith(_WHOLE_TASK)
    return Outcome(
        error=TimeoutError(message), trace=trace, files=files, worker="late" if late else "dead"
    )


def take_files(home: Path) -> dict[str, bytes]:
    """Return and delete the files that a worker with this folder sent."""
    files = {}
    for path in sorted((home / _FILES).iterdir()):
        files[unquote(path.name)] = path.read_bytes()
        path.unlink()
    return files
