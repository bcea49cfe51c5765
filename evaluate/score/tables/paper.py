"""The rates that the paper reports, and how ours compare."""

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from importlib import resources
from typing import Any

from robomme_interference_data.evaluate.score.comparisons.pairs import compare_unpaired
from robomme_interference_data.evaluate.score.comparisons.ranks import tied_with_best
from robomme_interference_data.evaluate.score.rows.values import RELEASED_SIMULATOR
from robomme_interference_data.evaluate.systems import base_of, display_name
from robomme_interference_data.stats.intervals import newcombe, wilson
from robomme_interference_data.viz.tables import Table

from .cells import Cell

_NOTE = (
    "Published: RoboMME-Interference: Benchmarking Robot Memory Under Interference (Rathi, August "
    "2026), Tables 3 and 4. complete: over the benchmark's 450 episodes, as the published rates "
    "are. 95% intervals: Wilson for rates; Newcombe's hybrid score for differences, which takes "
    "both sides as independent samples: the paper's rows are not at hand to be paired. "
    "published_best: it cannot be told from the highest published rate of its condition, by the "
    "test of two proportions, corrected by Holm's method over the others (0.05 or more). A system "
    "that is not the paper's stands beside all of them, if its cell is complete; that is no rank."
)


_FAMILIES_NOTE = (
    "By family the paper prints no rates. These are of its public repository "
    "(SoumilRathi/robomme-interference, CC BY 4.0), which is of an earlier date, where they add up "
    "to the paper's rate over all families. A system that is not the paper's stands beside all of "
    "them, on whatever episodes it has: how many tells n, and the interval how little few say. "
    "Families of different difficulty make no rank."
)


@cache
def published() -> tuple[Cell, ...]:
    """Return all published rates, in the paper's order, as complete cells of its simulator.

    They are printed to a tenth of a percent: of 450 episodes only one count rounds to each.
    """
    cells = []
    for row in _read("published.csv"):
        n = int(row["episodes"])
        won = round(float(row["percent"]) * n / 100)
        cells.append(_cell(row["simulator"], row["system"], row["condition"], "", won, n))
    best = set[tuple[str, str]]()
    for condition in {cell.condition for cell in cells}:
        best |= _best([cell for cell in cells if cell.condition == condition])
    return tuple(replace(cell, best=(cell.system, cell.condition) in best) for cell in cells)


def _best(cells: Sequence[Cell]) -> set[tuple[str, str]]:
    """Return system and condition of the published cells that cannot be told from the best."""
    best = max(cells, key=lambda cell: cell.rate)
    others = {c.system: compare_unpaired(best.as_rate, c.as_rate) for c in cells if c is not best}
    return {(system, best.condition) for system in tied_with_best(best.system, others)}


@cache
def by_family() -> tuple[Cell, ...]:
    """Return the rates by family of the paper's repository where they are those of the paper.

    It is of an earlier date: a system under a condition is left out where its families do not add
    up to the published rate; see `differing`.
    """
    others = {*differing()}
    return tuple(one for one in _repository() if (one.system, one.condition) not in others)


@cache
def differing() -> tuple[tuple[str, str], ...]:
    """Return the systems and conditions of which paper and repository have other rates."""
    won: dict[tuple[str, str], int] = {}
    for one in _repository():
        key = (one.system, one.condition)
        won[key] = won.get(key, 0) + round(one.rate * one.n)
    printed = {(one.system, one.condition): round(one.rate * one.n) for one in published()}
    return tuple(key for key in printed if won.get(key, printed[key]) != printed[key])


@cache
def _repository() -> tuple[Cell, ...]:
    return tuple(
        _cell(
            *(RELEASED_SIMULATOR, row["variant"], row["condition"], row["family"]),
            *(int(row["successes"]), int(row["n"])),
        )
        for row in _read("repository_by_family.csv")
    )


def _cell(simulator: str, system: str, condition: str, part: str, won: int, n: int) -> Cell:
    return Cell(simulator, system, condition, part, n, won / n, wilson(won, n), n)


