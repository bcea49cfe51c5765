"""Write a score into a folder: tables, figures, the methods and the report."""

from collections.abc import Sequence
from pathlib import Path

from robomme_interference_data.storage.files import write_text
from robomme_interference_data.viz.figure import MAKER, open_figure
from robomme_interference_data.viz.templates import load_jinja2

from .plots import figures
from .report.methods import methods
from .report.page import write_report
from .rows.export import export
from .scoring import TABLES, Score

_SUFFIXES = (".csv", ".md", ".tex")


def write_score(
    score: Score,
    out: Path,
    export_to: Path | None = None,
    command: str | None = None,
    formats: Sequence[str] = (),
) -> list[Path]:
    """Write tables, figures and the report, each atomically and the report last.

    Tables and figures of an earlier score that this one does not have are removed; other files
    stay. Figures are SVG, and also in `formats` (`.png`, `.pdf`). Returns the files of rows that
    were written to `export_to` in the released layout.
    """
    # Without one of their libraries, this fails before anything is written.
    with open_figure():
        load_jinja2("the report")
    exported = [] if export_to is None else export(score.rows, export_to)
    texts = {f"{name}.csv": table.csv() for name, table in score.tables.items()}
    texts |= {f"{name}.md": table.markdown() for name, table in score.tables.items()}
    texts |= {f"{name}.tex": table.latex() for name, table in score.tables.items()}
    texts["main.md"] = "\n".join(grid.markdown() for grid in score.grids)
    texts["main.tex"] = "\n".join(grid.latex() for grid in score.grids)
    for name, text in texts.items():
        write_text(out / "tables" / name, text)
    for suffix, text in zip((".md", ".bib"), methods(score), strict=True):
        write_text(out / f"methods{suffix}", text)
    drawn = figures.draw_figures(score, out / "figures", (".svg", *formats))
    for name in {f"{table}{suffix}" for table in TABLES for suffix in _SUFFIXES} - texts.keys():
        (out / "tables" / name).unlink(missing_ok=True)
    for figure in figures.FIGURES:
        for drawing in (out / "figures").glob(f"{figure}-*.svg"):
            if MAKER.encode() not in drawing.read_bytes():
                continue  # not written by this program
            for suffix in (".png", ".pdf"):
                if drawing.stem not in drawn or suffix not in formats:
                    drawing.with_suffix(suffix).unlink(missing_ok=True)
            if drawing.stem not in drawn:
                drawing.unlink()
    write_report(score, drawn, out / "report.html", command)
    return exported
