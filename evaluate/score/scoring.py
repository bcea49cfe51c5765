"""A scoring, from rows to tables and to the folder that they are written to."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import BadRowsError
from robomme_interference_data.evaluate.systems import base_of
from robomme_interference_data.stats.bootstrap import DRAWS
from robomme_interference_data.storage.files import write_text
from robomme_interference_data.viz.tables import Table
from robomme_interference_data.viz.templates import load_jinja2

from . import Against, Grid, Settings
from .comparisons import contrasts, effects, equivalence, families, interaction, ranks
from .outcomes import Cube, cubes_of
from .rows.checked import Rows, read_rows
from .tables import cells, chance, paper
from .tables import evidence_kept as access

TABLES = (
    *("main", "chance", "systems", "ranks", "family", "difficulty", "lift", "effects"),
    *(
        "interaction",
        "equivalence",
        "interference",
        "access",
        "ceiling",
        "decay",
        "noise",
        "families",
    ),
    *("family_effects", "matrix", "coverage", "paper", "paper_family"),
)
"""Every table that a score may have."""

_SUFFIXES = (".csv", ".md", ".tex")


@dataclass(frozen=True)
class Score:
    """Everything that is computed from rows.

    Attributes:
        settings: What was asked for.
        draws: Bootstrap samples.
        rows: The rows.
        notes: What a reader must know, such as that two systems are not paired.
        cubes: What came of the rollouts, by simulator.
        contrasts: All comparisons of all systems, in the order of tables.
        published: Rates of the paper, if the score is set against them.
        cells: System × condition, over all episodes, by family and by difficulty.
        tables: All tables by name, the paper's main table aside.
        grids: The paper's main table of each simulator.
    """

    settings: Settings
    draws: int
    rows: Rows
    notes: tuple[str, ...]
    cubes: Mapping[str, Cube]
    contrasts: Sequence[contrasts.Contrast]
    published: Sequence[cells.Cell]
    cells: Sequence[cells.Cell]
    tables: Mapping[str, Table]
    grids: Sequence[Table]


def score(settings: Settings, draws: int = DRAWS) -> Score:
    """Score rows.

    Args:
        settings: What is scored, and how.
        draws: Bootstrap samples.

    Raises:
        BadRowsError: Rows are bad, or there are none; and more, see `rows.read_rows`.
    """
    rows = read_rows(settings.rows, settings.system, settings.lenient)
    if not len(rows):
        where = f"in {', '.join(map(str, settings.rows))}"
        raise BadRowsError(
            f"all {rows.refused:,} rows {where} are bad; the first is {rows.refusals[0]}"
            if rows.refused
            else f"there are no rows {where}",
            "Without any sound row there is nothing to score.",
        )
    cubes = cubes_of(rows, settings.grid)
    compared: list[contrasts.Contrast] = []
    decays: list[tuple[Any, ...]] = []
    notes: list[str] = []
    for cube in cubes.values():
        for system in cube.systems:
            beside = {"base": base_of(system), "ceiling": access.ceiling_of(system)}
            for role, other in beside.items():
                if other is None or other not in cube.systems:
                    beside[role] = None
                elif why := _unpaired(rows, cube, system, other):
                    beside[role] = None
                    notes.append(f"{system} and {other} in {cube.simulator} are not paired: {why}.")
            found, decay = effects.effects_of(cube, system, **beside, draws=draws)
            compared += found
            decays += decay
        compared += ranks.systems_of(cube) + interaction.interactions_of(cube)
    every = cells.cells_of(cubes.values())
    between = [
        chance.chance_table(cubes, every),
        contrasts.contrast_table(compared, "systems"),
        ranks.rank_table(cubes.values(), draws),
    ]
    beyond = [
        contrasts.interaction_table(compared),
        contrasts.contrast_table(compared, "interference"),
        access.access_table(cubes.values()),
        contrasts.contrast_table(compared, "ceiling"),
    ]
    published = paper.published() if settings.against is Against.PAPER else ()
    if settings.margin is not None:
        equal = equivalence.equivalence_table(compared, every, published, settings.margin)
        beyond.insert(1, equal)
    by_family = [
        families.families_table(cubes.values(), compared),
        families.family_effects_table(cubes.values(), compared),
    ]
    tables = [
        cells.rate_table(every, "main"),
        *(one for one in between if one.rows),
        *(cells.rate_table(every, name) for name in ("family", "difficulty")),
        contrasts.lift_table(compared),
        contrasts.contrast_table(compared, "effects"),
        *(one for one in beyond if one.rows),
        effects.decay_table(decays),
        effects.noise_table(cubes.values()),
        *(one for one in by_family if one.rows),
        *(one for one in [contrasts.contrast_table(compared, "matrix")] if one.rows),
        cells.coverage_table(every),
    ]
    if published:
        # The paper's rates are over the benchmark's grid, whatever the grid of this scoring.
        whole = cells.cells_of(cubes_of(rows, Grid.BENCHMARK).values())
        tables += [paper.paper_table(whole), paper.paper_family_table(whole)]
        notes += paper.not_compared(whole)
    return Score(
        settings,
        draws,
        rows,
        tuple(notes),
        cubes,
        compared,
        published,
        every,
        {table.name: table for table in tables},
        cells.main_grids(every),
    )


def _unpaired(rows: Rows, cube: Cube, system: str, other: str) -> str:
    """Return why two systems differ in more than what is asked; nothing if they do not."""
    if not cube.pairable(system, other):
        (lone,) = (one for one in (system, other) if (cube.simulator, one) in rows.unpinned)
        return f"the rows of {lone} name no revision of a split, so their histories may differ"
    steps = [rows.retrieval.get((cube.simulator, one)) for one in (system, other)]
    if None not in steps and steps[0] != steps[1]:
        return f"they are behind other retrieval steps, {' and '.join(map(str, steps))}"
    return ""


def write_score(
    score: Score,
    out: Path,
    export_to: Path | None = None,
    command: str | None = None,
    *,
    png: bool = False,
) -> list[Path]:
    """Write tables, figures and the report, each atomically and the report last.

    What can be refused is refused before anything is written. Tables and figures of an earlier
    score that this one does not have are removed; files of other names stay.

    Args:
        score: What is written.
        out: Folder for `tables/`, `figures/`, `methods.md`, `methods.bib` and `report.html`.
        export_to: Folder for the rows in the released layout (see `export`); None writes none.
        command: The command line that made the score, for the report.
        png: Whether figures are written as PNG, too, not as SVG alone.

    Returns:
        The exported files.

    Raises:
        MissingExtraError: matplotlib or jinja2 is not installed.
        InvalidOptionError: The released layout cannot hold the rows (see `export`).
    """
    from robomme_interference_data.viz.figure import MAKER, open_figure

    from .plots import figures
    from .report import methods
    from .report import page as report
    from .rows import export

    with open_figure():
        load_jinja2("the report")
    exported = [] if export_to is None else export.export(score.rows, export_to)
    texts = {f"{name}.csv": table.csv() for name, table in score.tables.items()}
    texts |= {f"{name}.md": table.markdown() for name, table in score.tables.items()}
    texts |= {f"{name}.tex": table.latex() for name, table in score.tables.items()}
    texts["main.md"] = "\n".join(grid.markdown() for grid in score.grids)
    texts["main.tex"] = "\n".join(grid.latex() for grid in score.grids)
    for name, text in texts.items():
        write_text(out / "tables" / name, text)
    for suffix, text in zip((".md", ".bib"), methods.methods(score), strict=True):
        write_text(out / f"methods{suffix}", text)
    drawn = figures.draw_figures(score, out / "figures", png=png)
    for name in {f"{table}{suffix}" for table in TABLES for suffix in _SUFFIXES} - {*texts}:
        (out / "tables" / name).unlink(missing_ok=True)
    for kind in figures.FIGURES:
        for drawing in (out / "figures").glob(f"{kind}-*.svg"):
            if MAKER.encode() not in drawing.read_bytes():
                continue  # somebody else's
            if drawing.stem not in drawn or not png:
                drawing.with_suffix(".png").unlink(missing_ok=True)
            if drawing.stem not in drawn:
                drawing.unlink()
    report.write_report(score, drawn, out / "report.html", command)
    return exported
