"""A progress bar on stderr, with the rate and the time left."""

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Self

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text


def duration(seconds: float) -> str:
    """Return a time for people, such as `5 min` or `2.5 h`."""
    if seconds >= 2 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{max(1, round(seconds / 60))} min"


class _RateColumn(ProgressColumn):
    def __init__(self, unit: str):
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        rate = task.finished_speed or task.speed
        if not rate:
            return Text()
        shown = f"{rate:,.0f} {self._unit}/s" if rate >= 1 else f"{60 * rate:.2g} {self._unit}/min"
        return Text(shown, style="progress.data.speed")


class _Bars(Progress):
    above: Callable[[], str] | None = None

    def get_renderables(self) -> Iterable[RenderableType]:
        if self.above is not None:
            yield Text(self.above())
        yield from super().get_renderables()


class WorkProgress:
    """A progress bar on stderr; use as a context manager.

    `above` returns text to show above the bar; `console` prints lines while the bar is shown.
    """

    def __init__(
        self, *, unit: str = "frames", quiet: bool = False, above: Callable[[], str] | None = None
    ):
        # Notebooks set FORCE_COLOR for their commands, whose output no bar can overwrite.
        terminal = sys.stderr.isatty()
        self.console = Console(stderr=True, quiet=quiet, force_terminal=terminal)
        self._bars = _Bars(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(unit),
            _RateColumn(unit),
            TimeRemainingColumn(),
            console=self.console,
            speed_estimate_period=3600,  # s; a single task may take half of it
        )
        self._bars.above = above
        self._task: TaskID | None = None
        self._nodes: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bars.stop()

    def start(self, description: str, total: int) -> None:
        """Begin a new bar."""
        self._task, self._nodes = self._bars.add_task(description, total=total), {}
        self._bars.advance(self._task, 0)  # the rate counts from now

    def advance(self, count: int, *, before: bool = False, node: str | None = None) -> None:
        """Count work as done: by an earlier run (`before`), or by a node, which has its own bar."""
        if self._task is None:
            return
        if node is not None:
            if node not in self._nodes:
                total = self._bars.tasks[-1].total
                self._nodes[node] = self._bars.add_task(f"  {node}", total=total)
            self._bars.advance(self._nodes[node], count)
        if before:
            task = next(task for task in self._bars.tasks if task.id == self._task)
            self._bars.reset(self._task, completed=int(task.completed) + count)
            count = 0  # restarts the rate
        self._bars.advance(self._task, count)

    @contextmanager
    def status(self, description: str) -> Iterator[None]:
        """Show a line during work of unknown length."""
        task = self._bars.add_task(description, total=None)
        try:
            yield
        finally:
            self._bars.remove_task(task)
