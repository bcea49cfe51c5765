"""Calls of worker processes, and whether these are gone.

Tasks are `functools.partial` objects of library functions, called by `operator.call` in the
worker: so everything can be pickled by name in any process.
"""

import operator
import os
import sys
import time
from pathlib import Path
from typing import Any

from robomme_interference_data.workers import Outcome, run_tasks

FOREVER = 100_000.0


def run(tasks: list[Any], workers: int = 1, **options: Any) -> list[Outcome]:
    return list(run_tasks(operator.call, tasks, workers=workers, **options))


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that ended and that nobody waited for does not."""
    stat = Path(f"/proc/{pid}/stat")
    if Path("/proc/self/stat").exists():
        try:
            return stat.read_text().rpartition(")")[2].split()[0] != "Z"
        except (FileNotFoundError, ProcessLookupError):
            return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def wait_until_gone(pids: list[int], seconds: float = 30) -> None:
    deadline = time.monotonic() + seconds
    while any(map(is_alive, pids)):
        assert time.monotonic() < deadline, f"still running: {list(filter(is_alive, pids))}"
        time.sleep(0.05)


def script(folder: Path, text: str) -> list[str]:
    path = folder / "script.py"
    path.write_text(text)
    return [sys.executable, str(path)]
