"""Show how a run goes: success rates by family and condition, and the time left."""

import time
from collections.abc import Sequence
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.progress_bar import ProgressBar
from rich.table import Column, Table
from rich.text import Text

from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.evaluate.rows import Rollout
from robomme_interference_data.simulators.base import Status

__all__ = ["RunProgress", "rate_table"]

_BAR = 10
"""Characters of a bar: nine families by five conditions fit into 80 columns."""


class RunProgress:
    """Bars by family and condition with success rates, and the time left, on stderr.

    Use as a context manager. Where stderr is no terminal, a line is written whenever a family's
    condition is done.

    Args:
        quiet: Show nothing.
    """

    def __init__(self, *, quiet: bool = False):
        self._console = Console(stderr=True, quiet=quiet)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("rollouts, {task.fields[left]}"),
            console=self._console,
        )
        self._task = self._progress.add_task("evaluate", total=None, left="")
        self._planned: dict[tuple[str, str], int] = {}
        self._rows: dict[tuple[object, ...], Rollout] = {}
        self._began = self._last = time.monotonic()
        self._ended = 0
        self._live = Live(console=self._console, get_renderable=self._draw, refresh_per_second=2)

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def start(self, plan: Sequence[WorkItem], done: Sequence[Rollout]) -> None:
        """Take the plan, and the rows that an earlier run finished."""
        for item in plan:
            cell = (item.episode.family, item.condition)
            self._planned[cell] = self._planned.get(cell, 0) + 1
        self._rows = {row.key: row for row in done}
        self._progress.update(self._task, total=len(plan))
        self._progress.reset(self._task, completed=len(done))
        self._began = time.monotonic()
        if done and not self._console.is_terminal:
            self._console.print(f"{len(done)} of {len(plan)} rollouts are done already")

    def row(self, row: Rollout) -> None:
        """Count a row."""
        self._rows[row.key] = row
        self._ended += 1
        self._last = time.monotonic()
        self._progress.advance(self._task)
        if row.status == Status.ERROR:
            name = f"{row.family}/{row.episode_split}/{row.episode} {row.condition}"
            self._console.print(f"{name} broke: {row.error}", style="red", markup=False)
        cell = (row.family, row.condition)
        ended = [r for r in self._rows.values() if (r.family, r.condition) == cell]
        if not self._console.is_terminal and len(ended) == self._planned[cell]:
            total = f"{len(self._rows)} of {sum(self._planned.values())}"
            self._console.print(f"{row.family} {row.condition}: {_rate(ended)}  ({total})")

    def left(self) -> float | None:
        """Return the seconds left, by the mean time that a rollout of this run took so far.

        Whatever the workers do side by side is in that mean. None until one rollout has ended.
        """
        if not self._ended:
            return None
        mean = (self._last - self._began) / self._ended
        rest = mean * (sum(self._planned.values()) - len(self._rows))
        return max(0.0, rest - (time.monotonic() - self._last))

    def _draw(self) -> Group:
        left = self.left()
        told = "" if left is None else f"{_clock(left)} left"
        self._progress.update(self._task, left=told)
        return Group(_bars(list(self._rows.values()), self._planned), self._progress)


def _bars(rows: Sequence[Rollout], planned: dict[tuple[str, str], int]) -> Table:
    """Return a bar by family and condition: how many ended, and how many of those succeeded."""
    families = list(dict.fromkeys(family for family, _ in planned))
    conditions = list(dict.fromkeys(condition for _, condition in planned))
    table = Table(Column("family", no_wrap=True), *conditions, box=None, pad_edge=False)
    for family in families:
        cells: list[Group | str] = []
        for condition in conditions:
            total = planned.get((family, condition), 0)
            found = [r for r in rows if (r.family, r.condition) == (family, condition)]
            told = Text(f"{len(found)}/{total} {_share(found)}", no_wrap=True)
            bar = ProgressBar(total=total, completed=len(found), width=_BAR)
            cells.append(Group(told, bar) if total else "")
        table.add_row(family, *cells)
    return table


def rate_table(rows: Sequence[Rollout]) -> Table:
    """Return success rates by family and condition, errors apart, as a rich table."""
    cells: dict[tuple[str, str], list[Rollout]] = {}
    for row in rows:
        cells.setdefault((row.family, row.condition), []).append(row)
    families = list(dict.fromkeys(family for family, _ in cells))
    conditions = list(dict.fromkeys(condition for _, condition in cells))
    table = Table(Column("family", no_wrap=True), *conditions, box=None, pad_edge=False)
    for family in families:
        found = [cells.get((family, condition), []) for condition in conditions]
        table.add_row(family, *(_rate(group) for group in found))
    if len(families) > 1:
        table.add_section()
        table.add_row("all", *(_rate([r for r in rows if r.condition == c]) for c in conditions))
    return table


def _rate(rows: Sequence[Rollout]) -> str:
    scored = [row for row in rows if row.status != Status.ERROR]
    broken = len(rows) - len(scored)
    errors = f", {broken} broke" if broken else ""
    won = sum(row.status == Status.SUCCESS for row in scored)
    return f"{won}/{len(scored)} {_share(rows)}{errors}" if scored else f"–{errors}"


def _share(rows: Sequence[Rollout]) -> str:
    """Return the success rate, errors apart; nothing if there is none."""
    scored = [row for row in rows if row.status != Status.ERROR]
    if not scored:
        return ""
    return f"{sum(row.status == Status.SUCCESS for row in scored) / len(scored):.0%}"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"
