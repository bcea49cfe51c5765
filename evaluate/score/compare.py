"""Two runs, paired over the episodes that both have."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.score import Grid
from robomme_interference_data.evaluate.score.cube import Cube, Statuses, cubes_of, success
from robomme_interference_data.evaluate.score.pairs import Pairs, pair, paired_table
from robomme_interference_data.evaluate.score.rows import Rows, read_rows
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.stats import Resampler, difference, wilson
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
    runs: tuple[Rows, Rows]


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
        lenient: Leave bad rows out, and count them.

    Raises:
        InvalidOptionError: They have no simulator, system, condition or episode in common.
        BadRowsError: Rows are bad.
    """
    one, other = (
        read_rows([p], s, lenient) for p, s in zip((first, second), systems, strict=True)
    )
    met = list(_met(one, other))
    notes, found = list(_differing(one, other)), []
    for a, b in met:
        conditions = [c for c in a.conditions if c in b.conditions]
        pairs = {(part, c): _pairs(a, b, c, part) for part in ("", *FAMILIES) for c in conditions}
        for (part, condition), here in pairs.items():
            if here.n:
                own = (a.cube.simulator, a.system, b.system, part or "all", condition)
                found.append((own, here, ()))
        if a.system == b.system and _same_histories(a.cube.simulator, one, other):
            notes += _noise(a, b, {c: pairs["", c] for c in conditions})
    if not found:
        raise InvalidOptionError(
            f"{first} and {second} have no episode under a common condition that counts in both",
            "Compare runs over the same episodes.",
        )
    notes += _left_out("a", one, met) + _left_out("b", other, [(b, a) for a, b in met])
    table = paired_table(
        "compare",
        "Two runs compared",
        [Column(n) for n in ("simulator", "system_a", "system_b", "family", "condition")],
        found,
        f"a: {first}; b: {second}. Over the n episodes that count in both; the difference is "
        "b − a, gained and lost are from a to b.",
        {"rate_a": "first", "rate_b": "second"},
    )
    return Comparison(table, tuple(notes), (one, other))


@dataclass(frozen=True)
class _Side:
    """One system in one simulator of a run."""

    cube: Cube
    system: str

    @property
    def conditions(self) -> list[str]:
        return self.cube.ran(self.system)

    def status(self, condition: str, episodes: Sequence[EpisodeId]) -> Statuses:
        place = {one: at for at, one in enumerate(self.cube.episodes)}
        return self.cube.status[self.cube.cell(self.system, condition)][
            [place[one] for one in episodes]
        ]

    def counted(self, condition: str) -> set[EpisodeId]:
        counts = self.cube.counted[self.cube.cell(self.system, condition)]
        return {self.cube.episodes[at] for at in np.flatnonzero(counts)}


def _sides(rows: Rows) -> Iterator[_Side]:
    for cube in cubes_of(rows, Grid.GIVEN).values():
        yield from (_Side(cube, system) for system in cube.systems)


def _met(one: Rows, other: Rows) -> Iterator[tuple[_Side, _Side]]:
    """Yield what is compared, simulator by simulator, in the order of tables."""
    simulators, systems = (
        [rows.names(column) for rows in (one, other)] for column in ("simulator", "system")
    )
    if set(simulators[0]).isdisjoint(simulators[1]):
        raise InvalidOptionError(
            f"the rows are of different simulators: {' and '.join(map(', '.join, simulators))}",
            "Only rows of one simulator can be compared.",
        )
    common = [system for system in systems[0] if system in systems[1]]
    if not common and max(map(len, systems)) > 1:
        raise InvalidOptionError(
            f"no system is in both: {' and '.join(map(', '.join, systems))}",
            "Compare runs of the same systems, or of one system each.",
        )
    partners = {one: one for one in common} or {systems[0][0]: systems[1][0]}
    there = {(side.cube.simulator, side.system): side for side in _sides(other)}
    for a in _sides(one):
        b = there.get((a.cube.simulator, partners.get(a.system, "")))
        if b is not None:
            _check_scenes(a.cube, b.cube)
            yield a, b


