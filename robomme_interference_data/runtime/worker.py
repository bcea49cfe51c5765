"""What a task can use of the worker that runs it, and what is left of a worker that died."""

import faulthandler
import os
import pickle
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import quote, unquote

from robomme_interference_data.errors import InterferenceError

_SCRATCH, _FILES, _LIMIT = "scratch", "files", "limit"


class Worker:
    """The worker that runs a task. This class serves in the caller's own process.

    Attributes:
        number: From 0; a worker that replaces one that died has its number.
        folder: Where tasks may keep files while they run, removed when the worker ends. None for
            the system's temporary folder.
    """

    def __init__(self, number: int = 0, folder: str | None = None):
        self.number, self.folder = number, folder
        self._sent: dict[str, bytes] = {}

    def send_file(self, path: str, data: bytes) -> None:
        """Send a file to the caller, who alone writes: a worker may be on another machine.

        Files arrive however the task ends. Of files with the same path the last one counts.
        """
        self._sent[path] = data

    def take_files(self) -> dict[str, bytes]:
        """Return the files that were sent since the last call."""
        files, self._sent = self._sent, {}
        return files

    @contextmanager
    def limit(self, seconds: float | None, what: str) -> Iterator[None]:
        """End the worker if the block takes longer; `what` names it in the error.

        In the caller's own process there is no limit.
        """
        yield


class ProcessWorker(Worker):
    """A worker in a process of its own, which ends together with all that it starts.

    `home` is its folder, empty; `parent` a file descriptor that closes when the parent ends, or -1.
    """

    def __init__(self, number: int, home: Path, parent: int = -1):
        super().__init__(number, str(home / _SCRATCH))
        self._home, self._limits = home, list[tuple[float, float, str]]()
        for name in (_SCRATCH, _FILES):
            (home / name).mkdir()
        self._late = (home / _LIMIT).open("wb", buffering=0)
        if os.getpgrp() != os.getpid():
            os.setpgid(0, 0)
        guard = [sys.executable, "-I", "-S", str(Path(__file__).with_name("guard.py"))]
        subprocess.Popen(
            [*guard, str(os.getpid()), str(parent), str(home)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=[parent] if parent >= 0 else [],
        )

    def send_file(self, path: str, data: bytes) -> None:
        """Keep a file where it outlives this process; see `Worker.send_file`."""
        partial = self._home / "partial"
        partial.write_bytes(data)
        partial.replace(self._home / _FILES / quote(path, safe=""))

    def take_files(self) -> dict[str, bytes]:
        """Return the files that were sent since the last call."""
        return _take_files(self._home)

    @contextmanager
    def limit(self, seconds: float | None, what: str) -> Iterator[None]:
        """End this process if the block takes longer, also while C code holds Python's lock."""
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
        """Run a task; return its value, error and traceback, pickled."""
        with self.limit(time_limit, "the task"):
            value, error, trace = attempt(function, task, self)
            try:
                return pickle.dumps((value, error, trace))
            except Exception as problem:
                cause = error_text(problem if error is None else error)
                return pickle.dumps((None, RuntimeError(f"the task's outcome: {cause}"), trace))


class Task(Protocol):
    """What is done with each task: a picklable function, of which each worker gets a copy.

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
        error: Why there is no value, or None. An error of this package that the function raised
            is unchanged; another one, or the worker's death, is a `RuntimeError`; an exceeded
            limit is a `TimeoutError`.
        trace: Where it was raised, or where the worker hung; None if not known.
        attempts: How often the task was started.
        files: What it sent, see `Worker.send_file`: path to bytes.
        node: The node of a cluster that ran it; None on this machine.
    """

    task: Any
    value: Any = None
    error: BaseException | None = None
    trace: str | None = None
    attempts: int = 1
    files: dict[str, bytes] = field(default_factory=dict)
    node: str | None = None


def attempt(
    function: Task, task: Any, worker: Worker
) -> tuple[Any, BaseException | None, str | None]:
    """Return a task's value, or its error and traceback."""
    try:
        return function(task, worker), None, None
    except InterferenceError as error:
        return None, error, traceback.format_exc()
    except Exception as error:
        # Foreign exceptions may not survive pickling; their text does.
        return None, RuntimeError(error_text(error)), traceback.format_exc()


def unpickled(data: bytes) -> tuple[Any, BaseException | None, str | None]:
    """Return what `ProcessWorker.work` pickled; what cannot be read is an error."""
    try:
        value, error, trace = pickle.loads(data)
    except Exception as problem:
        return None, RuntimeError(f"the task's outcome: {error_text(problem)}"), None
    return value, error, trace


def has_begun(home: Path) -> bool:
    """Whether a worker was ready for its first task."""
    return (home / _LIMIT).exists()


def left_behind(home: Path) -> tuple[TimeoutError | None, str | None, dict[str, bytes]]:
    """Return what a worker left in its folder: the limit it exceeded, where, and its files."""
    if not has_begun(home):
        return None, None, {}
    message, _, trace = (home / _LIMIT).read_bytes().decode(errors="replace").partition("\n")
    error = TimeoutError(message) if trace else None
    return error, trace or None, _take_files(home)


def _take_files(home: Path) -> dict[str, bytes]:
    files = {}
    for path in sorted((home / _FILES).iterdir()):
        files[unquote(path.name)] = path.read_bytes()
        path.unlink()
    return files


def error_text(error: BaseException) -> str:
    """Return type and text of an error."""
    return f"{type(error).__name__}: {error}"
