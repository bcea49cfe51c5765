"""Compare two runs, or two conditions of one, paired over shared episodes."""

import shlex
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.score.config import Expected
from robomme_interference_data.evaluate.score.outcomes import (
    Outcomes,
    mean_errors,
    offline_outcomes,
    outcomes_of,
)
from robomme_interference_data.evaluate.score.rows.reading import Rows, read_rows
from robomme_interference_data.evaluate.score.rows.values import unshifted
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.simulators.registry import RECORDINGS
from robomme_interference_data.stats.intervals import wilson
from robomme_interference_data.stats.sequential import look_levels
from robomme_interference_data.stats.significance import ALPHA
from robomme_interference_data.stats.signs import sign_flips
from robomme_interference_data.viz.tables import Table, percent

from .contrast import START, Contrast
from .pairs import Pairs, pair, pair_errors
from .tables import ERROR_NOTE, ERROR_TEST, TEST, TableSpec, comparison_table


@dataclass(frozen=True)
class RunComparison:
    """Two runs, compared.

    Attributes:
        table: A row per condition, or for the two compared conditions, then the same by family.
        notes: Warnings, the share of flips between two runs of one system, and what is left out.
        runs: The rows of the runs.
    """

    table: Table
    notes: tuple[str, ...]
    runs: tuple[Rows, ...]


def compare(
    first: Path,
    second: Path | None = None,
    systems: tuple[str | None, str | None] = (None, None),
    lenient: bool = False,
    conditions: Sequence[str] = (),
    look: tuple[int, int] = (1, 1),
) -> RunComparison:
    """Compare two runs of one simulator over shared conditions and episodes.

    Systems of both runs are compared with themselves. If the runs share no system and hold one
    each, these two are compared. Runs under different shifts can be compared, because their scenes
    are the same. Differences are the second's rate − the first's. Without a second run, two
    `conditions` of the first are compared. `look` is the number of this look at the data and of all
    planned ones; with several, intervals and levels spend 5% over all looks.
    """
    _check_arguments(first, second, conditions, systems[0], lenient=lenient)
    alpha = look_levels(look[1])[look[0] - 1] if look[1] > 1 else ALPHA
    one = read_rows([first], systems[0], lenient)
    other = one if second is None else read_rows([second], systems[1], lenient)
    offline = _are_offline(one, other)
    _check_scenes(one, other)
    sides = [_sides(rows) for rows in (one, other)]
    matched = list(_matched((one, other), sides))
    notes = list(_differing(one, other, matched))
    found = list[Contrast]()
    for a, b in matched:
        both = [(conditions[0], conditions[1])] if conditions else [(c, c) for c in a.conditions]
        both = [two for two in both if two[0] in a.conditions and two[1] in b.conditions]
        parts = ("", *a.outcomes.families)
        pairs = {(part, two): _pairs(a, b, two, part) for part in parts for two in both}
        for (family, (before, after)), compared in pairs.items():
            if compared.n:
                names = (a.outcomes.simulator, b.system, after, (a.system, before), "compare")
                complete = a.complete(before) and b.complete(after)
                bounds = compared.at(1 - alpha)
                more = {"low": bounds.low, "high": bounds.high}
                found.append(Contrast(*names, compared, complete, family=family, more=more))
        if a.repeats(b, one, other) and not conditions and not offline:
            notes += _noise(a, b, {c: pairs["", (c, c)] for c, _ in both})
    if not found:
        runs = " and ".join(str(path) for path in (first, second) if path)
        under = " and ".join(conditions) or "a common condition"
        existing = [
            "; ".join(f"{b.system}: {', '.join(b.conditions)}" for b in one.values())
            for one in sides
        ]
        raise InvalidOptionError(
            f"no episode of {runs} counts on both sides under {under}",
            f"They hold {' and '.join(dict.fromkeys(existing))}. Compare the same episodes.",
        )
    for name, own in zip("ab", sides, strict=True):
        if other is not one or name == "a":
            notes += _stopped(name, own.values())
    notes += _left_out("a", sides[0].values(), dict(matched), conditions)
    notes += _left_out("b", sides[1].values(), {b: a for a, b in matched}, conditions[::-1])
    title = "Two runs compared" if second else "Two conditions compared"
    table = comparison_table("compare", found, _spec(title, alpha, offline=offline))
    note = f"a: {first}; b: {second or first}. {table.note}"
    if look[1] > 1:
        note += (
            f" Look {look[0]} of {look[1]} (alpha spending like O'Brien and Fleming's boundaries): "
            f"a difference is significant if p holm is below {alpha:.2g}, and intervals have the "
            f"level {1 - alpha:.4%}."
        )
    unplanned = [
        str(path) for rows in (one, other) for path, run in rows.sources.items() if not run
    ]
    if unplanned:
        note += (
            " Without the record of a run, complete means all episodes that occur: "
            f"{', '.join(dict.fromkeys(unplanned))}."
        )
    table = replace(table, note=note)
    return RunComparison(table, tuple(notes), (one,) if other is one else (one, other))