def _read(name: str) -> Iterator[dict[str, str]]:
    file = resources.files(__package__).joinpath("data", name)
    return csv.DictReader(file.read_text(encoding="utf-8").splitlines())


def _comparable(cells: Iterable[Cell]) -> Iterator[tuple[Cell, Cell]]:
    """Yield cells with what is published beside them.

    Of a system of the paper that is its own, and with retrieval also that of the one without; of
    any other system all of them, over the families together only if the cell is complete: rates
    over a few families are not to be set against rates over nine.
    """
    known: dict[tuple[str, str, str], list[Cell]] = {}
    for one in (*published(), *by_family()):
        known.setdefault((one.simulator, one.condition, one.part), []).append(one)
    papers = {one.system for one in published()}
    for cell in cells:
        names = [name for name in (cell.system, base_of(cell.system)) if name in papers]
        beside = known.get((cell.simulator, cell.condition, cell.part), []) if cell.n else []
        if names:
            beside = [one for name in names for one in beside if one.system == name]
        elif not (cell.part or cell.complete):
            beside = []
        for found in beside:
            yield cell, found


_SIDES = (
    "published_system n:count rate:rate low:rate high:rate published_n:count published_rate:rate "
    "published_low:rate published_high:rate"
)
_CHANGE = "difference:points difference_low:points difference_high:points complete:flag"


def paper_table(cells: Sequence[Cell]) -> Table:
    """Return our rates, complete by the benchmark's grid, beside the published ones."""
    whole = [one for one in cells if not one.part]
    rows = [
        (cell.system, cell.condition, *_sides(cell, paper), paper.best, *_change(cell, paper))
        for cell, paper in _comparable(whole)
    ]
    note = " ".join([_NOTE, *not_compared(whole)])
    columns = f"system condition {_SIDES} published_best:flag {_CHANGE}"
    return Table.make("paper", "Beside the published rates", columns, rows, note)


def paper_family_table(cells: Sequence[Cell]) -> Table:
    """Return our rates by family beside those of the paper's repository; see `paper_table`."""
    parts = [one for one in cells if one.part]
    rows = [
        (cell.system, cell.condition, cell.part, *_sides(cell, paper), *_change(cell, paper))
        for cell, paper in _comparable(parts)
    ]
    ours = {name for cell in parts for name in (cell.system, base_of(cell.system))}
    others: dict[str, list[str]] = {}
    for system, condition in differing():
        if system in ours:
            others.setdefault(display_name(system), []).append(condition)
    note = _FAMILIES_NOTE
    if others:
        told = "; ".join(f"{name} {', '.join(found)}" for name, found in others.items())
        note += f" They do not under: {told}."
    columns = f"system condition family {_SIDES} {_CHANGE}"
    return Table.make("paper_family", "Beside the published rates, by family", columns, rows, note)


def _sides(cell: Cell, paper: Cell) -> tuple[Any, ...]:
    return paper.system, cell.n, cell.rate, *cell.interval, paper.n, paper.rate, *paper.interval


def _change(cell: Cell, paper: Cell) -> tuple[Any, ...]:
    won = (cell.rate * cell.trials, cell.trials, round(paper.rate * paper.n), paper.n)
    return cell.rate - paper.rate, *newcombe(*won), cell.complete


def not_compared(cells: Sequence[Cell]) -> list[str]:
    """Return in sentences what cannot be set against the published rates, if there is any."""
    simulators = {one.simulator for one in published()}
    found = []
    if others := sorted({cell.simulator for cell in cells} - simulators):
        found.append(f"Rows of {', '.join(others)} are not set against the paper's RoboMME.")
    compared = {cell.system for cell, _ in _comparable(c for c in cells if not c.part)}
    ours = dict.fromkeys(cell.system for cell in cells if cell.simulator in simulators)
    if alone := [system for system in ours if system not in compared]:
        found.append(f"Not in the paper under these conditions: {', '.join(alone)}.")
    return found
