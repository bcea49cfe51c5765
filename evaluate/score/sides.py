"""The sides of a comparison of runs: which are compared, and what a reader must know of them."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from robomme_interference_data.errors import InvalidOptionError, named
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.stats.intervals import wilson
from robomme_interference_data.viz.tables import percent

from .config import Expected
from .outcomes import Outcomes
from .placing import offline_outcomes, outcomes_of
from .rows.reading import CheckedRows
from .rows.values import unshifted
from .tables.pairs import Pairs


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
        found = {scenes for (name, _), scenes in both if name == simulator}
        if len(found) > 1 or any(seed is None for scenes in found for _, seed in scenes):
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


# --- notes -------------------------------------------------------------------------------------


def differing(
    rows: CheckedRows, other_rows: CheckedRows, matched: Iterable[tuple[Side, Side]]
) -> Iterator[str]:
    """Yield notes on what differs between two runs: shifts, and revisions of buffer sets."""
    names = dict.fromkeys((a.outcomes.simulator, b.outcomes.simulator) for a, b in matched)
    for first, second in names:
        if first != second:
            yield (
                f"a is of {first} and b of {second}: the scenes are the same, and the difference "
                "is the effect of the shift."
            )
        revisions = [rows.revisions.get(first), other_rows.revisions.get(second)]
        if any(simulator == first for simulator, _ in rows.scenes):
            continue  # of another benchmark, whose scenes are known to be the same
        if rows is not other_rows and revisions == [None, None]:
            yield f"The rows of {first} name no revision of a buffer set: the histories may differ."
        elif revisions[0] != revisions[1]:
            named = " and ".join(revision or "unknown" for revision in revisions)
            yield (
                f"The rows of {first} are of different buffer sets (revisions {named}): the "
                "histories may differ."
            )


def noise_floor(a: Side, b: Side, pairs: Mapping[str, Pairs]) -> Iterator[str]:
    """Yield a note on the share of episodes that flip between two runs of a system, if any."""
    shares = []
    for condition, compared in pairs.items():
        if compared.pairs:
            low, high = wilson(compared.gained + compared.lost, compared.pairs)
            shares.append(
                f"{condition} {percent(compared.flips)} of {compared.pairs} "
                f"(95% interval {100 * low:.1f} to {100 * high:.1f})"
            )
    if not shares:
        return
    seeds, other_seeds = (
        {repeat.model_seed for repeat in side.outcomes.repeats} for side in (a, b)
    )
    if seeds == other_seeds:
        which = "the same"
    else:
        which = "partly other" if seeds & other_seeds else "other"
    yield (
        f"{a.system} ran in both, with {which} model seeds, in "
        f"{a.outcomes.simulator}. If nothing else differs, this share of episodes flips by chance "
        f"(the noise floor): {', '.join(shares)}."
    )


def stopped_early(name: str, sides: Iterable[Side]) -> Iterator[str]:
    """Yield a note on planned episodes of a run that do not count, if any."""
    lacking = []
    for side in sides:
        for condition, planned in side.planned.items():
            count = len(planned - side.counted(condition))
            if count:
                lacking.append(
                    f"{side.system} in {side.outcomes.simulator}, {condition} "
                    f"({count:,} of {len(planned):,})"
                )
    if lacking:
        yield (
            f"{name} was stopped early, is still running, or broke in part; planned episodes that "
            f"do not count: {'; '.join(lacking)}. Looking again and again finds too much: plan the "
            "looks (--looks)."
        )


def left_out(
    name: str, sides: Iterable[Side], matched: Mapping[Side, Side], conditions: Sequence[str]
) -> Iterator[str]:
    """Yield a note on the episodes of a run that the comparison leaves out, if any."""
    listed = []
    for side in sides:
        other = matched.get(side)
        lone = []
        both = [tuple(conditions)] if conditions else [(c, c) for c in side.conditions]
        for here, there in both:
            counted_there = set[EpisodeId]() if other is None else other.counted(there)
            count = len(side.counted(here) - counted_there)
            if count:
                lone.append(f"{here} ({count:,})")
        if lone:
            listed.append(f"{side.system} in {side.outcomes.simulator}, {', '.join(lone)}")
    if listed:
        yield f"Only in {name}, and left out (episodes): {'; '.join(listed)}."
