"""The commands `score` and `compare`."""

import json
import shlex
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robomme_interference_data.evaluate.score.grid import Grid
from robomme_interference_data.progress import MESSAGES

if TYPE_CHECKING:
    from robomme_interference_data.evaluate.score.rollouts import Rollouts
    from robomme_interference_data.evaluate.score.scoring import Score

__all__ = ["compare", "score"]


AsJson = Annotated[bool, typer.Option("--json", help="Print as JSON on stdout.")]
Lenient = Annotated[bool, typer.Option("--lenient", help="Skip and count bad rows.")]


class Against(StrEnum):
    """What rates can be set against."""

    PAPER = "paper"


def score(
    rows: Annotated[list[Path], typer.Argument(help="Folders of runs, or CSV or parquet files.")],
    out: Annotated[Path, typer.Option(help="Folder for tables, figures and the report.")],
    system: Annotated[
        str | None, typer.Option(help="Name of the system of rows that name none.")
    ] = None,
    against: Annotated[
        Against | None, typer.Option(help="Put the published rates beside these.")
    ] = None,
    grid: Annotated[
        Grid,
        typer.Option(
            help="Episodes of a complete cell: the benchmark's (nine families, test episodes 0 to "
            "49 each), or those that any of the given rows is of."
        ),
    ] = Grid.BENCHMARK,
    lenient: Lenient = False,
    export_to: Annotated[
        Path | None,
        typer.Option("--export", help="Also write the rows here as the released CSVs have them."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Score rollout rows: tables, statistics, figures and one report.

    Reads rows only, never a simulator, and can be run again at any time.

    Examples:
    robomme-interference score my-run another-run --out my-score

    robomme-interference score rollouts.csv --system retrieval-framesamp-modul --against paper
    --out my-score
    """
    from robomme_interference_data.evaluate.score.cells import main_markdown
    from robomme_interference_data.evaluate.score.outputs import write_outputs
    from robomme_interference_data.evaluate.score.scoring import score as compute

    found = compute(rows, system, lenient, grid, against is Against.PAPER)
    _tell_refused(found.rollouts)
    for note in found.notes:
        MESSAGES.print(note)
    with MESSAGES.status("Drawing the figures"):
        command = shlex.join(["robomme-interference", *sys.argv[1:]])
        exported = write_outputs(found, out, export_to, system, command)
    for path in exported:
        MESSAGES.print(f"{path} written")
    if as_json:
        typer.echo(json.dumps(_as_dict(found), indent=2, ensure_ascii=False, allow_nan=False))
    else:
        typer.echo(main_markdown(found.cells))
    MESSAGES.print(f"Report: {out / 'report.html'}")


def _tell_refused(rollouts: "Rollouts") -> None:
    for refusal in rollouts.refusals:
        MESSAGES.print(f"left out: {refusal}")
    if rollouts.refused:
        MESSAGES.print(f"{rollouts.refused:,} bad rows left out")


def _as_dict(found: "Score") -> dict[str, Any]:
    from robomme_interference_data.evaluate.score.headline import headline

    return {
        "headlines": {simulator: headline(found, simulator) for simulator in found.expected},
        "rows": len(found.rollouts.packed),
        "bad_rows": found.rollouts.refused,
        "notes": list(found.notes),
        "grid": found.grid,
        "tables": {name: table.records() for name, table in found.tables.items()},
    }


def compare(
    run_a: Annotated[Path, typer.Argument(help="Folder of a run, or file of rows.")],
    run_b: Annotated[Path, typer.Argument(help="The other one.")],
    system_a: Annotated[
        str | None, typer.Option(help="Name of the system of rows of A that name none.")
    ] = None,
    system_b: Annotated[
        str | None, typer.Option(help="Name of the system of rows of B that name none.")
    ] = None,
    lenient: Lenient = False,
    as_json: AsJson = False,
) -> None:
    """Compare two runs, paired over the episodes that both have.

    Example: robomme-interference compare my-run my-run-with-retrieval
    """
    from robomme_interference_data.evaluate.score.compare import compare as compute

    found = compute(run_a, run_b, (system_a, system_b), lenient)
    for rollouts in found.runs:
        _tell_refused(rollouts)
    for note in found.notes:
        MESSAGES.print(note)
    if as_json:
        bad = [rollouts.refused for rollouts in found.runs]
        value = {"bad_rows": bad, "notes": list(found.notes), "rows": found.table.records()}
        typer.echo(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False))
    else:
        typer.echo(found.table.markdown())