def _are_offline(one: Rows, other: Rows) -> bool:
    """Return whether rows are of offline runs; those of both runs must be of one kind."""
    found = {row.simulator == RECORDINGS for rows in (one, other) for row in rows}
    if len(found) > 1:
        raise InvalidOptionError(
            "the rows are of rollouts and of offline runs",
            "Compare runs of one kind: a success rate has no counterpart in an action error.",
        )
    return True in found


def _spec(title: str, alpha: float, *, offline: bool) -> TableSpec:
    """Return the specification of the table; offline, the action error replaces the rate."""
    if offline:
        values = f"action_l1_a:number=against_rate action_l1_b:number=rate {ERROR_TEST}"
        note = (
            "Over the n episodes that count in both; difference is the action error of b minus "
            f"that of a: negative if b is better. {ERROR_NOTE}"
        )
    else:
        values = f"rate_a=against_rate rate_b=rate difference {TEST}"
        note = (
            "Over the n episodes that count in both; difference is b − a, gained and lost are "
            "changes from a to b. {how}"
        )
    return TableSpec(
        title,
        "simulator system_a=against_system system_b=system family condition_a=against_condition "
        f"condition_b=condition n {values} complete",
        note,
        lambda contrast: (contrast.simulator, bool(contrast.family)),
        "the rows of all families, and among those of single families, of a simulator",
        alpha=alpha,
        power=not offline,
    )


def _check_arguments(
    first: Path,
    second: Path | None,
    conditions: Sequence[str],
    system: str | None,
    *,
    lenient: bool,
) -> None:
    for name in conditions:
        parse_condition(name)
    if len(conditions) not in (0, 2) or (second is None and len({*conditions}) < 2):
        hint, command = _two_conditions(first, read_rows([first], system, lenient))
        raise InvalidOptionError(
            f"conditions to compare: {' '.join(conditions) or 'none'}; expected two different "
            "ones, or two runs",
            hint,
            command,
        )
    if second is not None and first.exists() and second.exists() and first.samefile(second):
        hint, command = _two_conditions(first, read_rows([first], system, lenient))
        raise InvalidOptionError(f"{first} is given twice", hint, command)


def _two_conditions(path: Path, rows: Rows) -> tuple[str, str | None]:
    """Return a hint and a command that compare two conditions of a run, if it holds two."""
    held = sorted(rows.names("condition"), key=lambda name: parse_condition(name).sort_key)
    names = ", ".join(held) or "no rows"
    if len(held) < 2:
        return f"{path} holds {names}: give another run.", None
    # As in the tables: against k0, or else the first condition.
    before = START if START in held[:-1] else held[0]
    command = f"compare {shlex.quote(str(path))} --conditions {before},{held[-1]}"
    return f"{path} holds {names}. Compare two of them, such as:", command


