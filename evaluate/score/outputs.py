"""The folder of a score: what is written into it, so that nothing of an earlier score stays."""

from collections.abc import Mapping
from pathlib import Path

from robomme_interference_data.evaluate.score.cells import main_markdown
from robomme_interference_data.evaluate.score.export import export
from robomme_interference_data.evaluate.score.figures import FIGURES, draw_figures
from robomme_interference_data.evaluate.score.report import load_jinja2, write_report
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.page import open_figure
from robomme_interference_data.tables import write_tables

__all__ = ["TABLES", "write_outputs"]

TABLES = (
    *("main", "family", "difficulty", "lift", "effects", "decay", "noise", "coverage"),
    "paper",
)
"""Every table that a score may have."""


def write_outputs(
    score: Score,
    out: Path,
    export_to: Path | None = None,
    system: str | None = None,
    command: str | None = None,
) -> list[Path]:
    """Write tables, figures and the report, each atomically and the report last.

    What can be refused is refused before anything is written. Tables and figures of an earlier
    score that this one does not have are removed; files of other names stay.

    Args:
        score: What is written.
        out: Folder for `tables/`, `figures/` and `report.html`.
        export_to: Folder for the rows in the released layout (see `export`); None writes none.
        system: Name of the system of rows that name none.
        command: The command line that made the score, for the report.

    Returns:
        The exported files.

    Raises:
        MissingExtraError: matplotlib or jinja2 is not installed.
        InvalidOptionError: The released layout cannot hold the rows (see `export`).
    """
    with open_figure():
        load_jinja2()
    exported = [] if export_to is None else export(score.rollouts, export_to, system)
    write_tables(list(score.tables.values()), out / "tables", main_markdown(score.cells))
    figures = draw_figures(score, out / "figures")
    _remove_earlier(out, score, figures)
    write_report(score, figures, out / "report.html", command)
    return exported


def _remove_earlier(out: Path, score: Score, figures: Mapping[str, Path]) -> None:
    for name in TABLES:
        if name not in score.tables:
            for suffix in (".csv", ".md"):
                (out / "tables" / (name + suffix)).unlink(missing_ok=True)
    for kind in FIGURES:
        for drawing in (out / "figures").glob(f"{kind}-*.svg"):
            # A score draws both: a lone file of such a name is somebody else's.
            picture = drawing.with_suffix(".png")
            if drawing.stem not in figures and picture.exists():
                picture.unlink()
                drawing.unlink()
