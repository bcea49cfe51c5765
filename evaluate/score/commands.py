"""The commands `score`, `compare` and `power`."""

import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robomme_interference_data.cli.console import (
    check_output,
    command_line,
    echo,
    print_json,
    print_status,
)
from robomme_interference_data.cli.options import AsJson, split_commas, with_settings
from robomme_interference_data.errors import InvalidOptionError, counted, named

from .config import Settings

if TYPE_CHECKING:
    from .planning import PowerPlan
    from .rows.reading import CheckedRows


_OUTPUT = "Output"

_MEMORY_BYTES = 8 << 30
"""Memory for scoring rows, which may come from strangers: reading a million takes 1.4 GB."""


@with_settings
def score(
    settings: Settings,
    out: Annotated[
        Path,
        typer.Option(help="Folder for tables, figures and the report.", rich_help_panel=_OUTPUT),
    ],
    export_to: Annotated[
        Path | None,
        typer.Option(
            "--export",
            help="Also write the rows to this folder, in the layout of the released CSVs.",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
    png: Annotated[
        bool, typer.Option("--png", help="Also write figures as PNG.", rich_help_panel=_OUTPUT)
    ] = False,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Also write figures as PDF.", rich_help_panel=_OUTPUT)
    ] = False,
    as_json: AsJson = False,
) -> None:
    r"""Score rollouts: write tables, statistics, figures and a report.

    Reads rows only, without a simulator.

    Examples:
    ```
    robomme-interference score my-run another-run --out my-score
    robomme-interference score canonical_rollouts.csv retrieval_rollouts.csv \
      --against paper --out my-score
    robomme-interference score act/eval_info.json pi0/eval_info.json \
      --system act --system pi0 --out my-score
    ```
    """
    from robomme_interference_data.progress import WorkProgress
    from robomme_interference_data.runtime.memory import memory_limit
    from robomme_interference_data.viz.tables import tables_text

    from .report.headline import headlines
    from .scoring import score as compute
    from .writing import write_score

    check_output(out, export_to)
    with memory_limit(_MEMORY_BYTES):
        scored = compute(settings)
    _print_notes([scored.rows], scored.notes)
    with WorkProgress() as progress, progress.status("Drawing the figures"):
        formats = [suffix for suffix, wanted in ((".png", png), (".pdf", pdf)) if wanted]
        exported = write_score(scored, out, export_to, command_line(), formats)
    for path in exported:
        print_status(f"{path} written")
    if as_json:
        print_json(
            {
                "headlines": headlines(scored),
                "rows": len(scored.rows),
                "bad_rows": scored.rows.bad_count,
                "notes": list(scored.notes),
                "expected": settings.expected,
                "tables": {name: table.records() for name, table in scored.tables.items()},
            }
        )
    else:
        echo(f"{tables_text(scored.grids)}\n")
    print_status(f"Report: {out / 'report.html'}")


def compare(
    run_a: Annotated[Path, typer.Argument(help="Folder of a run, or file of rows.")],
    run_b: Annotated[
        Path | None, typer.Argument(help="The other run; omit it to compare conditions of one run.")
    ] = None,
    conditions: Annotated[
        list[str] | None,
        typer.Option(
            help="A condition of A and one of B, such as k0,k7; by default each with itself.",
            metavar="NAME,…",
            callback=split_commas,
        ),
    ] = None,
    system_a: Annotated[
        str | None, typer.Option(help="Name of the system in A, if its rows state none.")
    ] = None,
    system_b: Annotated[
        str | None, typer.Option(help="Name of the system in B, if its rows state none.")
    ] = None,
    lenient: Annotated[
        bool, typer.Option("--lenient", help="Leave out bad rows and count them.")
    ] = False,
    looks: Annotated[
        str,
        typer.Option(
            help="To compare runs before they end: the number of this look at the data, and of all "
            "that are planned, equally spaced. Intervals and levels become stricter.",
            metavar="LOOK/OF",
        ),
    ] = "1/1",
    model_seed: Annotated[
        int | None,
        typer.Option(
            help="Seed of the rollouts in files that state none, such as lerobot-eval's --seed."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    r"""Compare two runs, or two conditions of one run, paired over shared episodes.

    Runs under different shifts can be compared: the difference is the effect of the shift.

    Examples:
    ```
    robomme-interference compare my-run my-run-with-retrieval
    robomme-interference compare my-run --conditions k0,k7 --looks 2/5
    robomme-interference compare my-run rollouts.csv \
      --system-b retrieval-framesamp-modul
    ```
    """
    from robomme_interference_data.runtime.memory import memory_limit

    from .compare import compare as compute

    look = _look(looks)
    with memory_limit(_MEMORY_BYTES):
        systems = (system_a, system_b)
        compared = compute(run_a, run_b, systems, lenient, conditions or (), look, model_seed)
    _print_notes(compared.runs, compared.notes)
    if as_json:
        print_json(
            {
                "bad_rows": [rows.bad_count for rows in compared.runs],
                "notes": list(compared.notes),
                "rows": compared.table.records(),
            }
        )
    else:
        echo(compared.table.text())


def power(
    margin: Annotated[float, typer.Option(help="The difference to find, in points.")] = 5.0,
    episodes: Annotated[int, typer.Option(help="Episodes that both systems run.")] = 450,
    flips: Annotated[
        float,
        typer.Option(
            help="Share of the episodes whose outcomes differ between two systems of equal rates. "
            "Three pairs of trained systems in docs/results/training.md differ in 22 to 28% at k0."
        ),
    ] = 0.25,
    difference: Annotated[
        float,
        typer.Option(
            help="Difference of the two systems that flips are of, in points; it is subtracted. A "
            "row of the table matrix has both."
        ),
    ] = 0.0,
    rate: Annotated[
        float, typer.Option(help="Success rate of two equal systems, for equivalence.")
    ] = 0.5,
    runs: Annotated[
        int | None, typer.Option(help="Training runs of each of two systems, 3 or more.")
    ] = None,
    run_spread: Annotated[
        float,
        typer.Option(
            help="Standard deviation of the success rates of training runs, in points, as in the "
            "table main."
        ),
    ] = 5.0,
    tests: Annotated[
        int, typer.Option(help="Number of tests that are corrected together, such as 66 pairs.")
    ] = 1,
    looks: Annotated[
        int, typer.Option(help="Number of planned looks at the data, equally spaced.")
    ] = 1,
    as_json: AsJson = False,
) -> None:
    r"""Compute which differences a number of episodes can detect.

    Two different systems differ in far more episodes than two runs of one: for systems that were
    scored, take flips and difference of the table matrix. For two runs of one system, the share is
    in the notes of a score with repeats, and in the output of compare.

    Examples:
    ```
    robomme-interference power --margin 5 --episodes 450
    robomme-interference power --flips 0.31 --difference 6.2 \
      --tests 66 --looks 5
    robomme-interference power --margin 10 --runs 5 --run-spread 3
    ```
    """
    from .planning import plan

    by_chance = round(flips - abs(difference) / 100, 12)
    if not 0 <= by_chance <= 1:
        raise InvalidOptionError(
            f"{named('flips', flips)} with a difference of {difference:g} points; expected a "
            "share from 0 to 1 that contains the difference",
            "Take both from one row of the table matrix.",
        )
    over_runs = None if runs is None else (runs, run_spread / 100)
    planned = plan(margin / 100, episodes, by_chance, tests, looks, rate, over_runs)
    if as_json:
        print_json(asdict(planned))
        return
    _print_plan(planned)


def _look(text: str) -> tuple[int, int]:
    from robomme_interference_data.stats.sequential import MAX_LOOKS

    match = re.fullmatch(r"([0-9]{1,2})/([0-9]{1,2})", text)
    look, of = map(int, match.groups()) if match else (0, 0)
    if not 1 <= look <= of <= MAX_LOOKS:
        raise InvalidOptionError.expected(
            "looks", text, f"LOOK/OF, such as 2/5, of at most {MAX_LOOKS}"
        )
    return look, of


def _print_plan(planned: "PowerPlan") -> None:
    from .planning import MAX_RUNS

    margin = 100 * planned.margin
    least = "none" if planned.smallest is None else f"{100 * planned.smallest:.1f} points"
    lines = {
        "noise: 95% range between two equal systems": f"±{100 * planned.noise:.1f} points",
        "smallest difference found with 80% power": least,
        f"power to find {margin:g} points": f"{planned.power:.0%}",
        f"episodes that find {margin:g} points with 80% power": f"{planned.needed:,}",
        f"smallest margin of equivalence with 80% power, at rates of {planned.rate:.0%}": (
            f"±{100 * planned.equal:.1f} points"
        ),
    }
    if planned.runs is not None:
        of_runs, spread = planned.runs, 100 * planned.runs.spread
        which = f"with {of_runs.runs} training runs each that differ by {spread:g} points"
        needed = f"more than {MAX_RUNS}" if of_runs.needed is None else str(of_runs.needed)
        lines |= {
            f"smallest difference {which}": f"{100 * of_runs.smallest:.1f} points",
            f"power to find {margin:g} points {which}": f"{of_runs.power:.0%}",
            f"training runs each that find {margin:g} points with 80% power": needed,
        }
    for look, level in enumerate(planned.looks, start=1):
        at = round(planned.episodes * look / len(planned.looks))
        lines[f"look {look} after {at:,} episodes: significant if p holm is below"] = f"{level:.2g}"
    corrected = f", corrected for {planned.tests:,} tests" if planned.tests > 1 else ""
    flips = f"{100 * planned.flips:g}%"
    echo(f"{planned.episodes:,} episodes, of which {flips} flip by chance{corrected}\n")
    width = max(map(len, lines))
    for name, value in lines.items():
        echo(f"{name:{width}}  {value}")


def _print_notes(runs: "Sequence[CheckedRows]", notes: Sequence[str]) -> None:
    for rows in runs:
        for reason in rows.bad_reasons:
            print_status(f"left out: {reason}")
        if rows.bad_count:
            print_status(f"{counted(rows.bad_count, 'bad row')} left out")
    for note in notes:
        print_status(note)
