"""What commands print: messages and progress on stderr, JSON on stdout."""

import json
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Self

import typer
from rich.console import Console
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

MESSAGES = Console(stderr=True, soft_wrap=True, markup=False, emoji=False, highlight=False)
"""What commands say beside their output: lines are never wrapped, so that paths can be copied."""

# Parameters that several commands have.
AsJson = Annotated[bool, typer.Option("--json", help="Write JSON to standard output.")]
SplitFolder = Annotated[Path, typer.Argument(help="Folder of the split.")]
SplitOption = Annotated[
    Path, typer.Option(envvar="ROBOMME_INTERFERENCE_SPLIT", help="Folder of the split.")
]
QueryName = Annotated[str, typer.Argument(help="Episode id, such as VideoRepick/test/7.")]
ConditionName = Annotated[str, typer.Argument(help="Condition, such as k3.")]
Picture = Annotated[Path | None, typer.Option(help="Picture to write, .png or .svg.")]


def print_json(value: Any) -> None:
    """Print one JSON value to stdout."""
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False))


def command_line() -> str:
    """Return the command that runs, to be typed again."""
    return shlex.join(["robomme-interference", *sys.argv[1:]])


class _Terminated(KeyboardInterrupt):
    """SIGTERM came."""


@contextmanager
def stoppable(kept: str) -> Iterator[None]:
    """Let Ctrl-C, and SIGTERM as schedulers send it, end a command in peace; tell how to go on.

    Args:
        kept: What an interrupted command leaves behind, such as `Finished episodes are kept`.
    """

    def stop(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one must not cut the ending short
        raise _Terminated

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except KeyboardInterrupt as interrupt:
        MESSAGES.print(f"\nStopped. {kept}; go on with:\n{command_line()}")
        raise typer.Exit(143 if isinstance(interrupt, _Terminated) else 130) from None
    except OSError as error:
        if error.errno is not None:  # the system's word on a file, such as that the disk is full
            MESSAGES.print(f"Stopped. {kept}; once mended, go on with:\n{command_line()}")
        raise
    finally:
        signal.signal(signal.SIGTERM, before)


class _Speed(ProgressColumn):
    def __init__(self, unit: str):
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:,.0f} {self._unit}/s" if speed else "", style="progress.data.speed")


class WorkProgress:
    """A progress bar on stderr; use as a context manager.

    Args:
        unit: What is counted.
        quiet: Show nothing.
    """

    def __init__(self, *, unit: str = "frames", quiet: bool = False):
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(unit),
            _Speed(unit),
            TimeRemainingColumn(),
            console=Console(stderr=True, quiet=quiet),
            speed_estimate_period=3600,  # s; one piece of work may take half of it
        )
        self._task: TaskID | None = None

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._progress.stop()

    def start(self, description: str, frames: int) -> None:
        """Begin a new bar of so many frames."""
        self._task = self._progress.add_task(description, total=frames)
        self._progress.advance(self._task, 0)  # the speed is since then

    def advance(self, frames: int, *, before: bool = False) -> None:
        """Count frames as done.

        Args:
            frames: How many.
            before: They were done by an earlier run, and do not count for the speed.
        """
        if self._task is None:
            return
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
