"""Commands that check splits: `verify` and `audit`."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from robomme_interference_data.progress import MESSAGES

__all__ = ["audit", "verify"]

_OUT = Console()

AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]


def verify(
    split: Annotated[Path, typer.Argument(help="Folder of the split.")],
    decode: Annotated[
        bool, typer.Option(help="Decode all frames; without, only tables and rules are checked.")
    ] = True,
    as_json: AsJson = False,
) -> None:
    """Recompute every hash and rule of a split and name each violation; fails if there is one."""
    from robomme_interference_data.build_dataset.verify import verify_split
    from robomme_interference_data.loader import load_split
    from robomme_interference_data.progress import BuildProgress

    opened = load_split(split)
    header = opened.reader.header["datasets"].values()
    with BuildProgress() as progress:
        progress.start("Verifying", sum(d["counts"]["frames"] for d in header) if decode else 0)
        violations = list(verify_split(split, decode=decode, advance=progress.advance))
    if as_json:
        _print_json([{"where": v.where, "what": v.what} for v in violations])
    else:
        for violation in violations:
            _OUT.print(f"{violation.where}: {violation.what}", soft_wrap=True, highlight=False)
        what = "hashes and rules" if decode else "tables and rules (frames not decoded)"
        MESSAGES.print(
            f"{len(violations)} violations" if violations else f"All {what} of {split} hold."
        )
    if violations:
        raise typer.Exit(1)


def audit(
    split: Annotated[Path, typer.Argument(help="Folder of the split.")],
    as_json: AsJson = False,
) -> None:
    """Print how often units are used and where families stand; fails on any leak."""
    from robomme_interference_data.build_dataset.audit import audit_split
    from robomme_interference_data.loader import load_split

    opened = load_split(split)
    report = audit_split(opened.manifests(), opened.datasets, opened.k_values)
    if as_json:
        _print_json(report.as_dict())
    else:
        largest = max(report.units)
        use = Table("k", "units", "min", "mean", "max", "unused", title="Uses of a unit")
        for k in sorted(report.units):
            row = report.usage(k)
            use.add_row(
                str(k),
                str(len(report.units[k])),
                *(f"{row[name]:g}" if name != "mean" else f"{row[name]:.2f}" for name in row),
            )
        _OUT.print(use)
        places = sorted(report.positions)
        mix = Table(
            "family", "units", "uses of a unit", *map(str, places), title=f"Families at k={largest}"
        )
        for family, row in report.family_usage(largest).items():
            mix.add_row(
                family,
                f"{row['units']:g}",
                f"{row['min']:g} to {row['max']:g}, mean {row['mean']:.2f}",
                *(str(report.positions[place][family]) for place in places),
            )
        mix.caption = "Columns 1, 2, …: buffers with the family at that place after the lesson."
        _OUT.print(mix)
        for leak in report.leaks:
            _OUT.print(f"LEAK, {leak.kind}: {leak.where}", soft_wrap=True, highlight=False)
        MESSAGES.print(f"{len(report.leaks)} leaks" if report.leaks else "No leaks.")
    if report.leaks:
        raise typer.Exit(1)


def _print_json(value: object) -> None:
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False))
