"""Rates of cells: system × condition, and the same by family and by difficulty."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any

import numpy as np

from robomme_interference_data.constants import DIFFICULTIES
from robomme_interference_data.evaluate.score.comparisons.ranks import all_pairs, tied_with_best
from robomme_interference_data.evaluate.score.comparisons.tables import columns_of
from robomme_interference_data.evaluate.score.outcomes import (
    STATUSES,
    Flags,
    Outcomes,
    Rate,
    rate_of,
)
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.ids import EpisodeId, format_numbers
from robomme_interference_data.schema.conditions import in_order
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.stats.intervals import wilson
from robomme_interference_data.stats.strata import stratified_n
from robomme_interference_data.viz.tables import Table, percent

_FAIL, _ERROR = (np.int8(STATUSES.index(one)) for one in (Status.FAIL, Status.ERROR))
_NOTE = (
    "Rates with 95% Wilson intervals. n: episodes that count; an error is neither success nor "
    "failure. †: the cell lacks episodes, or has episodes outside the grid, and is not ranked; a "
    "cell without any rollout is missing."
)
_ERRORS = (
    " if errors fail: the rate if every error were a failure, the least that it can be if errors "
    "depend on the outcome."
)
_BEST = (
    " Best (bold, in text *): above zero, and no other system is significantly better, by p after "
    "Holm's correction over all pairs of systems."
)
_FIXED = (
    " fixed low to fixed high: Wilson's interval for other episodes of the same families in the "
    "same numbers, narrower because the families' rates differ."
)

NOT_EXPECTED = "n/a"
"""A cell of a grid that nobody expects, unlike a missing one."""


@dataclass(frozen=True)
class Coverage:
    """Which episodes count of one system under one condition, in all or some of the episodes."""

    simulator: str
    system: str
    condition: str
    part: str  # family or difficulty; empty for all episodes
    n: int  # episodes that count: at least one rollout that is not an error
    reference: bool = field(default=False, kw_only=True)  # the system is never ranked
    counts: tuple[int, ...] = field(default=(0,) * len(STATUSES), kw_only=True)  # by status
    expected: int = field(default=0, kw_only=True)  # number of expected episodes
    # Expected, but do not count with every model seed.
    missing: Sequence[EpisodeId] = field(default=(), kw_only=True)
    broken: Sequence[EpisodeId] = field(default=(), kw_only=True)  # with an error
    other: Sequence[EpisodeId] = field(default=(), kw_only=True)  # count without being expected

    @property
    def part_of(self) -> str:
        """The table of its row: `main`, `family` or `difficulty`."""
        if self.part in ("", *DIFFICULTIES):
            return "difficulty" if self.part else "main"
        return "family"

    @property
    def complete(self) -> bool:
        """Whether exactly the expected episodes count, with every model seed."""
        return self.n > 0 and not self.missing and not self.other

    @property
    def errors(self) -> int:
        """The number of errors."""
        return self.counts[_ERROR]

    @property
    def mark(self) -> str:
        """† if the cell is not complete."""
        return "" if self.complete else "†"


@dataclass(frozen=True)
class Cell(Coverage):
    """The success rate of one system under one condition, in all or some of the episodes."""

    rate: float  # mean over them of the success of their repeats; NaN if n is 0
    interval: tuple[float, float]  # 95% Wilson; (0, 1) if n is 0
    trials: float  # effective number of independent trials: n, and more with repeats
    fixed: tuple[float, float] = (math.nan, math.nan)  # interval for just these families
    if_errors_fail: float = math.nan  # rate if every error were a failure; NaN without rollouts
    chance: float = math.nan  # mean success of guessing; NaN unless all episodes are questions
    rank: int | None = None  # among complete cells, 1 for the highest rate; None for references
    best: bool = False  # one of several, and no other one is significantly better

    @property
    def as_rate(self) -> Rate:
        """Its rate, for comparisons."""
        return Rate(self.n, self.rate, self.trials)


def coverage_of(
    outcomes: Outcomes, system: int, condition: int, here: Flags, due: Flags
) -> dict[str, Any]:
    """Return what is counted of a cell: its episodes `here`, those expected in it are `due`."""
    counts = outcomes.counts[system, condition]
    return {
        "reference": outcomes.is_reference(outcomes.systems[system]),
        "counts": tuple(counts[here].sum(axis=0).tolist()),
        "expected": int((due & outcomes.expected).sum()),
        "missing": outcomes.chosen(due & outcomes.missing[system, condition]),
        "broken": outcomes.chosen(here & (counts[:, _ERROR] > 0)),
        "other": outcomes.chosen(here & outcomes.other[system, condition]),
    }


def cells_of(every: Iterable[Outcomes]) -> list[Cell]:
    """Return the cells of every system and condition, in the order of tables.

    Each cell is followed by its parts by family and by difficulty. An expected episode of unknown
    difficulty is missing in all three difficulties.
    """
    return [cell for outcomes in every for cell in _cells(outcomes)]


def _cells(outcomes: Outcomes) -> list[Cell]:
    every: Flags = np.ones(len(outcomes.episodes), bool)
    parts = {"": (every, every)}  # name to its episodes, and to those that are expected in it
    parts |= {
        name: (here, here) for name in outcomes.families for here in [outcomes.of_family(name)]
    }
    for place, name in enumerate(DIFFICULTIES):
        here = outcomes.difficulty == place
        parts[name] = (here, here | (outcomes.difficulty < 0))
    cells = []
    for s, c in np.argwhere(outcomes.due).tolist():
        for name, (here, due) in parts.items():
            if not ((here & outcomes.has_episode[s]) | (due & outcomes.expected)).any():
                continue
            counted = here & outcomes.counted[s, c]
            status = outcomes.status[s, c, here]
            rate = rate_of(status)
            names = (outcomes.simulator, outcomes.systems[s], outcomes.conditions[c], name)
            cells.append(
                Cell(
                    *(*names, rate.n, rate.value, rate.interval, rate.trials),
                    fixed=(math.nan, math.nan) if name else _fixed(outcomes, s, c, rate),
                    if_errors_fail=rate_of(np.where(status == _ERROR, _FAIL, status)).value,
                    chance=float(outcomes.chance[counted].mean()) if rate.n else math.nan,
                    **coverage_of(outcomes, s, c, here, due),
                )
            )
    return _ranked(outcomes, cells, {name: here for name, (here, _) in parts.items()})


def _fixed(outcomes: Outcomes, system: int, condition: int, rate: Rate) -> tuple[float, float]:
    """Return the interval of a rate for its families as fixed strata; none for one family."""
    status = outcomes.status[system, condition]
    parts = [rate_of(status[outcomes.of_family(name)]) for name in outcomes.families]
    parts = [part for part in parts if part.n]
    if len(parts) < 2:
        return math.nan, math.nan
    n = np.array([part.n for part in parts], float)
    trials = stratified_n(n * [part.value for part in parts], n)
    trials *= rate.trials / rate.n
    return wilson(rate.value * trials, trials)


def _ranked(outcomes: Outcomes, cells: list[Cell], parts: Mapping[str, Flags]) -> list[Cell]:
    groups = defaultdict[tuple[str, str], list[int]](list)
    for place, cell in enumerate(cells):
        if cell.complete and not cell.reference:
            groups[cell.condition, cell.part].append(place)
    for (condition, part), places in groups.items():
        group = [cells[place] for place in places]
        systems = [cell.system for cell in group]
        best = tied_with_best(systems, all_pairs(outcomes, condition, systems, parts[part]))
        for place, cell in zip(places, group, strict=True):
            rank = 1 + sum(other.rate > cell.rate for other in group)
            cells[place] = replace(cell, rank=rank, best=cell.system in best and cell.rate > 0)
    return cells


def rate_table(cells: Sequence[Cell], name: str) -> Table:
    """Return the table `main`, a row per cell, or of cells with rollouts `family`, `difficulty`."""
    parts = name in ("family", "difficulty")
    ran = {(c.simulator, c.system, c.condition) for c in cells if any(c.counts)}
    rows = []
    for cell in cells:
        key: tuple[str, ...] = (cell.simulator, cell.system, cell.condition)
        if cell.part_of == name and not (parts and key not in ran):
            key += (cell.part,) if parts else ()
            bounds = cell.interval if cell.n else (math.nan, math.nan)
            fixed = () if parts else (*cell.fixed, cell.if_errors_fail)
            more = (cell.complete, len(cell.missing), cell.rank, cell.best)
            rows.append((*key, cell.n, cell.rate, *bounds, *fixed, *cell.counts[:4], *more))
    return Table(
        name,
        f"Success by {name if parts else 'system and condition'}",
        columns_of(
            f"simulator system condition {name if parts else ''} n:count rate:rate low:rate "
            "high:rate "
            f"{'' if parts else 'fixed_low:rate fixed_high:rate if_errors_fail:rate '}"
            "successes:count fails:count timeouts:count errors:count complete:flag missing:count "
            "rank:count best:flag"
        ),
        rows,
        _NOTE + _BEST + (_FIXED + _ERRORS) * (not parts),
    )


def main_grids(cells: Sequence[Cell]) -> list[Table]:
    """Return the paper's main table of each simulator: a row per system, a column per condition.

    The best of a condition (see `Cell.best`) are bold, between `**`. If all rates have the same n,
    only the note states it.
    """
    grids: list[Table] = []
    whole = [cell for cell in cells if not cell.part]
    for simulator, group in groupby(whole, lambda cell: cell.simulator):
        found = list(group)
        conditions = [one.name for one in in_order({cell.condition for cell in found})]
        at = {(cell.system, cell.condition): cell for cell in found}
        episodes = {cell.n for cell in found if cell.n}
        several = len(episodes) > 1
        rows = [
            (display_name(system), *(_shown(at.get((system, c)), several) for c in conditions))
            for system in dict.fromkeys(cell.system for cell in found)
        ]
        errors = sum(cell.errors for cell in found)
        references = dict.fromkeys(display_name(c.system) for c in found if c.reference)
        notes = [] if several or not episodes else [f"n = {episodes.pop()} in each cell."]
        if not grids:  # once for all grids
            notes.append(_NOTE + _BEST * any(cell.best for cell in whole))
        if any(NOT_EXPECTED in row for row in rows):
            notes.append(
                f"{NOT_EXPECTED}: the condition does not apply to the system, or is not expected."
            )
        if references:
            notes.append(f"References, not ranked: {', '.join(references)}.")
        if chances := [cell.chance for cell in found if not math.isnan(cell.chance)]:
            levels = dict.fromkeys(percent(one(chances)) for one in (min, max))
            notes.append(f"Guessing succeeds in {' to '.join(levels)}: see the table chance.")
        notes.append(f"Errors: {errors}." if errors else "No errors.")
        note = " ".join(notes)
        title = f"Success by system and condition, {simulator}"
        grids.append(
            Table(simulator, title, dict.fromkeys(["system", *conditions], "text"), rows, note)
        )
    return grids


def _shown(cell: Cell | None, with_n: bool) -> str:
    if cell is None:
        return NOT_EXPECTED
    errors = f", errors: {cell.errors}" if cell.errors else ""
    if not cell.n:
        return f"no result†{errors}" if any(cell.counts) else "missing†"
    low, high = cell.interval
    rate = f"**{percent(cell.rate)}**" if cell.best else percent(cell.rate)
    n = f" n={cell.n}" if with_n else ""
    return f"{rate}{cell.mark} [{100 * low:.1f}, {100 * high:.1f}]{n}{errors}"


def coverage_table(cells: Iterable[Coverage]) -> Table:
    """Return which episodes each cell of a family lacks, and which have errors."""
    rows = [
        (
            *(cell.simulator, cell.system, cell.condition, cell.part, cell.expected, cell.n),
            *(cell.errors, cell.complete),
            *map(_numbers, (cell.missing, cell.broken, cell.other)),
        )
        for cell in cells
        if cell.part_of == "family"
    ]
    return Table(
        "coverage",
        "Which episodes count",
        {
            "simulator": "text",
            "system": "text",
            "condition": "text",
            "family": "text",
            "expected": "count",
            "n": "count",
            "errors": "count",
            "complete": "flag",
            "missing_episodes": "text",
            "error_episodes": "text",
            "other_episodes": "text",
        },
        rows,
        "Episodes by split and index. An episode counts if one of its rollouts is not an error. "
        "With repeats, one that does not count with every model seed of the condition is missing.",
    )


def _numbers(episodes: Iterable[EpisodeId]) -> str:
    """Return episodes of one family as text, such as `test 0-3,7`."""
    found: dict[str, list[int]] = {}
    for one in episodes:
        found.setdefault(one.split, []).append(one.index)
    return "; ".join(f"{split} {format_numbers(indices)}" for split, indices in found.items())
