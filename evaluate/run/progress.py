"""Show how a run goes: success rates by family and condition, and the time left."""

import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import timedelta
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn
from rich.text import Text

from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.schema.rollouts import Rollout, Status
from robomme_interference_data.viz.tables import Table

from .log import is_done
from .plan import WorkItem

Cell = tuple[str, str]
"""A family, and a condition."""


class RunProgress:
    """A table of successes so far, a bar, and the time left, on stderr.

    Use as a context manager. Where stderr is no terminal, a line is written whenever a family's
    condition is done.

    Args:
        quiet: Show nothing.
        unit: What is counted.
    """

    def __init__(self, *, quiet: bool = False, unit: str = "rollouts"):
        self._unit = unit
        self._console = Console(stderr=True, quiet=quiet)
        self._bar = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(f"{unit}, {{task.fields[left]}}"),
            console=self._console,
        )
        self._task = self._bar.add_task("evaluate", total=None, left="")
        self._nodes: dict[str, TaskID] = {}
        self._planned: Counter[Cell] = Counter()
        self._ended: dict[Cell, Counter[str]] = {}  # by status: whole rows would be too many
        self._left = self._new = 0  # rollouts that are still to end, and that ended in this run
        self._began = self._last = time.monotonic()
        self._live = Live(console=self._console, get_renderable=self.draw, refresh_per_second=2)

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def start(self, items: Sequence[WorkItem], done: Sequence[Rollout]) -> None:
        """Take what was asked for, and the rows that an earlier run finished."""
        self._planned = Counter((item.episode.family, item.condition) for item in items)
        self._ended, self._left, self._new = _count(done), len(items) - len(done), 0
        self._bar.reset(self._task, total=len(items), completed=len(done))
        self._began = time.monotonic()
        if done and not self._console.is_terminal:
            self._console.print(f"{len(done)} of {len(items)} {self._unit} are done already")

    def row(self, row: Rollout, node: str | None = None) -> None:
        """Count a row, and which node of a cluster it is from."""
        cell = (row.family, row.condition)
        ended = self._ended.setdefault(cell, Counter())
        ended[row.status] += 1
        self._left, self._new = self._left - 1, self._new + 1
        total = self._planned.total()
        if node is not None:
            if node not in self._nodes:
                self._nodes[node] = self._bar.add_task("", total=total, left=node)
            self._bar.advance(self._nodes[node])
        self._last = time.monotonic()
        self._bar.advance(self._task)
        if not is_done(row):
            self._console.print(f"{WorkItem.of(row)} broke: {row.error}", style="red", markup=False)
        if not self._console.is_terminal and ended.total() == self._planned[cell]:
            so_far = f"{total - self._left} of {total}"
            self._console.print(f"{row.family} {row.condition}: {_rate(ended)}  ({so_far})")

    def left(self) -> float | None:
        """Return the seconds left, by the mean time that a rollout of this run took so far.

        Whatever the workers do side by side is in that mean. None until one rollout has ended.
        """
        if not self._new:
            return None
        mean = (self._last - self._began) / self._new
        return max(0.0, mean * self._left - (time.monotonic() - self._last))

    def draw(self) -> Group:
        """Return what is shown."""
        left = self.left()
        told = "" if left is None else f"{timedelta(seconds=round(left))} left"
        self._bar.update(self._task, left=told)
        return Group(Text(_table(self._ended).text() if self._ended else ""), self._bar)


def rate_table(rows: Iterable[Rollout]) -> Table:
    """Return successes of all that ended, by family and condition, errors apart."""
    return _table(_count(rows))


def _count(rows: Iterable[Rollout]) -> dict[Cell, Counter[str]]:
    """Count rows by status, in each cell."""
    cells: dict[Cell, Counter[str]] = {}
    for row in rows:
        cells.setdefault((row.family, row.condition), Counter())[row.status] += 1
    return cells


def _table(ended: Mapping[Cell, Counter[str]]) -> Table:
    families = sorted({family for family, _ in ended}, key=lambda one: EpisodeId(one, "test", 0))
    conditions = sorted({name for _, name in ended}, key=lambda one: parse_condition(one).sort_key)
    lines = [[ended.get((family, name), Counter()) for name in conditions] for family in families]
    names = [*families, "all"] if len(families) > 1 else families
    lines.append([sum(column, Counter()) for column in zip(*lines, strict=True)])
    return Table.make(
        "rates",
        "Successes by family and condition",
        " ".join(["family", *conditions]),
        ((name, *map(_rate, line)) for name, line in zip(names, lines, strict=False)),
    )


def _rate(counts: Counter[str]) -> str:
    """Return `3/5 60%`, errors apart, and how many broke; of very many only the share."""
    broken, won = counts[Status.ERROR], counts[Status.SUCCESS]
    scored = counts.total() - broken
    # So that nine families by five conditions fit into 80 columns.
    number = f"{won}/{scored} " if scored < 100 else ""
    rate = f"{number}{won / scored:.0%}" if scored else ""
    return ", ".join(filter(None, (rate, f"{broken} broke" if broken else "")))
