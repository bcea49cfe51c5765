"""Show how a run goes: success rates by family and condition, and the time left."""

from collections.abc import Sequence
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.evaluate.rows import Rollout
from robomme_interference_data.simulators.base import Status

__all__ = ["RunProgress", "rate_table"]


class RunProgress:
    """A table and a bar on stderr; use as a context manager.

    Where stderr is no terminal, a line is written whenever a family's condition is done.

    Args:
        quiet: Show nothing.
    """

    def __init__(self, *, quiet: bool = False):
        self._console = Console(stderr=True, quiet=quiet)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("rollouts, left:"),
            TimeRemainingColumn(),
            console=self._console,
        )
        self._task = self._progress.add_task("evaluate", total=None)
        self._planned: dict[tuple[str, str], int] = {}
        self._rows: dict[tuple[object, ...], Rollout] = {}
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
        if done and not self._console.is_terminal:
            self._console.print(f"{len(done)} of {len(plan)} rollouts are done already")

    def row(self, row: Rollout) -> None:
        """Count a row."""
        self._rows[row.key] = row
        self._progress.advance(self._task)
        if row.status == Status.ERROR:
            name = f"{row.family}/{row.episode_split}/{row.episode} {row.condition}"
            self._console.print(f"{name} broke: {row.error}", style="red", markup=False)
        cell = (row.family, row.condition)
        ended = [r for r in self._rows.values() if (r.family, r.condition) == cell]
        if not self._console.is_terminal and len(ended) == self._planned[cell]:
            total = f"{len(self._rows)} of {sum(self._planned.values())}"
            self._console.print(f"{row.family} {row.condition}: {_rate(ended)}  ({total})")

    def _draw(self) -> Group:
        return Group(rate_table(list(self._rows.values()), self._planned), self._progress)


def rate_table(rows: Sequence[Rollout], planned: dict[tuple[str, str], int] | None = None) -> Table:
    """Return success rates by family and condition, errors apart, as a rich table.

    Args:
        rows: The rows.
        planned: Rollouts to come by family and condition, in the order of the table; None: those
            of the rows.
    """
    cells: dict[tuple[str, str], list[Rollout]] = {cell: [] for cell in planned or {}}
    for row in rows:
        cells.setdefault((row.family, row.condition), []).append(row)
    families = list(dict.fromkeys(family for family, _ in cells))
    conditions = list(dict.fromkeys(condition for _, condition in cells))
    table = Table("family", *conditions, box=None, pad_edge=False)
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
    if not scored:
        return f"–{errors}"
    won = sum(row.status == Status.SUCCESS for row in scored)
    return f"{won}/{len(scored)} {won / len(scored):.0%}{errors}"
