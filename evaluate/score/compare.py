"""Two runs, paired over the episodes that both have."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.bootstrap import Resampler, difference
from robomme_interference_data.constants import FAMILIES, SPLITS
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.rows import condition_rank
from robomme_interference_data.evaluate.score.outcomes import (
    Outcomes,
    families_of,
    outcomes_of,
)
from robomme_interference_data.evaluate.score.paired import (
    COLUMNS,
    Side,
    Tested,
    interval_of,
    note_of,
    pairs_of,
    tested,
)
from robomme_interference_data.evaluate.score.rollouts import Rollouts, read_rollouts
from robomme_interference_data.evaluate.score.statistics import holm
from robomme_interference_data.intervals import wilson
from robomme_interference_data.tables import Column, Table, percent

__all__ = ["Comparison", "compare"]


@dataclass(frozen=True)
class Comparison:
    """A paired comparison of two runs.

    Attributes:
        table: A row per condition, then per condition and family.
        notes: What a reader must know: that revisions differ, how many episodes flip between two
            runs of one system, what only one of the runs holds.
        runs: The rows of the two runs.
    """

    table: Table
    notes: tuple[str, ...]
    runs: tuple[Rollouts, Rollouts]


def compare(
    first: Path,
    second: Path,
    systems: tuple[str | None, str | None] = (None, None),
    lenient: bool = False,
) -> Comparison:
    """Compare two runs of one simulator over the conditions and episodes that both have.

    A system that both runs hold is compared with itself, as a repeat is. If they hold none in
    common and one each, these two are compared, as a system with and without retrieval are.

    Args:
        first: Folder or file of rows.
        second: The other one. Differences are its rate − the first's.
        systems: Names of the systems of rows that name none.
        lenient: Skip and count bad rows.

    Raises:
        InvalidOptionError: They have no simulator, system, condition or episode in common.
        BadRowsError: Rows are bad.
    """
    one, other = (
        read_rollouts([p], s, lenient) for p, s in zip((first, second), systems, strict=True)
    )
    seeds = _seeds(one, other)
    rows: list[tuple[Any, ...]] = []
    notes = list(_differing(one, other))
    met = list(_pairs(one, other))
    for a, b in met:
        shared = sorted((c for c in a.conditions if c in b.conditions), key=condition_rank)
        found = [_Condition(a, b, condition, seeds) for condition in shared]
        for part in ("", *FAMILIES):
            for here in found:
                if numbers := here.row(part):
                    names = (a.simulator, a.system, b.system, part or "all", here.condition)
                    rows.append((*names, *numbers))
        if a.system == b.system and _same_histories(a.simulator, one, other):
            notes += _noise(a, found, one, other)
    if not rows:
        raise InvalidOptionError(
            f"{first} and {second} have no episode under a common condition that counts in both",
            "Compare runs over the same episodes.",
        )
    notes += _left_out("a", one, met) + _left_out("b", other, [(b, a) for a, b in met])
    columns = (
        *(Column(n) for n in ("simulator", "system_a", "system_b", "family", "condition")),
        *(Column("n", "count"), Column("rate_a", "rate"), Column("rate_b", "rate")),
        *(Column("difference", "points"), *COLUMNS),
    )
    note = (
        f"a: {first}; b: {second}. Over the n episodes that count in both; the difference is "
        "b − a, gained and lost are from a to b. "
    )
    place, pairs = (next(i for i, c in enumerate(columns) if c.name == n) for n in ("n", "pairs"))
    note += note_of([(row[place], row[pairs]) for row in rows])
    corrected = holm([row[-1] for row in rows])
    whole = tuple((*row, p) for row, p in zip(rows, corrected, strict=True))
    table = Table("compare", "Two runs compared", columns, whole, note)
    return Comparison(table, tuple(notes), (one, other))


def _pairs(one: Rollouts, other: Rollouts) -> Iterator[tuple[Outcomes, Outcomes]]:
    simulators = set(one.simulators) & set(other.simulators)
    if not simulators:
        raise InvalidOptionError(
            f"the rows are of different simulators: {', '.join(one.simulators)} and "
            f"{', '.join(other.simulators)}",
            "Only rows of one simulator can be compared.",
        )
    _check_episodes(one, other, simulators)
    common = [system for system in one.systems if system in other.systems]
    alone = len(one.systems) == len(other.systems) == 1
    if not common and not alone:
        raise InvalidOptionError(
            f"no system is in both: {', '.join(one.systems)} and {', '.join(other.systems)}",
            "Compare runs of the same systems, or of one system each.",
        )
    partners = {s: s for s in common} or {one.systems[0]: other.systems[0]}
    there = {(o.simulator, o.system): o for o in outcomes_of(other)}
    for a in outcomes_of(one):
        b = there.get((a.simulator, partners.get(a.system, "")))
        if b is not None:
            yield a, b


def _check_episodes(one: Rollouts, other: Rollouts, simulators: set[str]) -> None:
    """Check that the two runs' scenes are the same: an episode's seed is one."""
    groups = len(FAMILIES) * len(SPLITS)
    for simulator in sorted(simulators):
        a, b = (r.seeds[r.simulators.index(simulator) * groups :][:groups] for r in (one, other))
        width = min(a.shape[1], b.shape[1])
        a, b = a[:, :width], b[:, :width]
        wrong = np.argwhere((a >= 0) & (b >= 0) & (a != b))
        if len(wrong):
            group, index = wrong[0].tolist()
            family, split = divmod(group, len(SPLITS))
            raise InvalidOptionError(
                f"{FAMILIES[family]}/{SPLITS[split]}/{index} has the seed {a[group, index]} in one "
                f"run and {b[group, index]} in the other",
                "Different scenes cannot be paired: compare runs over the same episodes.",
            )


@dataclass(frozen=True)
class _Seeds:
    """Numbers that stand for the model seeds of the two runs, by their codes."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    shared: bool


