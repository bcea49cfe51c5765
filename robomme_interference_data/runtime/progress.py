"""A progress bar for long work, on stderr."""

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


class _Speed(ProgressColumn):
    def __init__(self, unit: str):
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        rate = f"{speed:,.0f} {self._unit}/s" if speed and speed >= 1 else ""
        if speed and speed < 1:
            rate = f"{60 * speed:.2g} {self._unit}/min"
        return Text(rate, style="progress.data.speed")


class _Bars(Progress):
    above: Callable[[], str] | None = None

    def get_renderables(self) -> Iterable[RenderableType]:
        if self.above is not None:
            yield Text(self.above())
        yield from super().get_renderables()


class WorkProgress:
    """A progress bar on stderr; use as a context manager.

    Args:
        unit: What is counted.
        quiet: Show nothing.
        above: Returns text to show above the bars, whenever they are drawn.

    Attributes:
        console: Where to print lines while the bars are shown.
    """

    def __init__(
        self,
        *,
        unit: str = "frames",
        quiet: bool = False,
        above: Callable[[], str] | None = None,
    ):
        self.console = Console(stderr=True, quiet=quiet)
        self._progress = _Bars(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(unit),
            _Speed(unit),
            TimeRemainingColumn(),
            console=self.console,
            speed_estimate_period=3600,  # s; one piece of work may take half of it
        )
        self._progress.above = above
        self._task: TaskID | None = None
        self._nodes: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._progress.stop()

    def start(self, description: str, frames: int) -> None:
        """Begin a new bar of so many frames."""
        self._task, self._nodes = self._progress.add_task(description, total=frames), {}
        self._progress.advance(self._task, 0)  # the speed is since then

    def advance(self, frames: int, *, before: bool = False, node: str | None = None) -> None:
        """Count frames as done.

        Args:
            frames: How many.
            before: They were done by an earlier run, and do not count for the speed.
            node: The node of a cluster that did them; each has a bar of its own.
        """
        if self._task is None:
            return
        if node is not None:
            if node not in self._nodes:
                total = self._progress.tasks[-1].total
                self._nodes[node] = self._progress.add_task(f"  {node}", total=total)
            self._progress.advance(self._nodes[node], frames)
        if before:
            task = next(task for task in self._progress.tasks if task.id == self._task)
            self._progress.reset(self._task, completed=int(task.completed) + frames)
            self._progress.advance(self._task, 0)
        else:
            self._progress.advance(self._task, frames)

    @contextmanager
    def status(self, description: str) -> Iterator[None]:
        """Show a line while work of unknown length goes on."""
        task = self._progress.add_task(description, total=None)
        try:
            yield
        finally:
            self._progress.remove_task(task)
