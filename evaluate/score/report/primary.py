"""The first screen of a report: the primary analysis, and the checks that a referee asks for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from robomme_interference_data.evaluate.score.outcomes import Outcomes
from robomme_interference_data.evaluate.score.scoring import Score, repeat_noise
from robomme_interference_data.evaluate.score.tables.cells import part_kind
from robomme_interference_data.evaluate.score.tables.contrast import LESSON_ONLY, Scope
from robomme_interference_data.evaluate.score.tables.grids import part_grid
from robomme_interference_data.viz.tables import Table

from .headline import headline
from .quotes import Sentence, TableRow, rows_of

_BOUNDS = ("if_failures", "if_successes")
"""Columns that are shown only if a rollout broke: without errors, both are the difference."""

_FALLS = (
    "system",
    "condition",
    "against_condition",
    "n",
    "rate",
    "against_rate",
    "difference",
    "joint_low",
    "joint_high",
    "p_holm",
    *_BOUNDS,
    "verdict",
    "complete",
)

_APART = (
    "system",
    "against_system",
    "n",
    "slope",
    "against_slope",
    "difference",
    "joint_low",
    "joint_high",
    "p_holm",
    *_BOUNDS,
    "verdict",
    "complete",
)

_RUNS = ("system", "condition", "runs", "n", "rate", "low", "high", "run_spread", "scope")

_EQUIVALENCE = (
    "system",
    "condition",
    "against_system",
    "against_condition",
    "n",
    "difference",
    "low_90",
    "high_90",
    "margin",
    "verdict",
)


@dataclass(frozen=True)
class Screen:
    """What the first screen shows of one simulator, or of recordings.

    Attributes:
        simulator: The simulator.
        headline: Its main finding.
        tables: Rates, falls, their differences, and more where rows allow it.
        checks: Subject to a sentence: training runs, equivalence, repeats and errors.
    """

    simulator: str
    headline: Sequence[Sentence]
    tables: Sequence[Table]
    checks: Mapping[str, str]

    @property
    def figures(self) -> list[str]:
        """The names of its figures."""
        return [f"family_falls-{self.simulator}"]


def screens(score: Score) -> list[Screen]:
    """Return the first screen of each simulator, and of recordings."""
    screens = []
    for grid, outcomes in zip(score.grids, score.all_outcomes, strict=True):
        simulator = outcomes.simulator
        sentences = headline(score, simulator)
        if outcomes is score.recordings:
            screens.append(Screen(simulator, sentences, [grid], {}))
        else:
            tables = [grid, *_tables(score, simulator)]
            screens.append(Screen(simulator, sentences, tables, _checks(score, outcomes)))
    return screens


def _tables(score: Score, simulator: str) -> list[Table]:
    """Return the tables below the rates, those that have rows."""
    tables = {name: score.tables.get(name) for name in ("effects", "interaction", "equivalence")}
    primary = {"simulator": simulator, "primary": True}
    cells = [cell for cell in score.cells if cell.simulator == simulator]
    kinds = {part_kind(cell.part) for cell in cells if cell.n}
    views = [
        _view(
            rows_of(tables["effects"], **primary),
            _FALLS,
            f"Falls from {LESSON_ONLY}, paired over episodes",
            "difference: rate − against rate, over the n episodes that count under both. joint low "
            "to joint high and p holm: corrected for all falls and differences of falls here.",
        ),
        _view(
            rows_of(tables["interaction"], **primary),
            _APART,
            "Differences of falls between systems",
            "slope: points each time that the sessions double. difference: slope − against slope.",
        ),
        *(part_grid(cells, by) for by in ("family", "ability") if by in kinds),
        _view(
            [row for row in rows_of(score.tables["main"], simulator=simulator) if _repeated(row)],
            _RUNS,
            "Spread over training runs",
            "run spread: the standard deviation of the training runs' rates.",
        ),
        _view(
            rows_of(tables["equivalence"], simulator=simulator),
            _EQUIVALENCE,
            "Equivalence within the margin that was stated",
            "By two one-sided tests at 5%.",
        ),
    ]
    return [view for view in views if view.rows]


def _repeated(row: TableRow) -> bool:
    return bool(row["n"]) and row["runs"] > 1


def _view(rows: Sequence[TableRow], columns: Sequence[str], title: str, note: str) -> Table:
    """Return some columns of some rows of one table; without rows, an empty table."""
    if not rows:
        return Table("", title, {}, [])
    table = rows[0].table
    if not _bounded(rows):
        columns = [name for name in columns if name not in _BOUNDS]
    if all(row["complete"] for row in rows if "complete" in columns):
        columns = [name for name in columns if name != "complete"]
    return replace(
        table,
        title=title,
        columns={name: table.columns[name] for name in columns},
        rows=[[table.rows[row.place][[*table.columns].index(n)] for n in columns] for row in rows],
        note=note,
    )


def _bounded(rows: Sequence[TableRow]) -> bool:
    """Whether errors leave open what a difference is."""
    return any(
        name in row.table.columns and row[name] not in (None, row["difference"])
        for row in rows
        for name in _BOUNDS
    )


def _checks(score: Score, outcomes: Outcomes) -> dict[str, str]:
    """Return a sentence on each check that no table above answers."""
    cells = [row for row in rows_of(score.tables["main"], simulator=outcomes.simulator) if row["n"]]
    checks = {}
    if all(row["scope"] == Scope.CHECKPOINT for row in cells):
        checks["training runs"] = (
            "Fewer than three of each system: intervals and p hold for these checkpoints, not for "
            "other runs of the same training."
        )
    if score.settings.margin is None:
        checks["equivalence"] = (
            "Not tested, because no margin was stated. State one before the rows are seen, with "
            "--margin."
        )
    checks["repeat noise"] = repeat_noise(outcomes) or (
        "Unknown: no rollout was repeated with another model seed. Policies on GPUs are not "
        "deterministic, so that some outcomes flip by chance."
    )
    errors = sum(row["errors"] for row in cells)
    checks["errors"] = (
        f"{errors:,} rollouts broke and count as nothing. if failures and if successes are the "
        "differences if all of them were; where the answer depends on it, there is no verdict."
        if errors
        else "No rollout broke."
    )
    return checks
