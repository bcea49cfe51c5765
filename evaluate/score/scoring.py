"""Score rows of rollouts: from rows to tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from robomme_interference_data.errors import RunError, counted, named
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.stats.bootstrap import DRAWS
from robomme_interference_data.stats.intervals import wilson
from robomme_interference_data.viz.tables import Table, percent

from .config import Against, Expected, Settings
from .outcomes import Outcomes
from .partners import base_of, ceilings_of
from .placing import offline_outcomes, outcomes_of
from .rows.reading import CheckedRows, read_rows, renderer_notes
from .tables import decay, effects, families, interaction, ranks
from .tables.cells import SuccessCell, cells_of
from .tables.contrast import Contrast
from .tables.correction import correct, with_primary
from .tables.cost import cost_table
from .tables.main import main_table, parts_table

if TYPE_CHECKING:
    from .tables.action_error import ErrorCell

TABLES = (
    "main",
    "parts",
    "cost",
    "effects",
    "interaction",
    "equivalence",
    "evidence_effects",
    "evidence_use",
    "decay",
    "families",
    "matrix",
    "action_error",
    "action_error_effects",
    "paper",
)
"""Every table that a score may have, in order."""


@dataclass(frozen=True)
class Score:
    """Everything that is computed from rows.

    Attributes:
        settings: The settings.
        draws: Number of bootstrap samples.
        rows: The rows.
        notes: Sentences for readers, such as that two systems are not paired, and how many
            outcomes flip between repeats.
        outcomes: Outcomes of the rollouts, by simulator.
        recordings: Outcomes of offline runs; None without any.
        contrasts: All comparisons, in the order of tables.
        published: The published rates, if the score is compared with them.
        cells: System × condition, over all episodes, by family and by difficulty.
        error_cells: The same of offline runs, over all episodes and by family.
        tables: All tables with rows by name, except the paper's main table.
    """

    settings: Settings
    draws: int
    rows: CheckedRows
    notes: tuple[str, ...]
    outcomes: Mapping[str, Outcomes]
    recordings: Outcomes | None
    contrasts: Sequence[Contrast]
    published: Sequence[SuccessCell]
    cells: Sequence[SuccessCell]
    error_cells: Sequence["ErrorCell"]
    tables: Mapping[str, Table]

    @property
    def all_outcomes(self) -> list[Outcomes]:
        """The outcomes of each simulator, and of recordings."""
        recordings = [] if self.recordings is None else [self.recordings]
        return [*self.outcomes.values(), *recordings]

    @cached_property
    def grids(self) -> list[Table]:
        """The paper's main table for each simulator, and one of action errors."""
        from .tables.grids import error_grid, main_grids  # for pages, not for numbers

        grids = main_grids(self.cells)
        if self.recordings is not None:
            grids.append(error_grid(self.recordings, self.error_cells))
        return grids

    def is_reference(self, simulator: str, system: str) -> bool:
        """Whether a system is only a reference in a simulator, which is never ranked."""
        return any(
            outcomes.is_reference(system)
            for outcomes in self.all_outcomes
            if outcomes.simulator == simulator and system in outcomes.systems
        )


def score(settings: Settings, draws: int = DRAWS) -> Score:
    """Score rows, with a number of bootstrap samples."""
    rows = _rows(settings)
    outcomes = outcomes_of(rows, settings.expected)
    simulated = tuple(outcomes.values())
    recordings = offline_outcomes(rows)
    cells = cells_of(simulated)
    compared, unpaired = _compared(simulated, draws)
    contrasts = correct(with_primary(compared, simulated))
    notes = [*rows.notes, *renderer_notes(rows.sources.values()), *unpaired]
    notes += [run.probe_note for run in rows.sources.values() if run and run.probe_note]
    notes += [sentence for each in simulated if (sentence := repeat_noise(each))]
    notes += [sentence for each in simulated for sentence in _unknown_runs(each)]
    tables = [*_tables(outcomes, cells, contrasts, draws), cost_table(rows, cells)]
    error_cells = list["ErrorCell"]()
    if recordings is not None:
        error_cells, errors, error_tables = _offline(recordings, draws)
        contrasts += errors
        tables += error_tables
        notes += _not_compared_offline(recordings)
    published: Sequence[SuccessCell] = ()
    if settings.against is Against.PAPER and not simulated:
        notes.append(
            f"{named('against', settings.against)} has no effect on recordings: the paper has no "
            "action errors."
        )
    elif settings.against is Against.PAPER:
        from .tables import paper  # only for this setting

        published = paper.published()
        # The paper's rates are over the benchmark's grid.
        whole = cells_of(outcomes_of(rows, Expected.BENCHMARK).values())
        tables.append(paper.paper_table(whole))
        notes += paper.not_compared(whole)
    if settings.margin is not None:
        from .tables.equivalence import equivalence_table  # only for this setting

        tables.append(equivalence_table(contrasts, cells, published, settings.margin))
    filled = {table.name: table for table in tables if table.rows}
    return Score(
        settings,
        draws,
        rows,
        tuple(notes),
        outcomes,
        recordings,
        contrasts,
        published,
        cells,
        error_cells,
        {name: filled[name] for name in TABLES if name in filled},
    )