@dataclass(frozen=True, eq=False)
class _Side:
    """One system in one simulator of a run."""

    outcomes: Outcomes
    system: str
    planned: Mapping[str, set[EpisodeId]]  # by condition, in all plans of its runs

    @property
    def conditions(self) -> list[str]:
        return self.outcomes.ran(self.system)

    def complete(self, condition: str) -> bool:
        """Whether all episodes count that occur or are planned."""
        whole = self.outcomes.complete[self.outcomes.cell(self.system, condition)]
        return bool(whole) and self.planned.get(condition, set()) <= self.counted(condition)

    def repeats(self, other: "_Side", rows: Rows, others: Rows) -> bool:
        """Whether another run's side is the same system with the same scenes and histories."""
        name = self.outcomes.simulator
        same = (self.system, name) == (other.system, other.outcomes.simulator)
        return same and rows.revisions.get(name) == others.revisions.get(name)

    def counted(self, condition: str) -> set[EpisodeId]:
        if condition not in self.conditions:
            return set()
        cell = self.outcomes.cell(self.system, condition)
        return {*self.outcomes.chosen(self.outcomes.counted[cell])}


_Sides = dict[tuple[str, str], _Side]


def _sides(rows: Rows) -> _Sides:
    """Return the systems of a run by simulator and name, in the order of tables."""
    planned = defaultdict[str, set[EpisodeId]](set)
    for run in rows.sources.values():
        for item in run.items if run else ():
            planned[item.condition].add(item.episode)
    every = [*outcomes_of(rows, Expected.OBSERVED).values()]
    if recordings := offline_outcomes(rows):
        every.append(recordings)
    return {
        (outcomes.simulator, system): _Side(outcomes, system, planned)
        for outcomes in every
        for system in outcomes.systems
    }


def _matched(runs: Sequence[Rows], sides: Sequence[_Sides]) -> Iterator[tuple[_Side, _Side]]:
    """Yield the sides that are compared, in the order of tables."""
    simulators, systems = ([rows.names(name) for rows in runs] for name in ("simulator", "system"))
    shared = {name: name for name in simulators[0] if name in simulators[1]}
    plain = [{unshifted(name): name for name in names} for names in simulators]
    # The same simulator under different shifts.
    shared = shared or {plain[0][name]: plain[1][name] for name in plain[0] if name in plain[1]}
    if not shared:
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
        if b := sides[1].get((shared.get(simulator, ""), partners.get(system, ""))):
            yield a, b


def _check_scenes(one: Rows, other: Rows) -> None:
    """Check that the two runs have the same seed for each episode."""
    known, others = (
        {
            (unshifted(row.simulator), row.family, row.split, row.episode): row.seed
            for row in rows
            if row.seed is not None
        }
        for rows in (one, other)
    )
    for key, seed in known.items():
        if others.get(key, seed) != seed:
            raise InvalidOptionError(
                f"{'/'.join(map(str, key[1:]))} has the seed {seed} in one run and "
                f"{others[key]} in the other",
                "Different scenes cannot be paired: compare runs over the same episodes.",
            )


def _pairs(a: _Side, b: _Side, conditions: tuple[str, str], family: str) -> Pairs:
    """Compare two sides over shared episodes, all or those of a family."""
    places = [{one: at for at, one in enumerate(side.outcomes.episodes)} for side in (a, b)]
    shared = [one for one in places[0] if one in places[1] and family in ("", one.family)]
    if a.outcomes.simulator == RECORDINGS:
        before, after = (
            mean_errors(side.outcomes.action_l1)[side.outcomes.cell(side.system, condition)][
                [at[one] for one in shared]
            ]
            for side, condition, at in zip((a, b), conditions, places, strict=True)
        )
        [test] = sign_flips((after - before).round(12)[:, None], RECORDINGS)
        return pair_errors(before, after, test)
    first, second = (
        side.outcomes.status[side.outcomes.cell(side.system, condition)][
            [at[one] for one in shared]
        ]
        for side, condition, at in zip((a, b), conditions, places, strict=True)
    )
    # Shared model seeds are paired; without any, the lowest with the lowest, and so on.
    seeds = a.outcomes.model_seeds, b.outcomes.model_seeds
    matched = [(seeds[0].index(one), seeds[1].index(one)) for one in seeds[0] if one in seeds[1]]
    matched = matched or [(place, place) for place in range(min(map(len, seeds)))]
    return pair(first, second, matched)


