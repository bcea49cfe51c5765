"""A scoring from rows to tables; everything but pictures and pages."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from robomme_interference_data.bootstrap import DRAWS
from robomme_interference_data.errors import BadRowsError
from robomme_interference_data.evaluate.score.cells import (
    Cell,
    cells_by,
    coverage_table,
    rate_table,
)
from robomme_interference_data.evaluate.score.effect_tables import (
    contrast_table,
    decay_table,
    lift_table,
    noise_table,
)
from robomme_interference_data.evaluate.score.effects import Effects, base_of, effects_of
from robomme_interference_data.evaluate.score.grid import Grid
from robomme_interference_data.evaluate.score.outcomes import (
    Expected,
    Outcomes,
    expected_episodes,
    outcomes_of,
)
from robomme_interference_data.evaluate.score.paper import paper_table
from robomme_interference_data.evaluate.score.rollouts import Rollouts, read_rollouts
from robomme_interference_data.tables import Table

__all__ = ["Score", "score"]


@dataclass(frozen=True)
class Score:
    """Everything that is computed from rows.

    Attributes:
        rollouts: The rows.
        grid: Which episodes a complete cell has.
        against_paper: Whether published rates stand beside ours.
        draws: Bootstrap samples.
        call: The call of `score` that made it, as Python has it.
        notes: What a reader must know, such as that two systems are not paired.
        expected: The episodes of a complete cell, by simulator.
        outcomes: By system and simulator, in the order of tables.
        effects: Of each of `outcomes`.
        cells: System × condition.
        family_cells: The same by family.
        difficulty_cells: The same by difficulty.
        tables: All tables by name.
    """

    rollouts: Rollouts
    grid: Grid
    against_paper: bool
    draws: int
    call: str
    notes: tuple[str, ...]
    expected: dict[str, Expected]
    outcomes: tuple[Outcomes, ...]
    effects: tuple[Effects, ...]
    cells: list[Cell]
    family_cells: list[Cell]
    difficulty_cells: list[Cell]
    tables: dict[str, Table]


def score(
    paths: Sequence[Path],
    system: str | None = None,
    lenient: bool = False,
    grid: Grid = Grid.BENCHMARK,
    against_paper: bool = False,
    draws: int = DRAWS,
) -> Score:
    """Score rows.

    Args:
        paths: Folders of runs, CSVs and parquet files.
        system: Name of the system of rows that name none.
        lenient: Skip and count bad rows.
        grid: Which episodes a complete cell has.
        against_paper: Put the published rates beside ours.
        draws: Bootstrap samples.

    Raises:
        BadRowsError: Rows are bad (see `read_rollouts`), or there are none.
    """
    rollouts = read_rollouts(paths, system, lenient)
    if not len(rollouts.packed) and rollouts.refused:
        raise BadRowsError(
            f"all {rollouts.refused:,} rows are bad; the first is {rollouts.refusals[0]}",
            "Mend them: without any row there is nothing to score.",
        )
    if not len(rollouts.packed):
        raise BadRowsError(
            f"no rows to score in {', '.join(map(str, paths))}",
            "Give the folder of a run that has begun, or a file with rows.",
        )
    outcomes = tuple(outcomes_of(rollouts))
    expected = expected_episodes(rollouts, outcomes, grid)
    bases, notes = _bases(rollouts, outcomes)
    effects = tuple(
        effects_of(one, base, expected[one.simulator], draws)
        for one, base in zip(outcomes, bases, strict=True)
    )
    cells = cells_by(outcomes, expected)
    family_cells = cells_by(outcomes, expected, "family")
    difficulty_cells = cells_by(outcomes, expected, "difficulty")
    tables = [
        rate_table(cells, "main", "Success by system and condition"),
        rate_table(family_cells, "family", "Success by family", "family"),
        rate_table(difficulty_cells, "difficulty", "Success by difficulty", "difficulty"),
        lift_table(effects),
        contrast_table(effects),
        decay_table(outcomes, effects),
        noise_table(outcomes),
        coverage_table(outcomes, expected),
    ]
    if against_paper:
        # The paper's rates are over the benchmark's grid, whatever the grid of this scoring.
        whole = expected_episodes(rollouts, outcomes, Grid.BENCHMARK)
        tables.append(paper_table(cells_by(outcomes, whole)))
    return Score(
        rollouts,
        grid,
        against_paper,
        draws,
        f"score({[str(path) for path in paths]}, system={system!r}, lenient={lenient}, "
        f"grid={str(grid)!r}, against_paper={against_paper}, draws={draws})",
        notes,
        expected,
        outcomes,
        effects,
        cells,
        family_cells,
        difficulty_cells,
        {table.name: table for table in tables},
    )


def _bases(
    rollouts: Rollouts, outcomes: Sequence[Outcomes]
) -> tuple[list[Outcomes | None], tuple[str, ...]]:
    """Return the system without retrieval that each is paired with, and which are not paired.

    Of a split that one names and the other does not, nobody knows that it is the same: released
    rows stand beside one's own, and are not paired with them.
    """
    named = {(one.simulator, one.system): one for one in outcomes}
    bases, notes = [], []
    for one in outcomes:
        base = named.get((one.simulator, base_of(one.system) or ""))
        both = [one] if base is None else [one, base]
        unpinned = [o.system for o in both if (o.simulator, o.system) in rollouts.unpinned]
        if base is not None and len(unpinned) == 1:
            notes.append(
                f"{one.system} and {base.system} in {one.simulator} are not paired: the rows of "
                f"{unpinned[0]} name no revision of a split, so their histories may differ"
            )
            base = None
        bases.append(base)
    return bases, tuple(notes)
