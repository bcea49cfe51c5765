"""Two runs, paired over the episodes that both have."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.score import Grid
from robomme_interference_data.evaluate.score.cube import Cube, cubes_of
from robomme_interference_data.evaluate.score.pairs import COLUMNS, Pairs, how_to_read, pair, tested
from robomme_interference_data.evaluate.score.rows import Rows, read_rows
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.stats import wilson
from robomme_interference_data.tables import Table, percent


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
    one, other = (read_rows([p], s, lenient) for p, s in zip((first, second), systems, strict=True))
    _check_scenes(one, other)
    sides = [_sides(rows) for rows in (one, other)]
    met = list(_met((one, other), sides))
    notes, own, found = list(_differing(one, other)), [], []
    for a, b in met:
        conditions = [c for c in a.conditions if c in b.conditions]
        pairs = {(part, c): _pairs(a, b, c, part) for part in ("", *FAMILIES) for c in conditions}
        for (part, condition), here in pairs.items():
            if here.n:
                own.append((a.cube.simulator, a.system, b.system, part or "all", condition))
                found.append(here)
        same = one.revisions.get(a.cube.simulator) == other.revisions.get(a.cube.simulator)
        if a.system == b.system and same:
            notes += _noise(a, b, {c: pairs["", c] for c in conditions})
    if not found:
        raise InvalidOptionError(
            f"{first} and {second} have no episode under a common condition that counts in both",
            "Compare runs over the same episodes.",
        )
    notes += _left_out("a", sides[0].values(), dict(met))
    notes += _left_out("b", sides[1].values(), {b: a for a, b in met})
    tests = [(pairs, "all" in names, True) for names, pairs in zip(own, found, strict=True)]
    table = Table.make(
        "compare",
        "Two runs compared",
        "simulator system_a system_b family condition n:count rate_a:rate rate_b:rate "
        f"difference:points {COLUMNS}",
        (
            (*names, pairs.n, pairs.first, pairs.second, *test)
            for names, pairs, test in zip(own, found, tested(tests), strict=True)
        ),
        f"a: {first}; b: {second}. Over the n episodes that count in both; the difference is "
        f"b − a, gained and lost are from a to b. "
        + how_to_read(tests, "the rows of all families, and those of single ones"),
    )
    return Comparison(table, tuple(notes), (one, other))


@dataclass(frozen=True, eq=False)
class _Side:
    """One system in one simulator of a run."""

    cube: Cube
    system: str

    @property
    def conditions(self) -> list[str]:
        return self.cube.ran(self.system)

    def counted(self, condition: str) -> set[EpisodeId]:
        if condition not in self.conditions:
            return set()
        return {*self.cube.chosen(self.cube.counted[self.cube.cell(self.system, condition)])}


_Sides = dict[tuple[str, str], _Side]


def _sides(rows: Rows) -> _Sides:
    """Return the systems of a run by simulator and name, in the order of tables."""
    cubes = cubes_of(rows, Grid.GIVEN).values()
    return {
        (cube.simulator, system): _Side(cube, system) for cube in cubes for system in cube.systems
    }


def _met(runs: Sequence[Rows], sides: Sequence[_Sides]) -> Iterator[tuple[_Side, _Side]]:
    """Yield what is compared, simulator by simulator, in the order of tables."""
    simulators, systems = ([rows.names(name) for rows in runs] for name in ("simulator", "system"))
    if set(simulators[0]).isdisjoint(simulators[1]):
        raise InvalidOptionError(
            f"the rows are of different simulators: {' and '.join(map(', '.join, simulators))}",
            "Only rows of one simulator can be compared.",
        )
    common = {system: system for system in systems[0] if system in systems[1]}
    if not common and max(map(len, systems)) > 1:
        raise InvalidOptionError(
            f"no system is in both: {' and '.join(map(', '.join, systems))}",
            "Compare runs of the same systems, or of one system each.",
        )
    partners = common or dict(zip(*systems, strict=True))
    for (simulator, system), a in sides[0].items():
        if b := sides[1].get((simulator, partners.get(system, ""))):
            yield a, b


def _check_scenes(one: Rows, other: Rows) -> None:
    """Check that the two runs' scenes are the same: an episode's seed is one."""
    names = ("simulator", "family", "episode_split", "episode", "seed")
    known, found = (
        {
            row[:-1]: row[-1]
            for row in zip(*map(rows.list, names), strict=True)
            if row[-1] is not None
        }
        for rows in (one, other)
    )
    for key, seed in known.items():
        if found.get(key, seed) != seed:
            raise InvalidOptionError(
                f"{'/'.join(map(str, key[1:]))} has the seed {seed} in one run and {found[key]} in "
                "the other",
                "Different scenes cannot be paired: compare runs over the same episodes.",
            )


def _pairs(a: _Side, b: _Side, condition: str, family: str) -> Pairs:
    """Compare two sides under a condition, over all shared episodes or those of a family."""
    places = [{one: at for at, one in enumerate(side.cube.episodes)} for side in (a, b)]
    shared = [one for one in places[0] if one in places[1] and family in ("", one.family)]
    first, second = (
        side.cube.status[side.cube.cell(side.system, condition)][[at[one] for one in shared]]
        for side, at in zip((a, b), places, strict=True)
    )
    # Model seeds that the runs share are paired; if they share none, the lowest with the lowest.
    seeds = a.cube.model_seeds, b.cube.model_seeds
    matched = [(seeds[0].index(one), seeds[1].index(one)) for one in seeds[0] if one in seeds[1]]
    matched = matched or [(place, place) for place in range(min(map(len, seeds)))]
    return pair(first, second, matched)


def _differing(one: Rows, other: Rows) -> Iterator[str]:
    for simulator in one.names("simulator"):
        revisions = [rows.revisions.get(simulator) for rows in (one, other)]
        if simulator not in other.names("simulator") or revisions[0] == revisions[1]:
            continue
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


def _noise(a: _Side, b: _Side, pairs: Mapping[str, Pairs]) -> list[str]:
    """Say how many episodes flip between two runs of the same system: the noise floor."""
    shares = []
    for condition, here in pairs.items():
        if here.pairs:
            low, high = wilson(here.gained + here.lost, here.pairs)
            shares.append(
                f"{condition} {percent(here.flips)} of {here.pairs} "
                f"(95% interval {100 * low:.1f} to {100 * high:.1f})"
            )
    other = "other" if set(a.cube.model_seeds).isdisjoint(b.cube.model_seeds) else "the same"
    note = (
        f"{a.system} ran in both, with {other} model seeds, in {a.cube.simulator}. If nothing else "
        "differs, this share of episodes flips by itself, which is the noise floor: "
        f"{', '.join(shares)}."
    )
    return [note] if shares else []


def _left_out(name: str, sides: Iterable[_Side], met: Mapping[_Side, _Side]) -> list[str]:
    """Say what one run has and the comparison leaves out, nothing if that is nothing."""
    parts = []
    for side in sides:
        other = met[side].counted if side in met else (lambda condition: set())
        counts = {c: len(side.counted(c) - other(c)) for c in side.conditions}
        if lone := ", ".join(f"{c} ({count:,})" for c, count in counts.items() if count):
            parts.append(f"{side.system} in {side.cube.simulator}, {lone}")
    return [f"Only in {name}, and left out (episodes): {'; '.join(parts)}."] if parts else []
