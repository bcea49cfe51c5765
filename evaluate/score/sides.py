"""The sides of a comparison of runs: which are compared, and over which episodes."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robomme_interference_data.constants import RECORDINGS
from robomme_interference_data.errors import InvalidOptionError, named
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.stats.signs import sign_flips

from .config import Expected
from .outcomes import Outcomes, Repeat, Statuses, mean_errors
from .partners import related
from .placing import offline_outcomes, outcomes_of
from .rows.reading import CheckedRows
from .rows.values import unshifted
from .tables.pairs import Pairs, compare_cells, pair_errors


@dataclass(frozen=True, eq=False)
class Side:
    """One system in one simulator of a run."""

    outcomes: Outcomes
    system: str
    planned: Mapping[str, set[EpisodeId]]  # by condition, in all plans of its runs

    @property
    def facts(self) -> frozenset[SystemFacts]:
        """What the system is."""
        return self.outcomes.facts_of(self.system)

    @property
    def conditions(self) -> list[str]:
        """The conditions under which it has rows."""
        return self.outcomes.ran(self.system)

    def complete(self, condition: str) -> bool:
        """Whether all episodes count that occur or are planned."""
        whole = self.outcomes.complete[self.outcomes.cell(self.system, condition)]
        return bool(whole) and self.planned.get(condition, set()) <= self.counted(condition)

    def repeats(self, other: "Side", rows: CheckedRows, other_rows: CheckedRows) -> bool:
        """Whether another run's side is the same weights with the same scenes and histories."""
        name = self.outcomes.simulator
        same = (self.system, name) == (other.system, other.outcomes.simulator)
        weights, other_weights = (
            {repeat.training_seed for repeat in side.outcomes.repeats} for side in (self, other)
        )
        return (
            same
            and weights == other_weights
            and rows.revisions.get(name) == other_rows.revisions.get(name)
        )

    def counted(self, condition: str) -> set[EpisodeId]:
        """The episodes that count under a condition."""
        if condition not in self.conditions:
            return set()
        cell = self.outcomes.cell(self.system, condition)
        return {*self.outcomes.episodes_of(self.outcomes.counted[cell])}


Sides = dict[tuple[str, str], Side]
"""The systems of a run, by simulator and name."""


def sides_of(rows: CheckedRows) -> Sides:
    """Return the systems of a run, in the order of tables."""
    planned = defaultdict[str, set[EpisodeId]](set)
    for run in rows.sources.values():
        for item in run.items if run else ():
            planned[item.condition].add(item.episode)
    all_outcomes = [*outcomes_of(rows, Expected.OBSERVED).values()]
    recordings = offline_outcomes(rows)
    if recordings is not None:
        all_outcomes.append(recordings)
    return {
        (outcomes.simulator, system): Side(outcomes, system, planned)
        for outcomes in all_outcomes
        for system in outcomes.systems
    }


def matched_sides(
    runs: Sequence[CheckedRows], sides: Sequence[Sides]
) -> Iterator[tuple[Side, Side]]:
    """Yield the sides that are compared, in the order of tables."""
    first, second = (rows.names("simulator") for rows in runs)
    shared = {name: name for name in first if name in second}
    if not shared:  # the same simulator under different shifts
        plain = {unshifted(name): name for name in second}
        shared = {name: plain[unshifted(name)] for name in first if unshifted(name) in plain}
    if not shared:
        raise InvalidOptionError(
            f"the rows are of different simulators: {', '.join(first)} and {', '.join(second)}",
            "Only rows of one simulator can be compared.",
        )
    systems = [rows.names("system") for rows in runs]
    partners = {system: system for system in systems[0] if system in systems[1]}
    if not partners:
        if max(map(len, systems)) > 1:
            raise InvalidOptionError(
                f"no system is in both: {' and '.join(map(', '.join, systems))}",
                "Compare runs of the same systems, or of one system each.",
            )
        partners = {systems[0][0]: systems[1][0]}
    for (simulator, system), a in sides[0].items():
        b = sides[1].get((shared.get(simulator, ""), partners.get(system, "")))
        if b is not None:
            yield a, b


def check_scenes(rows: CheckedRows, other_rows: CheckedRows) -> None:
    """Check that the two runs have the same scenes, as far as their rows tell."""
    for simulator in dict.fromkeys(simulator for simulator, _ in rows.scenes):
        both = (*rows.scenes.items(), *other_rows.scenes.items())
        decided_by = {scenes for (name, _), scenes in both if name == simulator}
        if len(decided_by) > 1 or any(seed is None for scenes in decided_by for _, seed in scenes):
            raise InvalidOptionError(
                f"the scenes in {simulator} are not known to be the same in both files",
                f"If their seeds are the same, name them: {named('model_seed')}; `score` compares "
                "them without pairs.",
            )
    known, others = (
        {
            (unshifted(row.simulator), row.family, row.split, row.episode): row.seed
            for row in each
            if row.seed is not None
        }
        for each in (rows, other_rows)
    )
    for key, seed in known.items():
        if others.get(key, seed) != seed:
            raise InvalidOptionError(
                f"{'/'.join(map(str, key[1:]))} has the seed {seed} in one run and "
                f"{others[key]} in the other",
                "Different scenes cannot be paired: compare runs over the same episodes.",
            )


def pairs_of(a: Side, b: Side, conditions: tuple[str, str], family: str) -> Pairs:
    """Compare two sides under a condition each, over shared episodes: all, or those of a family."""
    a_places, b_places = (
        {episode: place for place, episode in enumerate(side.outcomes.episodes)} for side in (a, b)
    )
    shared = [
        episode for episode in a_places if episode in b_places and family in ("", episode.family)
    ]
    a_cell = a.outcomes.cell(a.system, conditions[0])
    b_cell = b.outcomes.cell(b.system, conditions[1])
    a_shared = [a_places[episode] for episode in shared]
    b_shared = [b_places[episode] for episode in shared]
    if a.outcomes.simulator == RECORDINGS:
        before = mean_errors(a.outcomes.action_l1)[a_cell][a_shared]
        after = mean_errors(b.outcomes.action_l1)[b_cell][b_shared]
        [test] = sign_flips((after - before).round(12)[:, None], RECORDINGS)
        return pair_errors(before, after, test)
    repeats, (before, after) = _aligned(
        (a.outcomes.repeats, b.outcomes.repeats),
        (a.outcomes.status[a_cell][a_shared], b.outcomes.status[b_cell][b_shared]),
    )
    seeds = [repeat.training_seed for repeat in repeats]
    runs = {seed: place for place, seed in enumerate(dict.fromkeys(seeds))}
    return compare_cells(
        before,
        after,
        np.array([runs[seed] for seed in seeds]),
        same_weights=a.system == b.system or related(a.facts, b.facts),
    )


def _aligned(
    repeats: tuple[Sequence[Repeat], Sequence[Repeat]], sides: tuple[Statuses, Statuses]
) -> tuple[list[Repeat], list[Statuses]]:
    """Return all repeats of two sides, and both sides with an axis of these.

    If they have none in common, the lowest of both are paired, and so on, as those of the first.
    """
    first, second = repeats
    if not {*first} & {*second}:
        renamed = [*first[: len(second)], *second[len(first) :]]
        second = renamed if len({*renamed}) == len(second) else second
    every = list(dict.fromkeys([*first, *second]))
    aligned = list[Statuses]()
    for own, status in zip((first, second), sides, strict=True):
        whole = np.full((len(status), len(every)), -1, np.int8)
        whole[:, [every.index(repeat) for repeat in own]] = status
        aligned.append(whole)
    return every, aligned
