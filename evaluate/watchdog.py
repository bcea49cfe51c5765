"""End a worker whose simulator hangs, and keep where it hung."""

import faulthandler
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["Watchdog", "last_words"]

_NAME = ".hung.log"


class Watchdog:
    """Guards calls of the simulator in a worker process.

    faulthandler's timer runs outside the interpreter, so it also ends a process that hangs in
    foreign code with the interpreter locked, as renderers and physics do.

    Args:
        seconds: How long guarded work may take.
        folder: The run's folder, where the tracebacks of a process that hung are kept.
    """

    def __init__(self, seconds: float, folder: Path):
        self._seconds = seconds
        self._file = (folder / _NAME).open("a")

    @contextmanager
    def guard(self) -> Iterator[None]:
        """End the process if what is inside takes too long."""
        faulthandler.dump_traceback_later(self._seconds, exit=True, file=self._file)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()


def last_words(folder: Path) -> str | None:
    """Return, once, what processes that hung have left in the run's folder; None if none did."""
    path = folder / _NAME
    text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
    if text:
        with path.open("r+") as file:
            file.truncate(0)
    return text or None