def _seeds(one: Rollouts, other: Rollouts) -> _Seeds:
    """Match the model seeds of two runs; if they share none, the lowest with the lowest."""
    a, b = (np.array(r.model_seeds, np.int64) for r in (one, other))
    if not np.isin(a, b).any():
        return _Seeds(np.arange(len(a)), np.arange(len(b)), False)
    known = np.union1d(a, b)
    return _Seeds(np.searchsorted(known, a), np.searchsorted(known, b), True)


class _Condition:
    """One condition of a system in both runs, over the episodes that both have."""

    def __init__(self, a: Outcomes, b: Outcomes, condition: str, seeds: _Seeds):
        self.condition = condition
        self._simulator = a.simulator
        episodes = np.intersect1d(a.episodes, b.episodes, assume_unique=True)
        columns = [one.column(condition, episodes) for one in (a, b)]
        self._values = np.stack(columns, axis=1)
        known = ~np.isnan(self._values).any(axis=1)
        self._values, self._episodes = self._values[known], episodes[known]
        self._once = a.once(condition, self._episodes) & b.once(condition, self._episodes)
        self._pairs = pairs_of(Side(a, condition, seeds.first), Side(b, condition, seeds.second))

    def tested(self, part: str = "") -> Tested:
        """Return McNemar's exact test in all pairs, or in those of a family."""
        return tested(self._pairs, _of(part, self._pairs.episodes))

    def row(self, part: str) -> tuple[Any, ...]:
        """Return the numbers of all episodes, or of a family; none if no episode counts."""
        here = _of(part, self._episodes)
        values = self._values[here]
        if not len(values):
            return ()
        (drawn,) = Resampler(values, self._simulator).intervals([difference(0, 1)])
        change, kind = interval_of(values, bool(self._once[here].all()), drawn)
        test = self.tested(part)
        return (
            *(len(values), float(values[:, 0].mean()), float(values[:, 1].mean())),
            *(change.value, change.low, change.high, kind),
            *(test.pairs, test.gained, test.lost, test.flips, test.p),
        )


def _of(part: str, episodes: NDArray[np.int64]) -> NDArray[np.bool_]:
    if not part:
        return np.ones(len(episodes), bool)
    return families_of(episodes) == FAMILIES.index(part)


def _same_histories(simulator: str, one: Rollouts, other: Rollouts) -> bool:
    """Whether the runs name one revision of a split, or neither names any."""
    return one.revisions.get(simulator) == other.revisions.get(simulator)


def _differing(one: Rollouts, other: Rollouts) -> Iterator[str]:
    for simulator in one.simulators:
        if simulator not in other.simulators or _same_histories(simulator, one, other):
            continue
        revisions = [r.revisions.get(simulator) for r in (one, other)]
        if None in revisions:
            yield (
                f"Only one of the runs names the revision of its split of {simulator}: the "
                "histories may differ."
            )
        else:
            yield (
                f"The rows of {simulator} are of different splits (revisions {revisions[0]} and "
                f"{revisions[1]}): the histories differ."
            )


def _noise(
    a: Outcomes, found: Sequence[_Condition], one: Rollouts, other: Rollouts
) -> Iterator[str]:
    """Say how many episodes flip between two runs of the same system: the noise floor."""
    shares = []
    for here in found:
        test = here.tested()
        if test.pairs:
            low, high = wilson(test.gained + test.lost, test.pairs)
            shares.append(
                f"{here.condition} {percent(test.flips)} of {test.pairs} "
                f"(95% interval {100 * low:.1f} to {100 * high:.1f})"
            )
    if shares:
        same = set(one.model_seeds) & set(other.model_seeds)
        seeds = "the same model seeds" if same else "other model seeds"
        yield (
            f"{a.system} ran in both, with {seeds}, in {a.simulator}. If nothing else differs, "
            f"this share of episodes flips by itself, which is the noise floor: "
            f"{', '.join(shares)}."
        )


def _left_out(name: str, rollouts: Rollouts, met: Sequence[tuple[Outcomes, Outcomes]]) -> list[str]:
    """Say what one run has and the comparison leaves out, nothing if that is nothing."""
    parts = []
    compared = {(a.simulator, a.system) for a, _ in met}
    alone = [o for o in outcomes_of(rollouts) if (o.simulator, o.system) not in compared]
    if alone:
        parts.append(_counted("system", [f"{o.system} in {o.simulator}" for o in alone]))
    for a, b in met:
        only = [c for c in a.conditions if c not in b.conditions]
        found = [_counted("condition", only)] if only else []
        found += _episodes_of_one(a, b)
        parts += [f"of {a.system} in {a.simulator} {' and '.join(found)}"] if found else []
    return [f"Only in {name}, and left out: {'; '.join(parts)}."] if parts else []


def _episodes_of_one(a: Outcomes, b: Outcomes) -> Iterator[str]:
    """Count the episodes that count under a shared condition in the first run alone."""
    under: dict[int, list[str]] = {}
    for condition in (c for c in a.conditions if c in b.conditions):
        here, there = (o.episodes[o.scored[o.conditions.index(condition)] > 0] for o in (a, b))
        if lone := len(np.setdiff1d(here, there, assume_unique=True)):
            under.setdefault(lone, []).append(condition)
    for lone, conditions in under.items():
        yield f"{lone:,} episode{'s' * (lone > 1)} under {', '.join(conditions)}"


def _counted(what: str, names: Sequence[str]) -> str:
    return f"{len(names)} {what}{'s' * (len(names) > 1)} ({', '.join(names)})"
