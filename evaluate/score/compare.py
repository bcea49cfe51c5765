"""Compare two runs, or two conditions of one, paired over shared episodes."""

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from robomme_interference_data.constants import RECORDINGS
from robomme_interference_data.errors import InvalidOptionError, named
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.stats.sequential import look_levels
from robomme_interference_data.stats.significance import ALPHA
from robomme_interference_data.viz.tables import Table

from .compare_notes import below_table, differing, left_out, noise_floor, stopped_early
from .rows.reading import CheckedRows, read_rows, renderer_notes
from .sides import Side, Sides, check_scenes, matched_sides, pairs_of, sides_of
from .tables.comparison import (
    ACTION_ERRORS,
    ACTION_ERRORS_NOTE,
    COMPLETE,
    RATES,
    SIDES,
    ComparisonTable,
    comparison_table,
    detectable,
)
from .tables.contrast import LESSON_ONLY, Contrast, Effect, Measure
from .tables.correction import correct


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
    runs: tuple[CheckedRows, ...]


def compare(
    first: Path,
    second: Path | None = None,
    systems: tuple[str | None, str | None] = (None, None),
    lenient: bool = False,
    conditions: Sequence[str] = (),
    look: tuple[int, int] = (1, 1),
    model_seed: int | None = None,
) -> RunComparison:
    """Compare two runs of one simulator over shared conditions and episodes.

    Systems of both runs are compared with themselves. If the runs share no system and hold one
    each, these two are compared. Runs under different shifts can be compared, because their scenes
    are the same. Differences are the second's rate − the first's. Without a second run, two
    `conditions` of the first are compared; with one, also a single condition of both. `look` is the
    number of this look at the data and of all planned ones; with several, intervals and levels
    spend 5% over all looks. `model_seed` is the seed of files that name none.
    """
    _check_arguments(first, second, conditions, systems, lenient=lenient)
    if len(conditions) == 1:
        conditions = (conditions[0], conditions[0])  # the same in both runs
    alpha = look_levels(look[1])[look[0] - 1] if look[1] > 1 else ALPHA
    a_rows = _read(first, "system_a", systems[0], lenient, model_seed)
    b_rows = a_rows
    if second is not None:
        b_rows = _read(second, "system_b", systems[1], lenient, model_seed)
    runs = (a_rows,) if second is None else (a_rows, b_rows)
    measure = _measure(runs)
    check_scenes(a_rows, b_rows)
    a_sides, b_sides = sides_of(a_rows), sides_of(b_rows)
    matched = list(matched_sides((a_rows, b_rows), (a_sides, b_sides)))
    notes = [*dict.fromkeys(note for rows in runs for note in rows.notes)]
    notes += renderer_notes(header for rows in runs for header in rows.sources.values())
    notes += differing(a_rows, b_rows, matched)
    contrasts = list[Contrast]()
    for a, b in matched:
        own = list(_contrasts(a, b, conditions, measure, alpha))
        contrasts += own
        repeated = a.repeats(b, a_rows, b_rows) and not conditions
        if repeated and measure is Measure.SUCCESS:
            overall = {each.condition: each.pairs for each in own if not each.family}
            notes += noise_floor(a, b, overall)
    if not contrasts:
        raise _nothing_shared((first, second), (a_sides, b_sides), conditions)
    contrasts = correct(contrasts, alpha)
    notes += stopped_early("a", a_sides.values())
    if second is not None:
        notes += stopped_early("b", b_sides.values())
    notes += left_out("a", a_sides.values(), dict(matched), conditions)
    notes += left_out("b", b_sides.values(), {b: a for a, b in matched}, conditions[::-1])
    table = _table(
        contrasts, measure, alpha, "Two runs compared" if second else "Two conditions compared"
    )
    note = [f"a: {first}; b: {second or first}.", table.note, *below_table(runs, look, alpha)]
    return RunComparison(replace(table, note=" ".join(note)), tuple(notes), runs)


def _nothing_shared(
    paths: tuple[Path, Path | None], runs: tuple[Sides, Sides], conditions: Sequence[str]
) -> InvalidOptionError:
    """Return the error for runs without an episode that counts in both."""
    given = " and ".join(str(path) for path in paths if path)
    under = " and ".join(conditions) or "a common condition"
    held = [
        "; ".join(f"{side.system}: {', '.join(side.conditions)}" for side in sides.values())
        for sides in runs
    ]
    return InvalidOptionError(
        f"no episode of {given} counts on both sides under {under}",
        f"They hold {' and '.join(dict.fromkeys(held))}. Compare the same episodes.",
    )


