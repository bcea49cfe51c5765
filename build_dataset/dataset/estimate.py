"""How long a build takes and how much it stores, judged by its first episodes."""

import logging
import shutil
import time
from pathlib import Path

from robomme_interference_data.errors import counted
from robomme_interference_data.progress import duration
from robomme_interference_data.storage.files import all_files

logger = logging.getLogger(__name__)

_LONG_S, _LARGE_MB = 60.0, 500.0
"""Builds that take longer, or store more, are estimated."""


class BuildEstimate:
    """Logs the estimate of a build, once each of its workers has ended an episode or so.

    Args:
        work: A folder on the disk of the dataset.
        episodes: Number of episodes to read.
        workers: Number of workers, which all have work.
    """

    def __init__(self, work: Path, episodes: int, workers: int):
        self._work, self._left, self._workers = work, episodes, workers
        self._began = time.monotonic()
        self._ended, self._bytes = 0, 0

    def take(self, folder: Path) -> None:
        """Count an episode that was read now, and its files."""
        self._left -= 1
        if self._ended >= self._workers:
            return
        self._ended += 1
        self._bytes += sum((folder / path).stat().st_size for path in all_files(folder))
        if self._ended == self._workers:
            seconds = (time.monotonic() - self._began) / self._ended * self._left
            megabytes = self._bytes / self._ended * self._left / 1e6
            # Episodes are staged, then copied into the dataset.
            free = shutil.disk_usage(self._work).free / 1e6
            text = estimate_text(self._left, seconds, megabytes, free)
            if text is not None:
                log = logger.warning if 2 * megabytes > free else logger.info
                log(text)


def estimate_text(left: int, seconds: float, megabytes: float, free: float) -> str | None:
    """Return the estimate for the remaining episodes; None if they are few or small.

    Args:
        left: Number of remaining episodes.
        seconds: Time that they take.
        megabytes: What they store.
        free: Free megabytes on their disk.
    """
    if seconds < _LONG_S and megabytes < _LARGE_MB:
        return None
    text = (
        f"about {duration(seconds)} and {megabytes:,.0f} MB for the other "
        f"{counted(left, 'episode')}, judged by the first; twice the space until the "
        f"dataset is written, {free:,.0f} MB free"
    )
    return f"{text}: too little" if 2 * megabytes > free else text
