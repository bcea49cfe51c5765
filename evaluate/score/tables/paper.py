"""The published rates, and how scored rates compare with them."""

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from importlib import resources
from itertools import combinations
from typing import Any

from robomme_interference_data.evaluate.score.comparisons.pairs import compare_unpaired
from robomme_interference_data.evaluate.score.comparisons.ranks import tied_with_best
from robomme_interference_data.evaluate.score.comparisons.tables import columns_of
from robomme_interference_data.evaluate.score.rows.values import RELEASED_SIMULATOR
from robomme_interference_data.evaluate.systems import display_name, published_base
from robomme_interference_data.stats.intervals import newcombe, wilson
from robomme_interference_data.viz.tables import Table

from .cells import Cell

_NOTE = (
    "Published: RoboMME-Interference: Benchmarking Robot Memory Under Interference (Rathi, August "
    "2026), Tables 3 and 4. complete: over the benchmark's 450 episodes, like the published rates. "
    "95% intervals: Wilson for rates; Newcombe's hybrid score for differences, with both sides as "
    "independent samples, because the paper's rows are not available for pairing. published_best: "
    "no other published rate of its condition is significantly higher, by the test of two "
    "proportions after Holm's correction over all pairs. A system that is not "
    "in the paper is listed beside all of them if its cell is complete; this is not a ranking."
)
_FAMILIES_NOTE = (
    "The paper reports no rates by family. These are from its public repository "
    "(SoumilRathi/robomme-interference, CC BY 4.0), an earlier version, where they add up to the "
    "paper's rate over all families; those of Retrieval-FrameSamp-Modul are counted from its "
    "released rows. A system that is not in the paper is listed beside all of "
    "them, with any number of episodes (n). Families differ in difficulty: this is not a ranking."
)
_SIDES = (
    "published_system n:count rate:rate low:rate high:rate published_n:count published_rate:rate "
    "published_low:rate published_high:rate"
)
_CHANGE = "difference:points difference_low:points difference_high:points complete:flag"


@cache
def published() -> tuple[Cell, ...]:
    """Return all published rates, in the paper's order, as complete cells of its simulator.

    The paper prints tenths of a percent, which only one count of 450 episodes rounds to.
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
    """Return system and condition of the published cells that no other one is better than."""
    pairs = {
        (one.system, other.system): compare_unpaired(other.as_rate, one.as_rate)
        for one, other in combinations(cells, 2)
    }
    best = tied_with_best([cell.system for cell in cells], pairs)
    return {(cell.system, cell.condition) for cell in cells if cell.system in best}


@cache
def by_family() -> tuple[Cell, ...]:
    """Return the repository's rates by family, without those that contradict the paper."""
    others = {*differing()}
    return tuple(one for one in _repository() if (one.system, one.condition) not in others)


@cache
def differing() -> tuple[tuple[str, str], ...]:
    """Return the systems and conditions whose rates differ between paper and repository."""
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
    """Yield cells with each published cell that they are compared with.

    A system of the paper is compared with itself, one with retrieval also with the one without, and
    any other system with all of them, over all families only if its cell is complete: rates over a
    few families are not comparable with rates over nine.
    """
    known: dict[tuple[str, str, str], list[Cell]] = {}
    for one in (*published(), *by_family()):
        known.setdefault((one.simulator, one.condition, one.part), []).append(one)
    papers = {one.system for one in published()}
    for cell in cells:
        names = [name for name in (cell.system, published_base(cell.system)) if name in papers]
        beside = known.get((cell.simulator, cell.condition, cell.part), []) if cell.n else []
        if names:
            beside = [one for name in names for one in beside if one.system == name]
        elif not (cell.part or cell.complete):
            beside = []
        for paper in beside:
            yield cell, paper


def paper_table(cells: Sequence[Cell], *, by_part: bool = False) -> Table:
    """Return rates beside the published ones: `paper`, or by family `paper_family`."""
    cells = [one for one in cells if bool(one.part) == by_part]
    rows = []
    for cell, paper in _comparable(cells):
        won = (cell.rate * cell.trials, cell.trials, round(paper.rate * paper.n), paper.n)
        row: list[Any] = [cell.system, cell.condition, *[cell.part] * by_part, paper.system]
        row += [cell.n, cell.rate, *cell.interval, paper.n, paper.rate, *paper.interval]
        row += [paper.best] * (not by_part)
        rows.append((*row, cell.rate - paper.rate, *newcombe(*won), cell.complete))
    if not by_part:
        columns = f"system condition {_SIDES} published_best:flag {_CHANGE}"
        note = " ".join([_NOTE, *not_compared(cells)])
        return Table(
            "paper", "Comparison with the published rates", columns_of(columns), rows, note
        )
    ours = {name for cell in cells for name in (cell.system, published_base(cell.system))}
    others: dict[str, list[str]] = {}
    for system, condition in differing():
        if system in ours:
            others.setdefault(display_name(system), []).append(condition)
    listed = "; ".join(f"{name} {', '.join(conditions)}" for name, conditions in others.items())
    note = _FAMILIES_NOTE + f" They do not for: {listed}." * bool(others)
    columns = f"system condition family {_SIDES} {_CHANGE}"
    title = "Comparison with the published rates by family"
    return Table("paper_family", title, columns_of(columns), rows, note)


def not_compared(cells: Sequence[Cell]) -> list[str]:
    """Return sentences about what has no published counterpart, if anything."""
    simulators = {one.simulator for one in published()}
    sentences = []
    if others := sorted({cell.simulator for cell in cells} - simulators):
        sentences.append(f"Rows of {', '.join(others)} are not compared with the paper's RoboMME.")
    compared = {cell.system for cell, _ in _comparable(c for c in cells if not c.part)}
    ours = dict.fromkeys(cell.system for cell in cells if cell.simulator in simulators)
    if alone := [system for system in ours if system not in compared]:
        sentences.append(f"Not in the paper under these conditions: {', '.join(alone)}.")
    return sentences
