"""The rates that the paper reports, and how ours compare."""

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources

from robomme_interference_data.evaluate.score.cells import Cell
from robomme_interference_data.evaluate.score.effects import base_of
from robomme_interference_data.stats import newcombe, wilson
from robomme_interference_data.tables import Column, Table

__all__ = ["SOURCE", "Published", "comparable", "not_compared", "paper_table", "published"]

SOURCE = (
    "RoboMME-Interference: Benchmarking Robot Memory Under Interference (Rathi, August 2026), "
    "Tables 3 and 4"
)
"""Where the rates of `data/published.csv` stand: the main table, and the one on retrieval."""


@dataclass(frozen=True)
class Published:
    """A published rate.

    Attributes:
        table: Number of the paper's table.
        simulator: `robomme`, always: the paper has no other.
        system: Name of the system.
        condition: Name of the condition.
        percent: The rate as printed, to a tenth of a percent.
        episodes: Episodes that it is over.
    """

    table: int
    simulator: str
    system: str
    condition: str
    percent: float
    episodes: int

    @property
    def successes(self) -> int:
        """The count behind the rate: of 450 episodes only one rounds to it."""
        return round(self.percent * self.episodes / 100)

    @property
    def rate(self) -> float:
        """The rate before rounding."""
        return self.successes / self.episodes

    @property
    def interval(self) -> tuple[float, float]:
        """95% Wilson interval."""
        return wilson(self.successes, self.episodes)


@cache
def published() -> tuple[Published, ...]:
    """Return all published rates, in the paper's order."""
    file = resources.files(__package__).joinpath("data", "published.csv")
    rows = csv.DictReader(file.read_text(encoding="utf-8").splitlines())
    return tuple(
        Published(
            int(row["table"]),
            row["simulator"],
            row["system"],
            row["condition"],
            float(row["percent"]),
            int(row["episodes"]),
        )
        for row in rows
    )


def comparable(cells: Iterable[Cell]) -> Iterator[tuple[Cell, Published]]:
    """Yield the cells that the paper has, each with the published one.

    A system with retrieval comes a second time, with the published one without. The simulator is
    compared too: rows of another simulator have no published counterpart.
    """
    known = {(one.simulator, one.system, one.condition): one for one in published()}
    for cell in cells:
        for system in (cell.system, base_of(cell.system)):
            found = known.get((cell.simulator, system or "", cell.condition))
            if found is not None and cell.n:
                yield cell, found


def paper_table(cells: Sequence[Cell]) -> Table:
    """Return our rates beside the published ones.

    Args:
        cells: Ours, with completeness by the benchmark's grid, which the published rates are over.
    """
    columns = (
        *(Column("system"), Column("condition"), Column("published_system"), Column("n", "count")),
        *(Column("rate", "rate"), Column("low", "rate"), Column("high", "rate")),
        *(Column("published_n", "count"), Column("published_rate", "rate")),
        *(Column("published_low", "rate"), Column("published_high", "rate")),
        *(Column("difference", "points"), Column("difference_low", "points")),
        *(Column("difference_high", "points"), Column("complete", "flag")),
    )
    rows = []
    for cell, paper in comparable(cells):
        bounds = newcombe(cell.rate * cell.n, cell.n, paper.successes, paper.episodes)
        rows.append(
            (
                *(cell.system, cell.condition, paper.system, cell.n, cell.rate, *cell.interval),
                *(paper.episodes, paper.rate, *paper.interval),
                *(cell.rate - paper.rate, *bounds, cell.complete),
            )
        )
    note = (
        f"Published: {SOURCE}. complete: over the benchmark's 450 episodes, as the published rates "
        "are. 95% intervals: Wilson for rates; Newcombe's hybrid score for differences, which "
        "takes both sides as independent samples: the paper's rows are not at hand to be paired."
    )
    note = " ".join([note, *not_compared(cells)])
    return Table("paper", "Beside the published rates", columns, tuple(rows), note)


def not_compared(cells: Sequence[Cell]) -> list[str]:
    """Return in sentences what cannot be set against the published rates, if there is any."""
    simulators = {one.simulator for one in published()}
    found = []
    if others := sorted({cell.simulator for cell in cells} - simulators):
        found.append(f"Rows of {', '.join(others)} are not set against the paper's RoboMME.")
    here = [cell for cell in cells if cell.simulator in simulators]
    compared = {cell.system for cell, _ in comparable(here)}
    if alone := list(dict.fromkeys(c.system for c in here if c.system not in compared)):
        found.append(f"Not in the paper under these conditions: {', '.join(alone)}.")
    return found
