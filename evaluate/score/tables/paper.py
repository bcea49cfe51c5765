"""The published rates, and how scored rates compare with them."""

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from importlib import resources
from itertools import combinations

from robomme_interference_data.evaluate.score.rows.values import RELEASED_SIMULATOR
from robomme_interference_data.evaluate.systems import published_base
from robomme_interference_data.stats.intervals import newcombe, wilson
from robomme_interference_data.viz.tables import Columns, Table

from .cells import SuccessCell
from .comparison import record_table
from .pairs import compare_unpaired
from .ranks import tied_with_best

_NOTE = (
    "Published: RoboMME-Interference: Benchmarking Robot Memory Under Interference (Rathi, "
    "arXiv:2606.22338), Tables 3 and 4. complete: over the benchmark's 450 episodes, like the "
    "published rates. 95% intervals: Wilson for rates; Newcombe's hybrid score for differences, "
    "with both sides as independent samples, because the published tables have no rows. The "
    "paper's repository has rows of nine systems, canonical_rollouts.csv, which can be scored "
    "beside these. published_best: no other published rate of its condition is significantly "
    "higher, by the test of two proportions after Holm's correction over all pairs. A system that "
    "is not in the paper is listed beside all of them if its cell is complete; this is not a "
    "ranking."
)
_COLUMNS: Columns = {
    "system": "text",
    "condition": "text",
    "published_system": "text",
    "n": "count",
    "rate": "rate",
    "low": "rate",
    "high": "rate",
    "published_n": "count",
    "published_rate": "rate",
    "published_low": "rate",
    "published_high": "rate",
    "published_best": "flag",
    "difference": "points",
    "difference_low": "points",
    "difference_high": "points",
    "complete": "flag",
}


@cache
def published() -> tuple[SuccessCell, ...]:
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


def _best(cells: Sequence[SuccessCell]) -> set[tuple[str, str]]:
    """Return system and condition of the published cells that no other one is better than."""
    pairs = {
        (cell.system, other.system): compare_unpaired(other.as_rate, cell.as_rate)
        for cell, other in combinations(cells, 2)
    }
    best = tied_with_best([cell.system for cell in cells], pairs)
    return {(cell.system, cell.condition) for cell in cells if cell.system in best}


@cache
def by_family() -> tuple[SuccessCell, ...]:
    """Return the repository's rates by family, without those that contradict the paper."""
    contradicting = {*differing()}
    return tuple(
        cell for cell in _repository() if (cell.system, cell.condition) not in contradicting
    )


@cache
def differing() -> tuple[tuple[str, str], ...]:
    """Return the systems and conditions whose rates differ between paper and repository."""
    won: dict[tuple[str, str], int] = {}
    for cell in _repository():
        key = (cell.system, cell.condition)
        won[key] = won.get(key, 0) + round(cell.rate * cell.n)
    printed = {(cell.system, cell.condition): round(cell.rate * cell.n) for cell in published()}
    return tuple(key for key in printed if won.get(key, printed[key]) != printed[key])


@cache
def _repository() -> tuple[SuccessCell, ...]:
    return tuple(
        _cell(
            RELEASED_SIMULATOR,
            row["variant"],
            row["condition"],
            row["family"],
            int(row["successes"]),
            int(row["n"]),
        )
        for row in _read("repository_by_family.csv")
    )


def _cell(simulator: str, system: str, condition: str, part: str, won: int, n: int) -> SuccessCell:
    return SuccessCell(simulator, system, condition, part, n, won / n, wilson(won, n), n)


def _read(name: str) -> Iterator[dict[str, str]]:
    file = resources.files(__package__).joinpath("data", name)
    return csv.DictReader(file.read_text(encoding="utf-8").splitlines())


def _comparable(cells: Iterable[SuccessCell]) -> Iterator[tuple[SuccessCell, SuccessCell]]:
    """Yield cells over all families with each published cell that they are compared with.

    A system of the paper is compared with itself, one with retrieval also with the one without, and
    any other system with all of them, only if its cell is complete: rates over a few families are
    not comparable with rates over nine.
    """
    known: dict[tuple[str, str], list[SuccessCell]] = {}
    for rate in published():
        known.setdefault((rate.simulator, rate.condition), []).append(rate)
    papers = {rate.system for rate in published()}
    for cell in cells:
        if cell.part or not cell.n:
            continue
        beside = known.get((cell.simulator, cell.condition), [])
        names = [name for name in (cell.system, published_base(cell.system)) if name in papers]
        if names:
            beside = [rate for name in names for rate in beside if rate.system == name]
        elif not cell.complete:
            beside = []
        for rate in beside:
            yield cell, rate


def paper_table(cells: Sequence[SuccessCell]) -> Table:
    """Return rates beside the published ones."""
    cells = [cell for cell in cells if not cell.part]
    records = []
    for cell, paper in _comparable(cells):
        won, paper_won = cell.rate * cell.trials, round(paper.rate * paper.n)
        difference_low, difference_high = newcombe(won, cell.trials, paper_won, paper.n)
        records.append(
            {
                "system": cell.system,
                "condition": cell.condition,
                "published_system": paper.system,
                "n": cell.n,
                "rate": cell.rate,
                "low": cell.interval[0],
                "high": cell.interval[1],
                "published_n": paper.n,
                "published_rate": paper.rate,
                "published_low": paper.interval[0],
                "published_high": paper.interval[1],
                "published_best": paper.best,
                "difference": cell.rate - paper.rate,
                "difference_low": difference_low,
                "difference_high": difference_high,
                "complete": cell.complete,
            }
        )
    note = " ".join([_NOTE, *not_compared(cells)])
    return record_table("paper", "Comparison with the published rates", _COLUMNS, records, note)


def not_compared(cells: Sequence[SuccessCell]) -> list[str]:
    """Return sentences about what has no published counterpart, if anything."""
    simulators = {cell.simulator for cell in published()}
    sentences = []
    if others := sorted({cell.simulator for cell in cells} - simulators):
        sentences.append(f"Rows of {', '.join(others)} are not compared with the paper's RoboMME.")
    compared = {cell.system for cell, _ in _comparable(cells)}
    ours = dict.fromkeys(cell.system for cell in cells if cell.simulator in simulators)
    if alone := [system for system in ours if system not in compared]:
        sentences.append(f"Not in the paper under these conditions: {', '.join(alone)}.")
    return sentences
