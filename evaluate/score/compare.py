"""Two runs, paired over the episodes that both have."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.bootstrap import Interval, Resampler, difference
from robomme_interference_data.constants import FAMILIES, SPLITS
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.rows import condition_rank
from robomme_interference_data.evaluate.score.outcomes import (
    SUCCESS,
    Outcomes,
    families_of,
    outcomes_of,
)
from robomme_interference_data.evaluate.score.rollouts import Rollouts, read_rollouts
from robomme_interference_data.evaluate.score.statistics import holm, mcnemar
from robomme_interference_data.tables import Column, Table

__all__ = ["Comparison", "compare"]


@dataclass(frozen=True)
class Comparison:
    """A paired comparison of two runs.

    Attributes:
        table: A row per condition, then per condition and family.
        notes: What a reader must know, such as that the revisions differ.
    """

    table: Table
    notes: tuple[str, ...]


def compare(
    first: Path, second: Path, systems: tuple[str | None, str | None] = (None, None)
) -> Comparison:
    """Compare two runs of one simulator over the conditions and episodes that both have.

    A system that both runs hold is compared with itself, as a repeat is. If they hold none in
    common and one each, these two are compared, as a system with and without retrieval are.

    Args:
        first: Folder or file of rows.
        second: The other one. Differences are its rate − the first's.
        systems: Names of the systems of rows that name none.

    Raises:
        InvalidOptionError: They have no simulator, system, condition or episode in common.
        BadRowsError: Rows are bad.
    """
    one, other = (read_rollouts([p], s) for p, s in zip((first, second), systems, strict=True))
    pairs = list(_pairs(one, other))
    rows, p_values = [], []
    for a, b in pairs:
        episodes = np.intersect1d(a.episodes, b.episodes, assume_unique=True)
        shared = [c for c in a.conditions if c in b.conditions]
        for part in ("", *FAMILIES):
            here = episodes if not part else episodes[families_of(episodes) == FAMILIES.index(part)]
            for condition in sorted(shared, key=condition_rank):
                row = _row(a, b, condition, here)
                if row is not None:
                    names = (a.simulator, a.system, b.system, part or "all", condition)
                    rows.append((*names, *row))
                    p_values.append(row[-1])
    if not rows:
        raise InvalidOptionError(
            f"{first} and {second} have no episode under a common condition that counts in both",
            "Compare runs over the same episodes.",
        )
    known = [place for place, p in enumerate(p_values) if not math.isnan(p)]
    corrected = dict(zip(known, holm([p_values[place] for place in known]), strict=True))
    columns = (
        *(Column(n) for n in ("simulator", "system_a", "system_b", "family", "condition")),
        *(Column("n", "count"), Column("rate_a", "rate"), Column("rate_b", "rate")),
        *(Column("difference", "points"), Column("low", "points"), Column("high", "points")),
        *(Column("gained", "count"), Column("lost", "count")),
        *(Column("p", "p"), Column("p_holm", "p")),
    )
    note = (
        f"a: {first}; b: {second}. Over the n episodes that count in both; the difference is b − a "
        "with its 95% BCa bootstrap interval, clustered by episode. gained and lost: from a to b; "
        "p: McNemar's exact test; p_holm: corrected for the number of tests in this table."
    )
    found = tuple((*row, corrected.get(i, math.nan)) for i, row in enumerate(rows))
    return Comparison(
        Table("compare", "Two runs compared", columns, found, note), _notes(one, other)
    )


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


def _row(
    a: Outcomes, b: Outcomes, condition: str, episodes: NDArray[np.int64]
) -> tuple[float, ...] | None:
    values = np.stack([a.column(condition, episodes), b.column(condition, episodes)], axis=1)
    values = values[~np.isnan(values).any(axis=1)]
    if not len(values):
        return None
    one, other = a.first(condition, episodes), b.first(condition, episodes)
    known = (one >= 0) & (other >= 0)
    gained = int((known & (one != SUCCESS) & (other == SUCCESS)).sum())
    lost = int((known & (one == SUCCESS) & (other != SUCCESS)).sum())
    change: Interval = Resampler(values, a.simulator).intervals([difference(0, 1)])[0]
    return (
        *(len(values), float(values[:, 0].mean()), float(values[:, 1].mean())),
        *(change.value, change.low, change.high, gained, lost),
        mcnemar(gained, lost) if known.any() else math.nan,
    )


def _notes(one: Rollouts, other: Rollouts) -> tuple[str, ...]:
    differing = [
        f"The rows of {simulator} are of different splits (revisions {revision} and "
        f"{other.revisions[simulator]}): the histories differ."
        for simulator, revision in one.revisions.items()
        if other.revisions.get(simulator, revision) != revision
    ]
    unknown = [
        f"Only one of the runs names the revision of its split of {simulator}: the histories may "
        "differ."
        for simulator in one.simulators
        if simulator in other.simulators
        and (simulator in one.revisions) != (simulator in other.revisions)
    ]
    return (*differing, *unknown)
