"""Show how a run goes: success rates by family and condition, and the time left."""

import time
from collections.abc import Iterable, Sequence
from datetime import timedelta
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn
from rich.text import Text

from robomme_interference_data.conditions import parse_condition
from robomme_interference_data.evaluate.log import count_statuses, is_done
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.rollouts import Rollout, Status
from robomme_interference_data.tables import Table


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
        self._items: tuple[WorkItem, ...] = ()
        self._rows: list[Rollout] = []
        self._before = 0  # rows of an earlier run
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
        self._items, self._rows, self._before = tuple(items), list(done), len(done)
        self._bar.reset(self._task, total=len(items), completed=len(done))
        self._began = time.monotonic()
        if done and not self._console.is_terminal:
            self._console.print(f"{len(done)} of {len(items)} {self._unit} are done already")

    def row(self, row: Rollout, node: str | None = None) -> None:
        """Count a row, and which node of a cluster it is from."""
        self._rows.append(row)
        if node is not None:
            if node not in self._nodes:
                self._nodes[node] = self._bar.add_task("", total=len(self._items), left=node)
            self._bar.advance(self._nodes[node])
        self._last = time.monotonic()
        self._bar.advance(self._task)
        if not is_done(row):
            self._console.print(f"{WorkItem.of(row)} broke: {row.error}", style="red", markup=False)
        if not self._console.is_terminal:
            cell = (row.family, row.condition)
            ended = [one for one in self._rows if (one.family, one.condition) == cell]
            planned = [o for o in self._items if (o.episode.family, o.condition) == cell]
            if len(ended) == len(planned):
                total = f"{len(self._rows)} of {len(self._items)}"
                self._console.print(f"{row.family} {row.condition}: {_rate(ended)}  ({total})")

    def left(self) -> float | None:
        """Return the seconds left, by the mean time that a rollout of this run took so far.

        Whatever the workers do side by side is in that mean. None until one rollout has ended.
        """
        ended = len(self._rows) - self._before
        if not ended:
            return None
        mean = (self._last - self._began) / ended
        rest = mean * (len(self._items) - len(self._rows))
        return max(0.0, rest - (time.monotonic() - self._last))

    def draw(self) -> Group:
        """Return what is shown."""
        left = self.left()
        told = "" if left is None else f"{timedelta(seconds=round(left))} left"
        self._bar.update(self._task, left=told)
        return Group(Text(rate_table(self._rows).text() if self._rows else ""), self._bar)


def rate_table(rows: Iterable[Rollout]) -> Table:
    """Return successes of all that ended, by family and condition, errors apart."""
    cells: dict[tuple[str, str], list[Rollout]] = {}
    for row in sorted(rows, key=WorkItem.of):
        for family in (row.family, "all"):
            cells.setdefault((family, row.condition), []).append(row)
    families = [family for family in dict.fromkeys(f for f, _ in cells) if family != "all"]
    families += ["all"] if len(families) > 1 else []
    conditions = sorted(
        {name for _, name in cells}, key=lambda name: parse_condition(name).sort_key
    )
    return Table.make(
        "rates",
        "Successes by family and condition",
        " ".join(["family", *conditions]),
        ((f, *(_rate(cells.get((f, c), [])) for c in conditions)) for f in families),
    )


def _rate(rows: Sequence[Rollout]) -> str:
    """Return `3/5 60%`, errors apart, and how many broke; of very many only the share."""
    counts = count_statuses(rows)
    broken, won = counts[Status.ERROR], counts[Status.SUCCESS]
    scored = len(rows) - broken
    # So that nine families by five conditions fit into 80 columns.
    number = f"{won}/{scored} " if scored < 100 else ""
    rate = f"{number}{won / scored:.0%}" if scored else ""
    return ", ".join(filter(None, (rate, f"{broken} broke" if broken else "")))
