"""Rates of cells: system × condition, and the same by family, difficulty and ability."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from robomme_interference_data.constants import ABILITIES, DIFFICULTIES
from robomme_interference_data.evaluate.score.outcomes import (
    ERROR,
    STATUSES,
    Flags,
    Outcomes,
    SuccessRate,
    errors_as,
    rate_of,
)
from robomme_interference_data.ids import EpisodeId, format_numbers
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.stats.intervals import stratified_n, wilson
from robomme_interference_data.stats.runs import ONE_RUN, RunSpread
from robomme_interference_data.viz.tables import Columns

from .contrast import Scope, scope_of
from .ranks import Ranking, all_pairs, rankings


@dataclass(frozen=True)
class Coverage:
    """Which episodes count of one system under one condition, in all or some of the episodes."""

    simulator: str
    system: str
    condition: str
    part: str  # family, difficulty or ability; empty for all episodes
    n: int  # episodes that count: at least one rollout that is not an error
    reference: bool = field(default=False, kw_only=True)  # the system is never ranked
    counts: tuple[int, ...] = field(default=(0,) * len(STATUSES), kw_only=True)  # by status
    expected: int = field(default=0, kw_only=True)  # number of expected episodes
    # Expected, but do not count with every model seed.
    missing: Sequence[EpisodeId] = field(default=(), kw_only=True)
    broken: Sequence[EpisodeId] = field(default=(), kw_only=True)  # with an error
    # Count without being expected.
    unexpected: Sequence[EpisodeId] = field(default=(), kw_only=True)

    @property
    def complete(self) -> bool:
        """Whether exactly the expected episodes count, with every model seed."""
        return self.n > 0 and not self.missing and not self.unexpected

    @property
    def errors(self) -> int:
        """The number of errors."""
        return self.counts[ERROR]

    @property
    def mark(self) -> str:
        """† if the cell is not complete."""
        return "" if self.complete else "†"


@dataclass(frozen=True)
class SuccessCell(Coverage):
    """The success rate of one system under one condition, in all or some of the episodes."""

    rate: float  # mean over them of the success of their repeats; NaN if n is 0
    interval: tuple[float, float]  # 95% Wilson; (0, 1) if n is 0
    trials: float  # effective number of independent trials: n, and more with repeats
    fixed: tuple[float, float] = (math.nan, math.nan)  # interval for just these families
    spread: RunSpread = ONE_RUN  # over training runs, which the interval holds
    if_errors_fail: float = math.nan  # rate if every error were a failure; NaN without rollouts
    if_errors_succeed: float = math.nan  # … a success
    chance: float = math.nan  # mean success of guessing; NaN unless all episodes are questions
    rank: int | None = None  # among complete cells, 1 for the highest rate; None for references
    best: bool = False  # one of several, and no other one is significantly better
    ranking: Ranking | None = None  # among the ranked systems; None if there are no others

    @property
    def as_rate(self) -> SuccessRate:
        """Its rate, for comparisons."""
        return SuccessRate(self.n, self.rate, self.trials, self.spread)

    @property
    def runs(self) -> int:
        """The number of training runs."""
        return self.spread.runs

    @property
    def scope(self) -> Scope:
        """What the interval holds for."""
        return scope_of(self.runs)

    @property
    def run_spread(self) -> float:
        """Standard deviation of the training runs' rates; NaN for one."""
        return self.spread.deviation


def part_kind(part: str) -> str:
    """Return what a part is: `family`, `difficulty`, `ability`; empty for all episodes."""
    if part in DIFFICULTIES:
        return "difficulty"
    return "ability" if part in ABILITIES else part and "family"


def coverage_of(
    outcomes: Outcomes, system: int, condition: int, here: Flags, maybe_here: Flags
) -> dict[str, Any]:
    """Return what is counted of a cell over the episodes `here`.

    Among the expected episodes are those that only may be of this part (`maybe_here`): of an
    episode without rows the difficulty is unknown.
    """
    counts = outcomes.counts[system, condition]
    return {
        "reference": outcomes.is_reference(outcomes.systems[system]),
        "counts": tuple(counts[here].sum(axis=0).tolist()),
        "expected": int((maybe_here & outcomes.expected).sum()),
        "missing": outcomes.episodes_of(maybe_here & outcomes.missing[system, condition]),
        "broken": outcomes.episodes_of(here & (counts[:, ERROR] > 0)),
        "unexpected": outcomes.episodes_of(here & outcomes.unexpected[system, condition]),
    }


def cells_of(all_outcomes: Iterable[Outcomes]) -> list[SuccessCell]:
    """Return the cells of every system and condition, in the order of tables.

    Each cell is followed by its parts by family, by difficulty and, in days, by ability. An
    expected episode of unknown difficulty is missing in all three difficulties.
    """
    return [cell for outcomes in all_outcomes for cell in _cells(outcomes)]