def _differing(one: Rows, other: Rows, matched: Iterable[tuple[_Side, _Side]]) -> Iterator[str]:
    names = dict.fromkeys((a.outcomes.simulator, b.outcomes.simulator) for a, b in matched)
    for two in names:
        if two[0] != two[1]:
            yield (
                f"a is of {two[0]} and b of {two[1]}: the scenes are the same, and the difference "
                "is the effect of the shift."
            )
        revisions = [rows.revisions.get(name) for rows, name in zip((one, other), two, strict=True)]
        if one is not other and revisions == [None, None]:
            yield (
                f"The rows of {two[0]} name no revision of a buffer set: the histories may differ."
            )
        elif revisions[0] != revisions[1]:
            yield (
                f"The rows of {two[0]} are of different buffer sets (revisions "
                f"{' and '.join(rev or 'unknown' for rev in revisions)}): the histories may "
                "differ."
            )


def _noise(a: _Side, b: _Side, pairs: Mapping[str, Pairs]) -> list[str]:
    """Return a note on the share of episodes that flip between two runs of a system."""
    shares = []
    for condition, compared in pairs.items():
        if compared.pairs:
            low, high = wilson(compared.gained + compared.lost, compared.pairs)
            shares.append(
                f"{condition} {percent(compared.flips)} of {compared.pairs} "
                f"(95% interval {100 * low:.1f} to {100 * high:.1f})"
            )
    seeds, others = {*a.outcomes.model_seeds}, {*b.outcomes.model_seeds}
    which = "the same" if seeds == others else "partly other" if seeds & others else "other"
    note = (
        f"{a.system} ran in both, with {which} model seeds, in "
        f"{a.outcomes.simulator}. If nothing else differs, this share of episodes flips by chance "
        f"(the noise floor): {', '.join(shares)}."
    )
    return [note] if shares else []


def _stopped(name: str, sides: Iterable[_Side]) -> list[str]:
    """Return a note on planned episodes of a run that do not count, if any."""
    parts = [
        f"{side.system} in {side.outcomes.simulator}, {condition} ({lacking:,} of {len(planned):,})"
        for side in sides
        for condition, planned in side.planned.items()
        if (lacking := len(planned - side.counted(condition)))
    ]
    listed = "; ".join(parts)
    note = (
        f"{name} was stopped early, is still running, or broke in part; planned episodes that do "
        f"not count: {listed}. Looking again and again finds too much: plan the looks (--looks)."
    )
    return [note] if parts else []


def _left_out(
    name: str, sides: Iterable[_Side], matched: Mapping[_Side, _Side], conditions: Sequence[str]
) -> list[str]:
    """Return a note on the episodes of a run that the comparison leaves out, if any."""
    parts = []
    for side in sides:
        other = matched[side].counted if side in matched else (lambda condition: set())
        both = [tuple(conditions)] if conditions else [(c, c) for c in side.conditions]
        counts = {c: len(side.counted(c) - other(second)) for c, second in both}
        if lone := ", ".join(f"{c} ({count:,})" for c, count in counts.items() if count):
            parts.append(f"{side.system} in {side.outcomes.simulator}, {lone}")
    return [f"Only in {name}, and left out (episodes): {'; '.join(parts)}."] if parts else []
