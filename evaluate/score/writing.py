"""Write a score into a folder: tables, figures, the methods and the report."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from errno import EISDIR
from os import strerror
from pathlib import Path
from tempfile import TemporaryDirectory

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
    """Write tables, figures and the report, all of them or none.

    Tables and figures of an earlier score that this one does not have are removed; other files
    stay. Figures are SVG, and also in `formats` (`.png`, `.pdf`). Returns the files of rows that
    were written to `export_to` in the released layout.
    """
    # Without one of their libraries, this fails before anything is written.
    with open_figure():
        load_jinja2("the report")
    exported = [] if export_to is None else export(score.rows, export_to)
    with _moving_to(out) as folder:
        texts = _tables(score)
        for name, text in texts.items():
            write_text(folder / "tables" / name, text)
        for suffix, text in zip((".md", ".bib"), methods(score), strict=True):
            write_text(folder / f"methods{suffix}", text)
        drawn = figures.draw_figures(score, folder / "figures", (".svg", *formats))
        write_report(score, drawn, folder / "report.html", command, opened_in=out)
    for name in {f"{table}{suffix}" for table in TABLES for suffix in _SUFFIXES} - texts.keys():
        (out / "tables" / name).unlink(missing_ok=True)
    _remove_figures(out / "figures", drawn, formats)
    return exported


def _tables(score: Score) -> dict[str, str]:
    """Return the files of tables by name; those of `main` for readers are the paper's grids."""
    texts = {f"{name}.csv": table.csv() for name, table in score.tables.items()}
    texts |= {f"{name}.md": table.markdown() for name, table in score.tables.items()}
    texts |= {f"{name}.tex": table.latex() for name, table in score.tables.items()}
    texts["main.md"] = "\n".join(grid.markdown() for grid in score.grids)
    texts["main.tex"] = "\n".join(grid.latex() for grid in score.grids)
    return texts


def _remove_figures(folder: Path, drawn: Mapping[str, Path], formats: Sequence[str]) -> None:
    """Remove figures of an earlier score that are not drawn now."""
    for figure in figures.FIGURES:
        for drawing in folder.glob(f"{figure}-*.svg"):
            if MAKER.encode() not in drawing.read_bytes():
                continue  # not written by this program
            for suffix in (".png", ".pdf"):
                if drawing.stem not in drawn or suffix not in formats:
                    drawing.with_suffix(suffix).unlink(missing_ok=True)
            if drawing.stem not in drawn:
                drawing.unlink()


@contextmanager
def _moving_to(out: Path) -> Iterator[Path]:
    """Give a temporary folder, whose files move to `out` if the block succeeds.

    A full disk or an interruption while a score is written leaves the earlier one as it was.
    """
    is_new = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    try:
        # Inside `out`: a move to another disk would not be atomic, and could fail in the middle.
        with TemporaryDirectory(dir=out, prefix=".", suffix=".partial") as name:
            folder = Path(name)
            yield folder
            files = sorted(path for path in folder.rglob("*") if path.is_file())
            targets = [out / path.relative_to(folder) for path in files]
            for target in targets:
                if target.is_dir():
                    raise IsADirectoryError(EISDIR, strerror(EISDIR), str(target))
            for target in targets:
                target.parent.mkdir(exist_ok=True)
            for path, target in zip(files, targets, strict=True):
                path.replace(target)
    except BaseException:
        if is_new:
            with suppress(OSError):  # not empty: others wrote into it meanwhile
                out.rmdir()
        raise
