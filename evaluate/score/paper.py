"""The rates that the paper reports, and how ours compare."""

import csv
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from importlib import resources

from robomme_interference_data.evaluate.score.cells import Cell
from robomme_interference_data.evaluate.score.pairs import apart
from robomme_interference_data.evaluate.score.ranks import cannot_be_told
from robomme_interference_data.evaluate.systems import base_of
from robomme_interference_data.stats import newcombe, wilson
from robomme_interference_data.tables import Table

_NOTE = (
    "Published: RoboMME-Interference: Benchmarking Robot Memory Under Interference (Rathi, August "
    "2026), Tables 3 and 4. complete: over the benchmark's 450 episodes, as the published rates "
    "are. 95% intervals: Wilson for rates; Newcombe's hybrid score for differences, which takes "
    "both sides as independent samples: the paper's rows are not at hand to be paired. "
    "published_best: it cannot be told from the highest published rate of its condition, by the "
    "test of two proportions, corrected by Holm's method over the others (0.05 or more)."
)


@cache
def published() -> tuple[Cell, ...]:
    """Return all published rates, in the paper's order, as complete cells of its simulator.

    They are printed to a tenth of a percent: of 450 episodes only one count rounds to each.
    """
    file = resources.files(__package__).joinpath("data", "published.csv")
    cells = []
    for row in csv.DictReader(file.read_text(encoding="utf-8").splitlines()):
        n = int(row["episodes"])
        won = round(float(row["percent"]) * n / 100)
        names = (row["simulator"], row["system"], row["condition"])
        cells.append(Cell(*names, "", n, won / n, wilson(won, n), n))
    best = {one for group in _by_condition(cells) for one in _best(group)}
    return tuple(replace(cell, best=(cell.system, cell.condition) in best) for cell in cells)


def _by_condition(cells: Iterable[Cell]) -> list[list[Cell]]:
    found = defaultdict[str, list[Cell]](list)
    for cell in cells:
        found[cell.condition].append(cell)
    return [*found.values()]


def _best(cells: Sequence[Cell]) -> set[tuple[str, str]]:
    """Return system and condition of the published cells that cannot be told from the best."""
    sides = [(cell.rate, cell.trials, cell.n) for cell in cells]
    best = max(cells, key=lambda cell: cell.rate)
    first = sides[cells.index(best)]
    compared = {
        cell.system: None if cell is best else apart([first, side])
        for cell, side in zip(cells, sides, strict=True)
    }
    return {(system, best.condition) for system in cannot_be_told(compared)}


def _comparable(cells: Iterable[Cell]) -> Iterator[tuple[Cell, Cell]]:
    """Yield cells with the published one; of retrieval also with the published one without it."""
    known = {(one.simulator, one.system, one.condition): one for one in published()}
    for cell in cells:
        for system in (cell.system, base_of(cell.system)):
            found = known.get((cell.simulator, system or "", cell.condition))
            if found is not None and cell.n and not cell.part:
                yield cell, found


def paper_table(cells: Sequence[Cell]) -> Table:
    """Return our rates beside the published ones.

    Args:
        cells: Ours, with completeness by the benchmark's grid, which the published rates are over.
    """
    rows = []
    for cell, paper in _comparable(cells):
        bounds = newcombe(
            cell.rate * cell.trials, cell.trials, round(paper.rate * paper.n), paper.n
        )
        ours = (cell.system, cell.condition, paper.system, cell.n, cell.rate, *cell.interval)
        change = (cell.rate - paper.rate, *bounds, cell.complete)
        rows.append((*ours, paper.n, paper.rate, *paper.interval, paper.best, *change))
    return Table.make(
        "paper",
        "Beside the published rates",
        "system condition published_system n:count rate:rate low:rate high:rate published_n:count "
        "published_rate:rate published_low:rate published_high:rate published_best:flag "
        "difference:points difference_low:points difference_high:points complete:flag",
        rows,
        " ".join([_NOTE, *not_compared(cells)]),
    )


def not_compared(cells: Sequence[Cell]) -> list[str]:
    """Return in sentences what cannot be set against the published rates, if there is any."""
    simulators = {one.simulator for one in published()}
    found = []
    if others := sorted({cell.simulator for cell in cells} - simulators):
        found.append(f"Rows of {', '.join(others)} are not set against the paper's RoboMME.")
    compared = {cell.system for cell, _ in _comparable(cells)}
    ours = dict.fromkeys(cell.system for cell in cells if cell.simulator in simulators)
    if alone := [system for system in ours if system not in compared]:
        found.append(f"Not in the paper under these conditions: {', '.join(alone)}.")
    return found
