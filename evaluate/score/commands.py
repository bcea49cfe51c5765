"""The commands `score` and `compare`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

__all__ = ["score"]

_ERR = Console(stderr=True, markup=False, emoji=False)

AsJson = Annotated[bool, typer.Option("--json", help="Print as JSON on stdout.")]


def score(
    rows: Annotated[list[Path], typer.Argument(help="Folders of runs, or CSV or parquet files.")],
    out: Annotated[Path, typer.Option(help="Folder for tables, figures and the report.")],
    system: Annotated[
        str | None, typer.Option(help="Name of the system of rows that name none.")
    ] = None,
    against: Annotated[
        str | None, typer.Option(help="paper: put the published rates beside these.")
    ] = None,
    grid: Annotated[
        str,
        typer.Option(
            help="Episodes of a complete cell: benchmark (nine families, 50 test episodes each) "
            "or given (those that any of the rows is of)."
        ),
    ] = "benchmark",
    lenient: Annotated[bool, typer.Option(help="Skip and count bad rows.")] = False,
    as_json: AsJson = False,
) -> None:
    """Score rollout rows: tables, statistics, figures and one report.

    Reads rows only, never a simulator, and can be run again at any time.

    Examples:
    robomme-interference score my-run --out my-score

    robomme-interference score rollouts.csv --system retrieval-framesamp-modul --against paper
    --out my-score
    """
    from robomme_interference_data.evaluate.score.cells import main_markdown
    from robomme_interference_data.evaluate.score.scoring import score as compute
    from robomme_interference_data.evaluate.score.tables import write_tables

    found = compute(rows, system, lenient, grid, against == "paper")
    write_tables(list(found.tables.values()), out / "tables")
    typer.echo(main_markdown(found.cells))
