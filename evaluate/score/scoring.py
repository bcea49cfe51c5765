"""Score rows of rollouts: from rows to tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from robomme_interference_data.errors import FormatError, RunError, counted
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.stats.bootstrap import DRAWS
from robomme_interference_data.viz.tables import Table

from .comparisons import effects, families, offline, ranks, slopes
from .comparisons.contrast import Contrast
from .comparisons.tables import SPECS, comparison_table
from .config import Against, Expected, Settings
from .outcomes import Outcomes, offline_outcomes, outcomes_of
from .partners import base_of, ceilings_of
from .rows.reading import Rows, read_rows
from .tables import action_error, cells, chance, equivalence, evidence_kept, paper

TABLES = (
    "main",
    "chance",
    "systems",
    "ranks",
    "family",
    "difficulty",
    "lift",
    "effects",
    "interaction",
    "equivalence",
    "interference",
    "by_evidence_kept",
    "evidence_effects",
    "evidence_use",
    "ceiling",
    "decay",
    "noise",
    "families",
    "family_effects",
    "matrix",
    "action_error",
    offline.CHANGES,
    offline.SYSTEMS,
    "coverage",
    "paper",
    "paper_family",
)
"""Every table that a score may have, in order."""


@dataclass(frozen=True)
class Score:
    """Everything that is computed from rows.

    Attributes:
        settings: The settings.
        draws: Number of bootstrap samples.
        rows: The rows.
        notes: Warnings for readers, such as that two systems are not paired.
        outcomes: Outcomes of the rollouts, by simulator.
        recordings: Outcomes of offline runs; None without any.
        contrasts: All comparisons, in the order of tables.
        published: The published rates, if the score is compared with them.
        cells: System × condition, over all episodes, by family and by difficulty.
        error_cells: The same of offline runs, over all episodes and by family.
        tables: All tables with rows by name, except the paper's main table.
        grids: The paper's main table for each simulator, and one of action errors.
    """

    settings: Settings
    draws: int
    rows: Rows
    notes: tuple[str, ...]
    outcomes: Mapping[str, Outcomes]
    recordings: Outcomes | None
    contrasts: Sequence[Contrast]
    published: Sequence[cells.Cell]
    cells: Sequence[cells.Cell]
    error_cells: Sequence[action_error.ErrorCell]
    tables: Mapping[str, Table]
    grids: Sequence[Table]

    @property
    def every(self) -> list[Outcomes]:
        """The outcomes of each simulator, and of recordings."""
        recordings = [] if self.recordings is None else [self.recordings]
        return [*self.outcomes.values(), *recordings]

    def is_reference(self, simulator: str, system: str) -> bool:
        """Whether a system is only a reference in a simulator, which is never ranked."""
        return any(
            outcomes.is_reference(system)
            for outcomes in self.every
            if outcomes.simulator == simulator and system in outcomes.systems
        )


def score(settings: Settings, draws: int = DRAWS) -> Score:
    """Score rows, with a number of bootstrap samples."""
    rows = read_rows(settings.rows, settings.system, settings.lenient)
    if not len(rows):
        where = f"in {', '.join(map(str, settings.rows))}"
        raise FormatError(
            f"all {rows.refused:,} rows {where} are bad; the first is {rows.refusals[0]}"
            if rows.refused
            else f"there are no rows {where}",
            "Give at least one valid row.",
        )
    if all(row.status == Status.ERROR for row in rows):
        raise RunError(
            f"{counted(len(rows), 'row')} in {', '.join(map(str, settings.rows))}, and all are "
            "errors: there is nothing to score",
            "See errors.log of the run, mend the cause, and run the same evaluate command again.",
        )
    outcomes = outcomes_of(rows, settings.expected)
    recordings = offline_outcomes(rows)
    every = tuple(outcomes.values())
    compared, notes = _compared(rows, every, draws)
    error_cells = list[action_error.ErrorCell]()
    error_grids = list[Table]()
    if recordings is not None:
        error_cells = action_error.error_cells(recordings, draws)
        error_grids.append(action_error.error_grid(recordings, error_cells))
        compared += offline.error_contrasts(recordings, draws)
        notes += _unpinned(recordings)
    by_family = [one for outcome in every for one in families.family_effects(outcome, compared)]
    found = cells.cells_of(every)
    published = paper.published() if settings.against is Against.PAPER else ()
    tables = [
        *(cells.rate_table(found, name) for name in ("main", "family", "difficulty")),
        chance.chance_table(outcomes, found),
        ranks.rank_table(every),
        *(comparison_table(name, [*compared, *by_family]) for name in SPECS),
        families.families_table(every, compared),
        *evidence_kept.evidence_tables(every),
        slopes.decay_table(every, draws),
        effects.noise_table(every),
        cells.coverage_table([*found, *error_cells]),
        action_error.error_table(error_cells),
    ]
    if settings.margin is not None:
        margin = settings.margin
        tables.append(equivalence.equivalence_table(compared, found, published, margin))
    if published:
        # The paper's rates are over the benchmark's grid.
        whole = cells.cells_of(outcomes_of(rows, Expected.BENCHMARK).values())
        tables += [paper.paper_table(whole), paper.paper_table(whole, by_part=True)]
        notes += paper.not_compared(whole)
    tables = [one for one in tables if one.rows]
    return Score(
        settings,
        draws,
        rows,
        tuple(notes),
        outcomes,
        recordings,
        compared,
        published,
        found,
        error_cells,
        {table.name: table for table in sorted(tables, key=lambda one: TABLES.index(one.name))},
        [*cells.main_grids(found), *error_grids],
    )


def _compared(
    rows: Rows, every: Sequence[Outcomes], draws: int
) -> tuple[list[Contrast], list[str]]:
    """Return all comparisons, and notes on systems that are not paired."""
    compared, notes = list[Contrast](), list[str]()
    for outcomes in every:
        for system in outcomes.systems:
            ceiling = next(iter(ceilings_of(outcomes, system)), None)
            beside = {"base": base_of(outcomes, system), "ceiling": ceiling}
            for role, other in beside.items():
                if other is not None and (why := _unpaired(rows, outcomes, system, other)):
                    beside[role] = None
                    simulator = outcomes.simulator
                    notes.append(f"{system} and {other} in {simulator} are not paired: {why}.")
            compared += effects.effects_of(outcomes, system, **beside)
        compared += ranks.systems_of(outcomes) + slopes.interactions_of(outcomes, draws)
    return compared, notes


def _unpinned(recordings: Outcomes) -> list[str]:
    """Return a note on systems offline that are not compared with others, if there are any."""
    lone = [
        name
        for name, unpinned in zip(recordings.systems, recordings.unpinned, strict=True)
        if unpinned
    ]
    if not lone or len(recordings.systems) == 1:
        return []
    return [
        f"Offline, {', '.join(lone)} {'is' if len(lone) == 1 else 'are'} compared with no other "
        "system: the rows name no revision of a buffer set, so the recordings may differ."
    ]


def _unpaired(rows: Rows, outcomes: Outcomes, system: str, other: str) -> str:
    """Return why two systems cannot be paired; empty if they can."""
    if not outcomes.pairable(system, other):
        lone = [one for one in (system, other) if (outcomes.simulator, one) in rows.unpinned]
        whose = " and ".join(lone)
        return (
            f"the rows of {whose} name no revision of a buffer set, so their histories may differ"
        )
    steps = [next(iter(outcomes.facts_of(name))).retrieval for name in (system, other)]
    if None not in steps and steps[0] != steps[1]:
        return f"their retrieval steps differ: {' and '.join(map(str, steps))}"
    return ""
