"""Send the results of a run to an experiment tracker while it proceeds: `--set track=wandb`.

A tracker never ends a run: if one of its calls fails, it is left out from then on.
"""

import csv
import logging
import os
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, redirect_stdout
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, Self

from robomme_interference_data.constants import RUN_METRICS
from robomme_interference_data.errors import InvalidOptionError, MissingExtraError, first_line
from robomme_interference_data.schema.rollouts import Status

from .plan import WorkItem
from .row import Rollout

logger = logging.getLogger(__name__)

PROJECT = "robomme-interference"
"""The project of runs on wandb and trackio, unless `WANDB_PROJECT` or `TRACKIO_PROJECT` is set."""

LIBRARIES = ("wandb", "trackio")
"""Trackers that are libraries with wandb's interface."""

TRACKERS = (*LIBRARIES, "csv")


class Tracker(Protocol):
    """Where metrics go."""

    def log(self, metrics: Mapping[str, float], step: int) -> Any:
        """Record metrics after so many rollouts."""

    def finish(self) -> Any:
        """Release all resources."""


class CsvTracker:
    """`csv`: a line per metric in OUT/metrics.csv; a resumed run appends."""

    def __init__(self, folder: Path):
        path = folder / RUN_METRICS
        new = not path.exists()
        self._file = path.open("a", encoding="utf-8", newline="")
        self._lines = csv.writer(self._file, lineterminator="\n")
        if new:
            self._lines.writerow(("rollouts", "metric", "value"))

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        """Append the metrics."""
        self._lines.writerows((step, name, value) for name, value in metrics.items())
        self._file.flush()

    def finish(self) -> None:
        """Close the file."""
        self._file.close()


def check_tracker(name: str) -> None:
    """Check that a tracker exists and its library is installed, without importing it."""
    if name not in TRACKERS:
        raise InvalidOptionError.one_of("track", name, TRACKERS)
    if name in LIBRARIES and find_spec(name) is None:
        raise MissingExtraError(
            f"tracking needs {name}, which is not installed", f"Install it: pip install {name}"
        )


def open_tracker(name: str, folder: Path, settings: Mapping[str, Any]) -> Tracker:
    """Open a tracker for the run in a folder."""
    if name == "csv":
        return CsvTracker(folder)
    project = os.environ.get(f"{name.upper()}_PROJECT", PROJECT)
    run: Tracker = import_module(name).init(
        project=project, name=folder.resolve().name, config=dict(settings)
    )
    return run


class Tracking(AbstractContextManager["Tracking"]):
    """A progress callback of a run that sends metrics to a tracker.

    Args:
        name: Name of the tracker, for messages.
        opened: Opens the tracker.
    """

    def __init__(self, name: str, opened: Callable[[], Tracker]):
        self._name = name
        self._rows, self._errors = 0, 0
        self._sums: Counter[str] = Counter()
        self._counts: Counter[str] = Counter()
        self._tracker = self._attempt(opened)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        if self._tracker is not None:
            self._attempt(self._tracker.finish)

    def note(self, text: str) -> None:
        """Send nothing."""

    def start(self, items: Sequence[WorkItem], done: Sequence[Rollout]) -> None:
        """Count the rows of earlier invocations."""
        for row in done:
            self._count(row)

    def row(self, row: Rollout, node: str | None = None) -> None:
        """Send the metrics after a row: those that it changes."""
        changed = self._count(row)
        metrics = {name: self._sums[name] / self._counts[name] for name in changed}
        metrics |= {"rollouts": self._rows, "errors": self._errors}
        if self._tracker is not None:
            self._attempt(partial(self._tracker.log, metrics, step=self._rows))

    def _count(self, row: Rollout) -> dict[str, float]:
        values = values_of(row)
        self._rows += 1
        self._errors += row.status == Status.ERROR
        self._sums.update(values)
        self._counts.update(values.keys())
        return values

    def _attempt[Result](self, call: Callable[[], Result]) -> Result | None:
        """Return what a call returns; after an error None, and nothing is tracked any more."""
        try:
            with redirect_stdout(sys.stderr):  # trackio prints
                return call()
        except Exception as error:
            self._tracker = None
            what = f"{type(error).__name__}: {first_line(error)}"
            logger.warning("tracking with %s stopped: %s. The run continues.", self._name, what)
            return None


def values_of(row: Rollout) -> dict[str, float]:
    """Return the values of a row whose means are tracked: over all rows, and by condition."""
    values: dict[str, float] = {}
    for name, value in (("success", row.success), ("action_l1", row.action_l1)):
        if value is not None:
            values |= {name: float(value), f"{name}/{row.condition}": float(value)}
    return values
