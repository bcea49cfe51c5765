"""Rates of cells: system × condition, and the same by family and by difficulty."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.rows import condition_rank
from robomme_interference_data.evaluate.score.check import DIFFICULTIES
from robomme_interference_data.evaluate.score.outcomes import ERROR, Expected, Outcomes, episode_id
from robomme_interference_data.evaluate.systems import display_name, is_bound
from robomme_interference_data.intervals import wilson
from robomme_interference_data.tables import Column, Table, percent

__all__ = ["Cell", "MainGrid", "Part", "cells_by", "coverage_table", "main_grids", "main_markdown"]
__all__ += ["main_note", "rate_table"]

Part = Literal["", "family", "difficulty"]

NOTE = (
    "Rates with 95% Wilson intervals. n is the number of episodes that count: an error is neither "
    "success nor failure. A cell marked † lacks episodes, or has others than the grid, and is not "
    "ranked; one without any rollout is missing."
)


@dataclass(frozen=True)
class Cell:
    """What came of one system under one condition, in all or in a part of the episodes.

    Attributes:
        simulator: Name of the simulator.
        system: Name of the system.
        condition: Name of the condition.
        part: Family or difficulty; empty for all episodes.
        n: Episodes that count: at least one rollout that is no error.
        rate: Mean over them of the success of their repeats; NaN if n is 0.
        counts: Rollouts by status, as `STATUSES`.
        missing: Expected episodes that do not count with every model seed of the condition.
        other: Episodes that count without being expected.
        rank: Place among the complete cells of this simulator, condition and part, 1 for the
            highest rate; None for an incomplete cell, and for a system that is a bound.
    """

    simulator: str
    system: str
    condition: str
    part: str
    n: int
    rate: float
    counts: tuple[int, int, int, int]
    missing: int
    other: int
    rank: int | None = None

    @property
    def complete(self) -> bool:
        """Whether exactly the expected episodes count, with every model seed."""
        return self.n > 0 and not self.missing and not self.other

    @property
    def interval(self) -> tuple[float, float]:
        """95% Wilson interval; `(0, 1)` if n is 0."""
        return wilson(0 if self.n == 0 else self.rate * self.n, self.n)


def cells_by(
    outcomes: Sequence[Outcomes], expected: Mapping[str, Expected], part: Part = ""
) -> list[Cell]:
    """Return the cells of every system and condition.

    Args:
        outcomes: By system and simulator.
        expected: Simulator to its cells, and to the episodes of a complete one.
        part: `family` or `difficulty` for a cell of each; empty for all episodes together, where
            expected cells without any rollout come as well. An expected episode of unknown
            difficulty is missing in all three.
    """
    cells: list[Cell] = []
    for given in outcomes:
        wanted = expected[given.simulator]
        one = given if part else given.filled(wanted.conditions_of(given))
        parts = _parts(part, one, unknown=False)
        wanted_parts = _parts(part, wanted, unknown=True)
        for place, condition in enumerate(one.conditions):
            counts = one.scored[place] > 0
            whole = one.episodes[counts & one.whole[place]]
            missing = ~np.isin(wanted.episodes, whole, assume_unique=True)
            other = counts & ~np.isin(one.episodes, wanted.episodes, assume_unique=True)
            for name, here in parts.items():
                if not here.any() and not wanted_parts[name].any():
                    continue
                rates = one.rates[place][here & counts]
                cells.append(
                    Cell(
                        one.simulator,
                        one.system,
                        condition,
                        name,
                        len(rates),
                        float(rates.sum() / len(rates)) if len(rates) else math.nan,
                        tuple(one.counts[place][here].sum(axis=0).tolist()),
                        int((wanted_parts[name] & missing).sum()),
                        int((here & other).sum()),
                    )
                )
    return _ranked(cells)


def _parts(part: Part, what: Outcomes | Expected, unknown: bool) -> dict[str, NDArray[np.bool_]]:
    if part == "family":
        return {name: what.families == place for place, name in enumerate(FAMILIES)}
    if part == "difficulty":
        also = (what.difficulty < 0) & unknown
        return {n: (what.difficulty == p) | also for p, n in enumerate(DIFFICULTIES)}
    return {"": np.ones(len(what.episodes), bool)}


def _ranked(cells: list[Cell]) -> list[Cell]:
    rates: dict[tuple[str, str, str], list[float]] = {}
    for cell in cells:
        if _takes_part(cell):
            rates.setdefault((cell.simulator, cell.condition, cell.part), []).append(cell.rate)
    return [
        replace(cell, rank=1 + sum(rate > cell.rate for rate in rates[key]))
        if _takes_part(cell) and (key := (cell.simulator, cell.condition, cell.part))
        else cell
        for cell in cells
    ]


def _takes_part(cell: Cell) -> bool:
    return cell.complete and not is_bound(cell.system)


def rate_table(cells: Sequence[Cell], name: str, title: str, part: Part = "") -> Table:
    """Return cells as a table, a row each."""
    columns = [Column("simulator"), Column("system"), Column("condition")]
    columns += [Column(part)] if part else []
    columns += [Column("n", "count")]
    columns += [Column(bound, "rate") for bound in ("rate", "low", "high")]
    columns += [Column(name, "count") for name in ("successes", "fails", "timeouts", "errors")]
    columns += [Column("complete", "flag"), Column("missing", "count"), Column("rank", "count")]
    rows = []
    for cell in cells:
        low, high = cell.interval if cell.n else (math.nan, math.nan)
        own = [cell.simulator, cell.system, cell.condition] + ([cell.part] if part else [])
        rates = (cell.n, cell.rate, low, high, *cell.counts)
        rows.append((*own, *rates, cell.complete, cell.missing, cell.rank))
    return Table(name, title, tuple(columns), tuple(rows), NOTE)


@dataclass(frozen=True)
class MainGrid:
    """The paper's main table of one simulator: a row per system, a column per condition.

    Attributes:
        simulator: Name of the simulator.
        conditions: Heads of the columns.
        rows: Display name of a system, and its text under each condition. Between `**` stands the
            highest rate of each condition among several complete cells, bold as in the paper.
    """

    simulator: str
    conditions: tuple[str, ...]
    rows: tuple[tuple[str, tuple[str, ...]], ...]


def main_grids(cells: Sequence[Cell]) -> list[MainGrid]:
    """Return the paper's main table for each simulator."""
    grids = []
    for simulator in dict.fromkeys(cell.simulator for cell in cells):
        found = [cell for cell in cells if cell.simulator == simulator]
        conditions = tuple(sorted({cell.condition for cell in found}, key=condition_rank))
        at = {(cell.system, cell.condition): cell for cell in found}
        several = {c: sum(a.condition == c and a.complete for a in found) > 1 for c in conditions}
        rows = (
            (
                display_name(system),
                tuple(_shown(at.get((system, c)), several[c]) for c in conditions),
            )
            for system in dict.fromkeys(cell.system for cell in found)
        )
        grids.append(MainGrid(simulator, conditions, tuple(rows)))
    return grids