def _check_scenes(a: Cube, b: Cube) -> None:
    """Check that the two runs' scenes are the same: an episode's seed is one."""
    seeds = dict(zip(b.episodes, b.seed.tolist(), strict=True))
    for episode, seed in zip(a.episodes, a.seed.tolist(), strict=True):
        if seed >= 0 and seeds.get(episode, -1) not in (-1, seed):
            raise InvalidOptionError(
                f"{episode} has the seed {seed} in one run and {seeds[episode]} in the other",
                "Different scenes cannot be paired: compare runs over the same episodes.",
            )


def _pairs(a: _Side, b: _Side, condition: str, family: str) -> Pairs:
    """Compare two sides under a condition, over all shared episodes or those of a family."""
    shared = set(b.cube.episodes)
    episodes = [e for e in a.cube.episodes if e in shared and family in ("", e.family)]
    first, second = (side.status(condition, episodes) for side in (a, b))
    values = np.stack([success(first), success(second)], axis=1)
    values = values[~np.isnan(values).any(axis=1)]
    (drawn,) = Resampler(values, a.cube.simulator).intervals([difference(0, 1)])
    return pair(first, second, drawn, _matched(a.cube.model_seeds, b.cube.model_seeds))


def _matched(a: Sequence[int], b: Sequence[int]) -> tuple[list[int], list[int]]:
    """Match the model seeds of two runs; if they share none, the lowest with the lowest."""
    shared = [seed for seed in a if seed in b]
    if shared:
        return [a.index(seed) for seed in shared], [b.index(seed) for seed in shared]
    places = list(range(min(len(a), len(b))))
    return places, places


def _same_histories(simulator: str, one: Rows, other: Rows) -> bool:
    """Whether the runs name one revision of a split, or neither names any."""
    return one.revisions.get(simulator) == other.revisions.get(simulator)


def _differing(one: Rows, other: Rows) -> Iterator[str]:
    for simulator in one.names("simulator"):
        if simulator not in other.names("simulator") or _same_histories(simulator, one, other):
            continue
        revisions = [rows.revisions.get(simulator) for rows in (one, other)]
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


def _noise(a: _Side, b: _Side, pairs: Mapping[str, Pairs]) -> Iterator[str]:
    """Say how many episodes flip between two runs of the same system: the noise floor."""
    shares = []
    for condition, here in pairs.items():
        if here.pairs:
            low, high = wilson(here.gained + here.lost, here.pairs)
            shares.append(
                f"{condition} {percent(here.flips)} of {here.pairs} "
                f"(95% interval {100 * low:.1f} to {100 * high:.1f})"
            )
    if shares:
        same = not set(a.cube.model_seeds).isdisjoint(b.cube.model_seeds)
        seeds = "the same model seeds" if same else "other model seeds"
        yield (
            f"{a.system} ran in both, with {seeds}, in {a.cube.simulator}. If nothing else "
            "differs, this share of episodes flips by itself, which is the noise floor: "
            f"{', '.join(shares)}."
        )


def _left_out(name: str, rows: Rows, met: Sequence[tuple[_Side, _Side]]) -> list[str]:
    """Say what one run has and the comparison leaves out, nothing if that is nothing."""
    parts = []
    compared = {(a.cube.simulator, a.system) for a, _ in met}
    sides = [(side.cube.simulator, side.system) for side in _sides(rows)]
    if alone := [f"{system} in {sim}" for sim, system in sides if (sim, system) not in compared]:
        parts.append(_counted("system", alone))
    for a, b in met:
        only = [c for c in a.conditions if c not in b.conditions]
        found = [_counted("condition", only)] if only else []
        under: dict[int, list[str]] = {}
        for condition in (c for c in a.conditions if c in b.conditions):
            lone = len(a.counted(condition) - b.counted(condition))
            under.setdefault(lone, []).append(condition)
        found += [
            f"{lone:,} episode{'s' * (lone > 1)} under {', '.join(conditions)}"
            for lone, conditions in under.items()
            if lone
        ]
        parts += [f"of {a.system} in {a.cube.simulator} {' and '.join(found)}"] if found else []
    return [f"Only in {name}, and left out: {'; '.join(parts)}."] if parts else []


def _counted(what: str, names: Sequence[str]) -> str:
    return f"{len(names)} {what}{'s' * (len(names) > 1)} ({', '.join(names)})"
