"""End a worker whose simulator hangs, and keep where it hung."""

import faulthandler
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["Watchdog", "last_words"]


class Watchdog:
    """Guards calls of the simulator in a worker process.

    faulthandler's timer runs outside the interpreter, so it also ends a process that hangs in
    foreign code with the interpreter locked, as renderers and physics do.

    Args:
        seconds: How long guarded work may take.
        folder: The run's folder, where the traceback of a process that hung is kept.
        worker: Number of the worker.
    """

    def __init__(self, seconds: float, folder: Path, worker: int):
        self._seconds = seconds
        self._file = _path(folder, worker).open("a")

    def clear(self) -> None:
        """Forget what was left before: to be called as each rollout begins."""
        self._file.truncate(0)

    @contextmanager
    def guard(self) -> Iterator[None]:
        """End the process if what is inside takes too long."""
        faulthandler.dump_traceback_later(self._seconds, exit=True, file=self._file)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()

    def close(self) -> None:
        """Remove the file; the watchdog guards nothing any more."""
        self._file.close()
        Path(self._file.name).unlink(missing_ok=True)


def last_words(folder: Path, worker: int) -> str | None:
    """Return where a worker hung that the watchdog has just ended; None if it ended otherwise."""
    path = _path(folder, worker)
    text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
    return text or None


def _path(folder: Path, worker: int) -> Path:
    return folder / f".hung-{worker}.log"
