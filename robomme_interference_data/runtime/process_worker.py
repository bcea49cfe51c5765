"""A worker process, seen from inside, and what one that died leaves on disk."""

import faulthandler
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from . import guard
from .tasks import Outcome, TaskFunction, Worker, attempt, unreadable

_SCRATCH, _FILES, _LIMIT = "scratch", "files", "limit"

_WHOLE_TASK = "the task"
"""What the error about an exceeded limit names, if it was that of a whole task."""


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
            # A group of its own, with which its guard ends all that it starts.
            os.setpgid(0, 0)
        arguments = ["--worker", str(os.getpid()), str(parent), str(home)]
        subprocess.Popen(
            # Without site-packages it starts at once, and imports no module of the user.
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
        # A rename, since this process may be killed while it writes.
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

    def work(self, function: TaskFunction, task: Any, time_limit: float | None) -> bytes:
        """Run a task; return its outcome, without the task and its files, pickled."""
        with self.limit(time_limit, _WHOLE_TASK):
            outcome = replace(attempt(function, task, self), task=None)
            try:
                return pickle.dumps(outcome)
            except Exception as problem:
                return pickle.dumps(unreadable(outcome.error or problem, outcome.trace))


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
