"""Rates of cells: system × condition, and the same by family and by difficulty."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from robomme_interference_data.conditions import in_order
from robomme_interference_data.constants import DIFFICULTIES, FAMILIES
from robomme_interference_data.evaluate.score.cube import STATUSES, Cube, Flags, success
from robomme_interference_data.evaluate.systems import display_name, is_bound
from robomme_interference_data.ids import EpisodeId, format_numbers
from robomme_interference_data.records import Status
from robomme_interference_data.stats import wilson
from robomme_interference_data.tables import Column, Table, percent

__all__ = ["Cell", "cells_of", "coverage_table", "main_grids", "rate_table"]

_ERROR = STATUSES.index(Status.ERROR)
_NOTE = (
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
    counts: tuple[int, ...]
    missing: int
    other: int
    rank: int | None = None

    @property
    def complete(self) -> bool:
        """Whether exactly the expected episodes count, with every model seed."""
        return self.n > 0 and not self.missing and not self.other

    @property
    def errors(self) -> int:
        """Rollouts that broke."""
        return self.counts[_ERROR]

    @property
    def interval(self) -> tuple[float, float]:
        """95% Wilson interval; `(0, 1)` if n is 0."""
        return wilson(self.rate * self.n if self.n else 0, self.n)


def cells_of(cubes: Iterable[Cube]) -> list[Cell]:
    """Return the cells of every system and condition, in the order of tables.

    Each comes over all episodes, then, if it has rows, by family and by difficulty. An expected
    episode of unknown difficulty is missing in all three.
    """
    cells = []
    for cube in cubes:
        rates = success(cube.status)
        every: Flags = np.ones(len(cube.episodes), bool)
        unknown: Flags = cube.difficulty < 0
        parts = [("", every, every)]  # name, its episodes, and those that are expected in it
        parts += [(name, here, here) for name in FAMILIES if (here := cube.of_family(name)).any()]
        for place, name in enumerate(DIFFICULTIES):
            here = cube.difficulty == place
            parts.append((name, here, here | unknown))
        for s, c in np.argwhere(cube.due).tolist():
            for name, here, wanted in parts if cube.has_rows[s, c] else parts[:1]:
                if not ((here & cube.there[s]) | (wanted & cube.expected)).any():
                    continue
                known = rates[s, c][here & cube.counted[s, c]]
                cells.append(
                    Cell(
                        cube.simulator,
                        cube.systems[s],
                        cube.conditions[c],
                        name,
                        len(known),
                        float(known.sum() / len(known)) if len(known) else math.nan,
                        tuple(cube.counts[s, c, here].sum(axis=0).tolist()),
                        int((wanted & cube.missing[s, c]).sum()),
                        int((here & cube.other[s, c]).sum()),
                    )
                )
    return _ranked(cells)


def _ranked(cells: Sequence[Cell]) -> list[Cell]:
    rates: dict[tuple[str, str, str], list[float]] = {}
    places = []
    for cell in cells:
        group = rates.setdefault((cell.simulator, cell.condition, cell.part), [])
        places.append(group if cell.complete and not is_bound(cell.system) else None)
        group += [cell.rate] if places[-1] is not None else []
    return [
        cell if group is None else replace(cell, rank=1 + sum(rate > cell.rate for rate in group))
        for cell, group in zip(cells, places, strict=True)
    ]


def rate_table(cells: Iterable[Cell], name: str, title: str, parts: Sequence[str] = ()) -> Table:
    """Return cells as a table, a row each: of all episodes, or by the parts that give its name."""
    rows = []
    for cell in cells:
        if cell.part in (parts or ("",)):
            own = (cell.simulator, cell.system, cell.condition, *([cell.part] if parts else []))
            bounds = cell.interval if cell.n else (math.nan, math.nan)
            more = (cell.complete, cell.missing, cell.rank)
            rows.append((*own, cell.n, cell.rate, *bounds, *cell.counts, *more))
    return Table.make(
        name,
        title,
        f"simulator system condition {name if parts else ''} n:count rate:rate low:rate high:rate "
        "successes:count fails:count timeouts:count errors:count complete:flag missing:count "
        "rank:count",
        rows,
        _NOTE,
    )


def main_grids(cells: Sequence[Cell]) -> list[Table]:
    """Return the paper's main table of each simulator: a row per system, a column per condition.

    Bold (between `**`) is the highest rate of each condition among several complete cells, as in
    the paper.
    """
    grids = []
    whole = [cell for cell in cells if not cell.part]
    for simulator, group in groupby(whole, lambda cell: cell.simulator):
        found = list(group)
        conditions = [one.name for one in in_order({cell.condition for cell in found})]
        at = {(cell.system, cell.condition): cell for cell in found}
        several = {c: sum(a.condition == c and a.complete for a in found) > 1 for c in conditions}
        rows = (
            (display_name(system), *(_shown(at.get((system, c)), several[c]) for c in conditions))
            for system in dict.fromkeys(cell.system for cell in found)
        )
        errors = sum(cell.errors for cell in found)
        bounds = dict.fromkeys(display_name(c.system) for c in found if is_bound(c.system))
        note = _NOTE
        note += f" Not ranked either, as they use no memory: {', '.join(bounds)}." * bool(bounds)
        note += f" Rollouts that broke: {errors}." if errors else " No rollout broke."
        columns = (Column("system"), *map(Column, conditions))
        title = f"Success by system and condition, {simulator}"
        grids.append(Table(simulator, title, columns, tuple(rows), note))
    return grids


def _shown(cell: Cell | None, bold: bool) -> str:
    if cell is None:
        return "–"
    errors = f", errors: {cell.errors}" if cell.errors else ""
    if not cell.n:
        return f"no result†{errors}" if any(cell.counts) else "missing†"
    low, high = cell.interval
    rate = f"**{percent(cell.rate)}**" if bold and cell.rank == 1 else percent(cell.rate)
    mark = "" if cell.complete else "†"
    return f"{rate}{mark} [{100 * low:.1f}, {100 * high:.1f}] n={cell.n}{errors}"


def coverage_table(cubes: Iterable[Cube]) -> Table:
    """Return which episodes each cell of a family lacks, and in which the rollout broke.

    Expected cells without any rollout are listed as well: they lack all episodes.
    """
    rows = []
    for cube in cubes:
        families = [(name, here) for name in FAMILIES if (here := cube.of_family(name)).any()]
        for s, c in np.argwhere(cube.due).tolist():
            for family, here in families:
                if not (here & (cube.expected | cube.there[s])).any():
                    continue
                n, due = int((here & cube.counted[s, c]).sum()), int((here & cube.expected).sum())
                errors = cube.counts[s, c, :, _ERROR] * here
                missing, other = cube.missing[s, c] & here, cube.other[s, c] & here
                complete = n > 0 and not (missing | other).any()
                lists = (_numbers(cube.episodes, flags) for flags in (missing, errors > 0, other))
                own = (cube.simulator, cube.systems[s], cube.conditions[c], family)
                rows.append((*own, due, n, int(errors.sum()), complete, *lists))
    return Table.make(
        "coverage",
        "Which episodes count",
        "simulator system condition family expected:count n:count errors:count complete:flag "
        "missing_episodes error_episodes other_episodes",
        rows,
        "Episodes by split and index. An episode counts if one of its rollouts is no error. With "
        "repeats, one that does not count with every model seed of the condition is missing.",
    )


def _numbers(episodes: Sequence[EpisodeId], chosen: Flags) -> str:
    """Return episodes of one family as text, such as `test 0-3,7`."""
    found: dict[str, list[int]] = {}
    for place in np.flatnonzero(chosen).tolist():
        found.setdefault(episodes[place].split, []).append(episodes[place].index)
    return "; ".join(f"{split} {format_numbers(indices)}" for split, indices in found.items())
