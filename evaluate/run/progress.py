"""Show the progress of a run: success rates by family and condition, and the time left."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from statistics import fmean
from typing import Any, Self

from robomme_interference_data.constants import RECORDINGS
from robomme_interference_data.errors import visible
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.progress import WorkProgress, duration
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.viz.tables import Table

from .plan import WorkItem
from .row import Rollout, is_done

FamilyCondition = tuple[str, str]


class RunProgress:
    """A table of successes above a progress bar, on stderr; use as a context manager.

    If stderr is no terminal, it prints a line whenever a family is done under a condition. Once
    each of the workers has ended two rows or so, it prints what the time left depends on, if that
    is a minute or more.
    """

    def __init__(self, *, quiet: bool = False, unit: str = "rollouts", workers: int = 1):
        self._unit, self._workers = unit, workers
        self._timed: list[Rollout] = []  # until the estimate is printed
        self._bar = WorkProgress(unit=unit, quiet=quiet, above=self.rates)
        self._console = self._bar.console
        self._planned: Counter[FamilyCondition] = Counter()
        self._ended: dict[FamilyCondition, Counter[str]] = {}  # by status
        self._left = 0  # unfinished rollouts

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._bar.__enter__()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._console.is_terminal:
            self._bar.__exit__(*exception)

    def note(self, text: str) -> None:
        """Print a sentence."""
        self._console.print(text, markup=False)

    def start(self, items: Sequence[WorkItem], done: Sequence[Rollout]) -> None:
        """Show the plan, and the rows of earlier invocations."""
        self._planned = Counter((item.episode.family, item.condition) for item in items)
        self._ended, self._left = _count(done), len(items) - len(done)
        self._bar.start("evaluate", len(items))
        self._bar.advance(len(done), before=True)
        if done and not self._console.is_terminal:
            self._console.print(f"{len(done)} of {len(items)} {self._unit} are already done")

    def row(self, row: Rollout, node: str | None = None) -> None:
        """Count a row, and the node of a cluster that it comes from."""
        cell = (row.family, row.condition)
        ended = self._ended.setdefault(cell, Counter())
        ended[row.status] += 1
        self._left -= 1
        self._bar.advance(1, node=node)
        if row.wall_s is not None and len(self._timed) < 2 * self._workers:
            self._timed.append(row)
            enough = len(self._timed) == 2 * self._workers and self._left > len(self._timed)
            if enough and (text := estimate(self._timed, self._left, self._workers)):
                self._console.print(text)
        if not is_done(row):
            error = visible(f"{WorkItem.of(row)} broke: {row.error}")
            self._console.print(error, style="red", markup=False)
        if not self._console.is_terminal and ended.total() == self._planned[cell]:
            total = self._planned.total()
            so_far = f"{total - self._left} of {total}"
            self._console.print(f"{row.family} {row.condition}: {_rate(ended)}  ({so_far})")

    def rates(self) -> str:
        """Return the table of successes so far."""
        return _table(self._ended).text() if self._ended else ""


_PARTS = {
    "reset_s": "the simulator",
    "simulator_s": "the simulator",
    "policy_s": "the policy",
    "history_s": "the history",
    "model_s": "the model",
}
"""Where the time of a row goes, by column."""

_OFFLINE_PARTS = _PARTS | {"reset_s": "the recordings", "simulator_s": "the recordings"}

_SHORTEST_ESTIMATE_S = 60
"""Seconds that are left, at least, for an estimate: a shorter run ends before it is read."""


def estimate(rows: Sequence[Rollout], left: int, workers: int) -> str:
    """Return how long the remaining rows take, and on what, if they are as the given ones.

    Empty if they take less than a minute. The shares are of the whole time.

    Args:
        rows: Rows with times.
        left: Number of remaining rows.
        workers: Number of workers, which all have work.
    """
    total = sum(row.wall_s or 0.0 for row in rows)
    seconds = total / len(rows) * left / workers
    if seconds < _SHORTEST_ESTIMATE_S:
        return ""
    names = _OFFLINE_PARTS if rows[0].simulator == RECORDINGS else _PARTS
    parts = dict.fromkeys(names.values(), 0.0)
    for column, part in names.items():
        parts[part] += sum(getattr(row, column) or 0.0 for row in rows)
    longest = sorted(parts.items(), key=itemgetter(1), reverse=True)
    # Such as videos that are written, and checks of the data.
    longest.append(("the rest", total - sum(parts.values())))
    shares = [f"{part} {value / total:.0%}" for part, value in longest if value / total >= 0.005]
    return f"about {duration(seconds)} left; where the time goes: {', '.join(shares)}"


def rate_table(rows: Iterable[Rollout]) -> Table:
    """Return the success rates by family and condition, with errors apart."""
    return _table(_count(rows))


def error_table(rows: Iterable[Rollout]) -> Table:
    """Return the mean action error of an offline run by family and condition, and broken rows."""
    cells: dict[FamilyCondition, list[Rollout]] = {}
    for row in rows:
        cells.setdefault((row.family, row.condition), []).append(row)
    conditions, lines = _lines(cells, [])
    return Table(
        "errors",
        "Mean absolute action error by family and condition",
        dict.fromkeys(["family", *conditions], "text"),
        [(name, *map(_action_error, line)) for name, line in lines],
    )


def _action_error(rows: Sequence[Rollout]) -> str:
    """Return `0.0123`, or `0.0123, 2 broke`: the mean is over the others."""
    errors = [row.action_l1 for row in rows if row.action_l1 is not None]
    broken = sum(row.status == Status.ERROR for row in rows)
    mean = f"{fmean(errors):.4f}" if errors else ""
    return ", ".join(filter(None, (mean, f"{broken} broke" if broken else "")))


def _count(rows: Iterable[Rollout]) -> dict[FamilyCondition, Counter[str]]:
    """Count rows by status, in each cell."""
    cells: dict[FamilyCondition, Counter[str]] = {}
    for row in rows:
        cells.setdefault((row.family, row.condition), Counter())[row.status] += 1
    return cells


def _table(ended: Mapping[FamilyCondition, Counter[str]]) -> Table:
    conditions, lines = _lines(ended, Counter())
    return Table(
        "rates",
        "Successes by family and condition",
        dict.fromkeys(["family", *conditions], "text"),
        [(name, *map(_rate, line)) for name, line in lines],
    )


def _lines(
    cells: Mapping[FamilyCondition, Any], empty: Any
) -> tuple[list[str], list[tuple[str, list[Any]]]]:
    """Return the conditions, and each family with its cells; of several families, also all."""
    families = sorted(
        {family for family, _ in cells}, key=lambda family: EpisodeId(family, "test", 0)
    )
    conditions = sorted(
        {name for _, name in cells}, key=lambda name: parse_condition(name).sort_key
    )
    lines = [
        (family, [cells.get((family, name), empty) for name in conditions]) for family in families
    ]
    if len(lines) > 1:
        columns = zip(*(line for _, line in lines), strict=True)
        lines.append(("all", [sum(column, empty) for column in columns]))
    return conditions, lines


def _rate(counts: Counter[str]) -> str:
    """Return `3/5 60%`, or of 100 and more `60%`, or offline `5 measured`; and the errors."""
    broken, won = counts[Status.ERROR], counts[Status.SUCCESS]
    measured = counts[Status.MEASURED]
    scored = counts.total() - broken - measured
    # Nine families by five conditions fit into 80 columns.
    number = f"{won}/{scored} " if scored < 100 else ""
    rate = f"{number}{won / scored:.0%}" if scored else ""
    others = (f"{n} {what}" for n, what in ((measured, "measured"), (broken, "broke")) if n)
    return ", ".join(filter(None, (rate, *others)))