def main_markdown(cells: Sequence[Cell]) -> str:
    """Return the paper's main table in Markdown."""
    lines = []
    for grid in main_grids(cells):
        lines += [
            f"| {grid.simulator} | {' | '.join(grid.conditions)} |",
            "| --- |" + " --- |" * len(grid.conditions),
            *(f"| {system} | {' | '.join(shown)} |" for system, shown in grid.rows),
            "",
        ]
    return "\n".join([*lines, main_note(cells)]) + "\n"


def main_note(cells: Sequence[Cell]) -> str:
    """Return how the main table is to be read, and how many rollouts broke."""
    errors = sum(cell.counts[ERROR] for cell in cells)
    names = dict.fromkeys(display_name(cell.system) for cell in cells if is_bound(cell.system))
    bounds = f" Not ranked either, as they use no memory: {', '.join(names)}." if names else ""
    return NOTE + bounds + (f" Rollouts that broke: {errors}." if errors else " No rollout broke.")


def _shown(cell: Cell | None, several: bool) -> str:
    if cell is None:
        return "–"
    errors = f", errors: {cell.counts[ERROR]}" if cell.counts[ERROR] else ""
    if not cell.n:
        return f"no result†{errors}" if any(cell.counts) else "missing†"
    low, high = cell.interval
    rate = f"**{percent(cell.rate)}**" if several and cell.rank == 1 else percent(cell.rate)
    mark = "" if cell.complete else "†"
    return f"{rate}{mark} [{100 * low:.1f}, {100 * high:.1f}] n={cell.n}{errors}"


def coverage_table(outcomes: Sequence[Outcomes], expected: Mapping[str, Expected]) -> Table:
    """Return which episodes each cell of a family lacks, and in which the rollout broke.

    Expected cells without any rollout are listed as well: they lack all episodes.
    """
    columns = [Column(name) for name in ("simulator", "system", "condition", "family")]
    columns += [Column(name, "count") for name in ("expected", "n", "errors")]
    columns += [Column("complete", "flag"), Column("missing_episodes"), Column("error_episodes")]
    columns += [Column("other_episodes")]
    rows = []
    for given in outcomes:
        wanted = expected[given.simulator]
        one = given.filled(wanted.conditions_of(given))
        for place, condition in enumerate(one.conditions):
            counts = one.scored[place] > 0
            broke = one.counts[place, :, ERROR] > 0
            whole = one.episodes[counts & one.whole[place]]
            for rank, family in enumerate(FAMILIES):
                here = one.families == rank
                due = wanted.episodes[wanted.families == rank]
                if not len(due) and not here.any():
                    continue
                missing = np.setdiff1d(due, whole, assume_unique=True)
                other = np.setdiff1d(one.episodes[here & counts], due, assume_unique=True)
                n, errors = int((here & counts).sum()), int(one.counts[place, here, ERROR].sum())
                lists = (missing, one.episodes[here & broke], other)
                complete = n > 0 and not len(missing) and not len(other)
                rows.append(
                    (
                        *(one.simulator, one.system, condition, family),
                        *(len(due), n, errors, complete),
                        *map(_spans, lists),
                    )
                )
    note = (
        "Episodes by split and index. An episode counts if one of its rollouts is no error. With "
        "repeats, one that does not count with every model seed of the condition is missing."
    )
    return Table("coverage", "Which episodes count", tuple(columns), tuple(rows), note)


def _spans(episodes: NDArray[np.int64]) -> str:
    """Return packed episodes of one family as text, such as `test 0-3 7`."""
    spans: dict[str, list[list[int]]] = {}
    for episode in map(episode_id, episodes.tolist()):
        known = spans.setdefault(episode.split, [])
        if known and known[-1][1] == episode.index - 1:
            known[-1][1] = episode.index
        else:
            known.append([episode.index, episode.index])
    return "; ".join(
        f"{split} " + " ".join(f"{a}" if a == b else f"{a}-{b}" for a, b in found)
        for split, found in spans.items()
    )