def _cells(outcomes: Outcomes) -> list[SuccessCell]:
    everywhere: Flags = np.ones(len(outcomes.episodes), bool)
    # Name of a part to its episodes, and to those that may be of it.
    parts = {"": (everywhere, everywhere)}
    for family in outcomes.families:
        here = outcomes.of_family(family)
        parts[family] = (here, here)
    for names, numbers in ((DIFFICULTIES, outcomes.difficulty), (ABILITIES, outcomes.ability)):
        if names is ABILITIES and (numbers < 0).all():  # no days
            continue
        for place, name in enumerate(names):
            here = numbers == place
            parts[name] = (here, here | (numbers < 0))
    cells = []
    for s, c in np.argwhere(outcomes.in_tables).tolist():
        for part, (here, maybe_here) in parts.items():
            occurs = here & outcomes.has_episode[s]
            if not (occurs | (maybe_here & outcomes.expected)).any():
                continue
            counted = here & outcomes.counted[s, c]
            status = outcomes.status[s, c, here]
            rate = rate_of(status, outcomes.training)
            failed, won = (errors_as(status, other) for other in (Status.FAIL, Status.SUCCESS))
            fixed = (math.nan, math.nan) if part else _fixed(outcomes, s, c, rate)
            cells.append(
                SuccessCell(
                    outcomes.simulator,
                    outcomes.systems[s],
                    outcomes.conditions[c],
                    part,
                    rate.n,
                    rate.value,
                    rate.interval,
                    rate.trials,
                    fixed=fixed,
                    spread=rate.spread,
                    if_errors_fail=rate_of(failed).value,
                    if_errors_succeed=rate_of(won).value,
                    chance=float(outcomes.chance[counted].mean()) if rate.n else math.nan,
                    **coverage_of(outcomes, s, c, here, maybe_here),
                )
            )
    return _ranked(outcomes, cells, {part: here for part, (here, _) in parts.items()})


def _fixed(
    outcomes: Outcomes, system: int, condition: int, rate: SuccessRate
) -> tuple[float, float]:
    """Return the interval of a rate for its families as fixed strata.

    None for one family, and with training runs as a random effect.
    """
    if scope_of(rate.spread.runs) is Scope.TRAINING:
        return math.nan, math.nan
    status = outcomes.status[system, condition]
    by_family = [rate_of(status[outcomes.of_family(name)]) for name in outcomes.families]
    by_family = [family for family in by_family if family.n]
    if len(by_family) < 2:
        return math.nan, math.nan
    n = np.array([family.n for family in by_family], float)
    trials = stratified_n(n * [family.value for family in by_family], n)
    trials *= rate.trials / rate.n
    return wilson(rate.value * trials, trials)


def _ranked(
    outcomes: Outcomes, cells: list[SuccessCell], parts: Mapping[str, Flags]
) -> list[SuccessCell]:
    """Return the cells with their ranks: complete ones, of systems that are no references."""
    groups = defaultdict[tuple[str, str], list[int]](list)
    for place, cell in enumerate(cells):
        if cell.complete and not cell.reference:
            groups[cell.condition, cell.part].append(place)
    for (condition, part), places in groups.items():
        if len(places) == 1:
            cells[places[0]] = replace(cells[places[0]], rank=1)
            continue
        rates = {cells[place].system: cells[place].rate for place in places}
        compared = all_pairs(outcomes, condition, [*rates], parts[part])
        ranking_of = rankings(rates, compared)
        for place in places:
            cell = cells[place]
            ranking = ranking_of[cell.system]
            cells[place] = replace(
                cell,
                rank=ranking.rank,
                best=ranking.tied_with_best and cell.rate > 0,
                ranking=ranking,
            )
    return cells


EPISODES: Columns = {
    "expected": "count",
    "missing_episodes": "text",
    "error_episodes": "text",
    "other_episodes": "text",
}
"""Which episodes a cell lacks, which have errors, and which it has beyond the expected ones."""


def episodes_record(cell: Coverage, *, listed: bool) -> dict[str, Any]:
    """Return the values of the columns `EPISODES`; only a cell of one family can list them."""
    return {
        "expected": cell.expected,
        "missing_episodes": _numbers(cell.missing) if listed else "",
        "error_episodes": _numbers(cell.broken) if listed else "",
        "other_episodes": _numbers(cell.unexpected) if listed else "",
    }


def _numbers(episodes: Iterable[EpisodeId]) -> str:
    """Return episodes of one family as text, such as `test 0-3,7`."""
    by_split: dict[str, list[int]] = {}
    for episode in episodes:
        by_split.setdefault(episode.split, []).append(episode.index)
    return "; ".join(f"{split} {format_numbers(indices)}" for split, indices in by_split.items())