def _measure(runs: Sequence[CheckedRows]) -> Measure:
    """Return what is compared; the rows of all runs must be of one kind."""
    offline = {row.simulator == RECORDINGS for rows in runs for row in rows}
    if len(offline) > 1:
        raise InvalidOptionError(
            "the rows are of rollouts and of offline runs",
            "Compare runs of one kind: a success rate has no counterpart in an action error.",
        )
    return Measure.ACTION_ERROR if True in offline else Measure.SUCCESS


def _contrasts(
    a: Side, b: Side, conditions: Sequence[str], measure: Measure, alpha: float
) -> Iterator[Contrast]:
    """Compare two sides under each condition, over all families and in each."""
    compared = [(conditions[0], conditions[1])] if conditions else [(c, c) for c in a.conditions]
    compared = [(before, after) for before, after in compared if before in a.conditions]
    compared = [(before, after) for before, after in compared if after in b.conditions]
    for family in ("", *a.outcomes.families):
        for before, after in compared:
            pairs = pairs_of(a, b, (before, after), family)
            if pairs.n:
                bounds = pairs.at(1 - alpha)
                yield Contrast(
                    a.outcomes.simulator,
                    b.system,
                    after,
                    (a.system, before),
                    Effect.RUNS,
                    pairs,
                    a.complete(before) and b.complete(after),
                    measure=measure,
                    family=family,
                    columns={"low": bounds.low, "high": bounds.high},
                    group=bool(family),
                )


def _table(contrasts: Sequence[Contrast], measure: Measure, alpha: float, title: str) -> Table:
    """Return the comparisons with the columns of the tables of effects, and the family."""
    success = measure is Measure.SUCCESS
    spec = ComparisonTable(
        name="compare",
        title=title,
        columns=SIDES | {"family": "text"} | (RATES if success else ACTION_ERRORS) | COMPLETE,
        corrected="the rows of all families, and among those of single families, of a simulator",
        note=(
            "system and condition are of b, those against are of a. Over the n episodes that count "
            "in both; difference is b − a, and gained and lost are changes from a to b."
        ),
        explain=success,
        alpha=alpha,
    )
    table = comparison_table(spec, contrasts)
    if success:
        more = detectable(contrasts)
    else:
        more = f"A negative difference is better. {ACTION_ERRORS_NOTE}"
    return replace(table, note=f"{table.note} {more}".strip())


def _read(
    path: Path, option: str, system: str | None, lenient: bool, model_seed: int | None = None
) -> CheckedRows:
    """Read the rows of one side; `option` is the setting that states its system."""
    systems = () if system is None else (system,)
    seeds = () if model_seed is None else (model_seed,)
    return read_rows([path], systems, lenient, seeds, option)


def _check_arguments(
    first: Path,
    second: Path | None,
    conditions: Sequence[str],
    systems: tuple[str | None, str | None],
    *,
    lenient: bool,
) -> None:
    if second is None and systems[1] is not None:
        raise InvalidOptionError(
            f"{named('system_b', systems[1])} without a second run",
            f"Give the other run, or state the system of the one run: {named('system_a')}.",
            option="system_b",
        )
    for name in conditions:
        parse_condition(name)
    if len(conditions) > 2 or (second is None and len({*conditions}) < 2):
        hint, command = _two_conditions(first, _read(first, "system_a", systems[0], lenient))
        raise InvalidOptionError(
            f"conditions to compare: {' '.join(conditions) or 'none'}; expected two different "
            "ones, or two runs and at most two conditions",
            hint,
            command,
        )
    if second is not None and first.exists() and second.exists() and first.samefile(second):
        hint, command = _two_conditions(first, _read(first, "system_a", systems[0], lenient))
        raise InvalidOptionError(f"{first} is given twice", hint, command)


def _two_conditions(path: Path, rows: CheckedRows) -> tuple[str, str | None]:
    """Return a hint and a command that compare two conditions of a run, if it holds two."""
    held = sorted(rows.names("condition"), key=lambda name: parse_condition(name).sort_key)
    names = ", ".join(held) or "no rows"
    if len(held) < 2:
        return f"{path} holds {names}: give another run.", None
    # As in the tables: against k0, or else the first condition.
    before = LESSON_ONLY if LESSON_ONLY in held[:-1] else held[0]
    command = f"compare {shlex.quote(str(path))} --conditions {before},{held[-1]}"
    return f"{path} holds {names}. Compare two of them, such as:", command
