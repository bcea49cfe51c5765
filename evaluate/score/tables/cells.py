"""Rates of cells: system × condition, and the same by family and by difficulty."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from robomme_interference_data.constants import DIFFICULTIES, FAMILIES
from robomme_interference_data.evaluate.score.comparisons.ranks import tied_with_best, to_best
from robomme_interference_data.evaluate.score.outcomes import (
    STATUSES,
    Flags,
    Outcomes,
    Rate,
    rate_of,
)
from robomme_interference_data.evaluate.systems import display_name, is_bound
from robomme_interference_data.ids import EpisodeId, format_numbers
from robomme_interference_data.schema.conditions import in_order
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.viz.tables import Table, percent

_ERROR = STATUSES.index(Status.ERROR)
_NOTE = (
    "Rates with 95% Wilson intervals. n is the number of episodes that count: an error is neither "
    "success nor failure. A cell marked † lacks episodes, or has others than the grid, and is not "
    "ranked; one without any rollout is missing."
)
_BEST = (
    " Best, and bold, is each of several that cannot be told from the highest rate: its p against "
    "that one, corrected by Holm's method over the others, is 0.05 or more."
)


@dataclass(frozen=True)
class Cell:
    """What came of one system under one condition, in all or in a part of the episodes.

    Attributes:
        simulator, system, condition: Their names.
        part: Family or difficulty; empty for all episodes.
        n: Episodes that count: at least one rollout that is no error.
        rate: Mean over them of the success of their repeats; NaN if n is 0.
        interval: Its 95% Wilson interval; `(0, 1)` if n is 0.
        trials: How many independent ones the rate is worth: n, and with repeats more.
        counts: Rollouts by status, as `STATUSES`.
        chance: Mean over them of the share of right answers that guessing has; NaN unless each is
            a question.
        expected: How many episodes are expected.
        missing: Those that do not count with every model seed of the condition.
        broken: Episodes in which a rollout broke.
        other: Episodes that count without being expected.
        rank: Place among the complete cells of this simulator, condition and part, 1 for the
            highest rate; None for an incomplete cell, and for a system that is a bound.
        best: Whether it is among several ranked cells and cannot be told from the best of them:
            it is the first of the highest rate, or Holm's p against that one, corrected over the
            others, is 0.05 or more.
    """

    simulator: str
    system: str
    condition: str
    part: str
    n: int
    rate: float
    interval: tuple[float, float]
    trials: float
    counts: tuple[int, ...] = (0,) * len(STATUSES)
    chance: float = math.nan
    expected: int = 0
    missing: Sequence[EpisodeId] = ()
    broken: Sequence[EpisodeId] = ()
    other: Sequence[EpisodeId] = ()
    rank: int | None = None
    best: bool = False

    @property
    def as_rate(self) -> Rate:
        """Its rate, to be compared with another."""
        return Rate(self.n, self.rate, self.trials)

    @property
    def complete(self) -> bool:
        """Whether exactly the expected episodes count, with every model seed."""
        return self.n > 0 and not self.missing and not self.other

    @property
    def errors(self) -> int:
        """Rollouts that broke."""
        return self.counts[_ERROR]


def cells_of(every: Iterable[Outcomes]) -> list[Cell]:
    """Return the cells of every system and condition, in the order of tables.

    Each comes over all episodes, then by family and by difficulty. An expected episode of unknown
    difficulty is missing in all three.
    """
    return [cell for outcomes in every for cell in _cells(outcomes)]


def _cells(outcomes: Outcomes) -> list[Cell]:
    every: Flags = np.ones(len(outcomes.episodes), bool)
    parts = {"": (every, every)}  # name to its episodes, and to those that are expected in it
    parts |= {name: (here, here) for name in FAMILIES if (here := outcomes.of_family(name)).any()}
    for place, name in enumerate(DIFFICULTIES):
        here = outcomes.difficulty == place
        parts[name] = (here, here | (outcomes.difficulty < 0))
    cells = []
    for s, c in np.argwhere(outcomes.due).tolist():
        for name, (here, wanted) in parts.items():
            if not ((here & outcomes.there[s]) | (wanted & outcomes.expected)).any():
                continue
            counted, counts = here & outcomes.counted[s, c], outcomes.counts[s, c]
            rate = rate_of(outcomes.status[s, c, here])
            names = (outcomes.simulator, outcomes.systems[s], outcomes.conditions[c], name)
            cells.append(
                Cell(
                    *(*names, rate.n, rate.value, rate.interval, rate.trials),
                    counts=tuple(counts[here].sum(axis=0).tolist()),
                    chance=float(outcomes.chance[counted].mean()) if rate.n else math.nan,
                    expected=int((wanted & outcomes.expected).sum()),
                    missing=outcomes.chosen(wanted & outcomes.missing[s, c]),
                    broken=outcomes.chosen(here & (counts[:, _ERROR] > 0)),
                    other=outcomes.chosen(here & outcomes.other[s, c]),
                )
            )
    return _ranked(outcomes, cells, {name: here for name, (here, _) in parts.items()})


def _ranked(outcomes: Outcomes, cells: list[Cell], parts: Mapping[str, Flags]) -> list[Cell]:
    groups = defaultdict[tuple[str, str], list[int]](list)
    for place, cell in enumerate(cells):
        if cell.complete and not is_bound(cell.system):
            groups[cell.condition, cell.part].append(place)
    for (condition, part), places in groups.items():
        own = [cells[place] for place in places]
        systems = [cell.system for cell in own]
        best = tied_with_best(*to_best(outcomes, condition, systems, parts[part]))
        for place, cell in zip(places, own, strict=True):
            rank = 1 + sum(other.rate > cell.rate for other in own)
            cells[place] = replace(cell, rank=rank, best=cell.system in best)
    return cells


def rate_table(cells: Sequence[Cell], name: str) -> Table:
    """Return cells as the table `main`, a row each, or their parts as `family` or `difficulty`.

    Parts are shown of those that have any rollout.
    """
    parts = {"family": FAMILIES, "difficulty": DIFFICULTIES}.get(name, ())
    ran = {(c.simulator, c.system, c.condition) for c in cells if any(c.counts)}
    rows = []
    for cell in cells:
        own: tuple[str, ...] = (cell.simulator, cell.system, cell.condition)
        if cell.part in (parts or ("",)) and not (parts and own not in ran):
            own += (cell.part,) if parts else ()
            bounds = cell.interval if cell.n else (math.nan, math.nan)
            more = (cell.complete, len(cell.missing), cell.rank, cell.best)
            rows.append((*own, cell.n, cell.rate, *bounds, *cell.counts, *more))
    return Table.make(
        name,
        f"Success by {name if parts else 'system and condition'}",
        f"simulator system condition {name if parts else ''} n:count rate:rate low:rate high:rate "
        "successes:count fails:count timeouts:count errors:count complete:flag missing:count "
        "rank:count best:flag",
        rows,
        _NOTE + _BEST,
    )


def main_grids(cells: Sequence[Cell]) -> list[Table]:
    """Return the paper's main table of each simulator: a row per system, a column per condition.

    Bold (between `**`) is what cannot be told from the best of its condition (see `Cell.best`).
    The n that all rates have is told once, in the note; else each has its own.
    """
    grids = []
    whole = [cell for cell in cells if not cell.part]
    for simulator, group in groupby(whole, lambda cell: cell.simulator):
        found = list(group)
        conditions = [one.name for one in in_order({cell.condition for cell in found})]
        at = {(cell.system, cell.condition): cell for cell in found}
        episodes = {cell.n for cell in found if cell.n}
        several = len(episodes) > 1
        rows = (
            (display_name(system), *(_shown(at.get((system, c)), several) for c in conditions))
            for system in dict.fromkeys(cell.system for cell in found)
        )
        errors = sum(cell.errors for cell in found)
        bounds = dict.fromkeys(display_name(c.system) for c in found if is_bound(c.system))
        note = _NOTE if several or not episodes else f"n = {episodes.pop()} in each cell. {_NOTE}"
        note += _BEST * any(cell.best for cell in found)
        note += f" Not ranked either, as they only show bounds: {', '.join(bounds)}." * bool(bounds)
        chances = [cell.chance for cell in found if not math.isnan(cell.chance)]
        if chances:
            levels = dict.fromkeys(percent(one(chances)) for one in (min, max))
            note += f" Guessing would have {' to '.join(levels)}: see the table chance."
        note += f" Rollouts that broke: {errors}." if errors else " No rollout broke."
        title = f"Success by system and condition, {simulator}"
        grids.append(Table.make(simulator, title, " ".join(["system", *conditions]), rows, note))
    return grids


def _shown(cell: Cell | None, with_n: bool) -> str:
    if cell is None:
        return "–"
    errors = f", errors: {cell.errors}" if cell.errors else ""
    if not cell.n:
        return f"no result†{errors}" if any(cell.counts) else "missing†"
    low, high = cell.interval
    rate = f"**{percent(cell.rate)}**" if cell.best else percent(cell.rate)
    mark = "" if cell.complete else "†"
    n = f" n={cell.n}" if with_n else ""
    return f"{rate}{mark} [{100 * low:.1f}, {100 * high:.1f}]{n}{errors}"


def coverage_table(cells: Iterable[Cell]) -> Table:
    """Return which episodes each cell of a family lacks, and in which the rollout broke.

    Expected cells without any rollout are listed as well: they lack all episodes.
    """
    rows = (
        (
            *(cell.simulator, cell.system, cell.condition, cell.part, cell.expected, cell.n),
            *(cell.errors, cell.complete),
            *map(_numbers, (cell.missing, cell.broken, cell.other)),
        )
        for cell in cells
        if cell.part in FAMILIES
    )
    return Table.make(
        "coverage",
        "Which episodes count",
        "simulator system condition family expected:count n:count errors:count complete:flag "
        "missing_episodes error_episodes other_episodes",
        rows,
        "Episodes by split and index. An episode counts if one of its rollouts is no error. With "
        "repeats, one that does not count with every model seed of the condition is missing.",
    )


def _numbers(episodes: Iterable[EpisodeId]) -> str:
    """Return episodes of one family as text, such as `test 0-3,7`."""
    found: dict[str, list[int]] = {}
    for one in episodes:
        found.setdefault(one.split, []).append(one.index)
    return "; ".join(f"{split} {format_numbers(indices)}" for split, indices in found.items())