def _tables(
    outcomes: Mapping[str, Outcomes],
    cells: Sequence[SuccessCell],
    contrasts: Sequence[Contrast],
    draws: int,
) -> list[Table]:
    """Return the tables of rollouts that need no setting, in any order and some without rows."""
    simulated = tuple(outcomes.values())
    main = main_table(cells)
    # What only some rows have is imported for these alone.
    if any(cell.chance >= 0 for cell in cells):
        from .tables.chance import with_chance

        main = with_chance(main, outcomes, cells)
    tables = [
        main,
        parts_table(cells, simulated, contrasts),
        effects.effects_table(contrasts),
        interaction.interaction_table(contrasts),
        decay.decay_table(simulated, draws),
        families.families_table(simulated, contrasts),
        ranks.matrix_table(contrasts),
    ]
    if any((each.evidence >= 0).any() for each in simulated):
        from .tables.evidence_kept import evidence_tables

        tables += evidence_tables(simulated)
    return tables


def _offline(
    recordings: Outcomes, draws: int
) -> "tuple[list[ErrorCell], list[Contrast], list[Table]]":
    """Return cells, corrected comparisons and tables of offline runs."""
    from .tables import action_error, action_error_effects  # only for these runs

    cells = action_error.error_cells(recordings, draws)
    contrasts = correct(action_error_effects.error_contrasts(recordings, draws))
    tables = [action_error.error_table(cells), action_error_effects.error_effects_table(contrasts)]
    return cells, contrasts, tables


def _rows(settings: Settings) -> CheckedRows:
    """Read the rows, of which some must be valid and no errors."""
    rows = read_rows(settings.rows, settings.system, settings.lenient, settings.model_seed)
    if all(row.status == Status.ERROR for row in rows):
        sources = ", ".join(map(str, settings.rows))
        raise RunError(
            f"{counted(len(rows), 'row')} in {sources}, and all are errors: there is nothing to "
            "score",
            "See errors.log of the run, mend the cause, and run the same evaluate command again.",
        )
    return rows


def _compared(all_outcomes: Sequence[Outcomes], draws: int) -> tuple[list[Contrast], list[str]]:
    """Return all comparisons of rollouts, and notes on systems that are not paired."""
    contrasts, notes = list[Contrast](), list[str]()
    for outcomes in all_outcomes:
        for system in outcomes.systems:
            ceiling = next(iter(ceilings_of(outcomes, system)), None)
            partners = {"base": base_of(outcomes, system), "ceiling": ceiling}
            for relation, partner in partners.items():
                why = "" if partner is None else _unpaired(outcomes, system, partner)
                if why:
                    partners[relation] = None
                    simulator = outcomes.simulator
                    notes.append(f"{system} and {partner} in {simulator} are not paired: {why}.")
            contrasts += effects.effects_of(outcomes, system, **partners)
        contrasts += ranks.system_pairs(outcomes)
        contrasts += interaction.interactions_of(outcomes, draws)
    return contrasts, notes


def repeat_noise(outcomes: Outcomes) -> str:
    """Return a sentence on how often two repeats of a rollout disagree; empty without repeats."""
    pairs, flips = outcomes.repeat_flips
    if not pairs:
        return ""
    low, high = wilson(flips, pairs)
    return (
        f"In {outcomes.simulator}, {flips:,} of {pairs:,} repeated rollouts "
        f"({percent(flips / pairs)}, 95% interval {100 * low:.1f} to {100 * high:.1f}) have "
        "another outcome with the next model seed: between conditions, a share of flips that does "
        "not exceed this is noise."
    )


def _unknown_runs(outcomes: Outcomes) -> list[str]:
    """Return a note for each system only some of whose rows state the seed of their training."""
    notes = []
    for system, status in zip(outcomes.systems, outcomes.status, strict=True):
        ran = (status >= 0).any(axis=(0, 1)).tolist()
        seeds = {
            repeat.training_seed for repeat, has in zip(outcomes.repeats, ran, strict=True) if has
        }
        if None in seeds and len(seeds) > 1:
            notes.append(
                f"Some rows of {display_name(system)} state no training_seed, others do: those "
                "without it count as a training run of their own."
            )
    return notes


def _not_compared_offline(recordings: Outcomes) -> list[str]:
    """Return a note on systems offline that are not compared with others, if there are any."""
    names = [
        name
        for name, without in zip(recordings.systems, recordings.without_revision, strict=True)
        if without
    ]
    if not names or len(recordings.systems) == 1:
        return []
    verb = "is" if len(names) == 1 else "are"
    return [
        f"Offline, {', '.join(names)} {verb} compared with no other system: the rows name no "
        "revision of a buffer set, so the recordings may differ."
    ]


def _unpaired(outcomes: Outcomes, system: str, other: str) -> str:
    """Return why two systems cannot be paired; empty if they can."""
    if not outcomes.pairable(system, other):
        names = [name for name in (system, other) if outcomes.lacks_revision(name)]
        return (
            f"the rows of {' and '.join(names)} name no revision of a buffer set, so their "
            "histories may differ"
        )
    steps = [next(iter(outcomes.facts_of(name))).retrieval for name in (system, other)]
    if None not in steps and steps[0] != steps[1]:
        return f"their retrieval steps differ: {' and '.join(map(str, steps))}"
    return ""
