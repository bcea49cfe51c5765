"""How often scores of systems that do not differ find something, and how often intervals hold.

Rows are made up and scored as any others: with several training runs that differ, and as whole
reports of systems with one run. `docs/results/simulated-grids.md` quotes what this prints.
"""

import argparse
import itertools
import tempfile
from pathlib import Path
from typing import Any

from common import positive, print_table
from support.null_rows import NullGrid

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.score.config import Expected, Settings
from robomme_interference_data.evaluate.score.scoring import Score, score
from robomme_interference_data.stats.intervals import wilson

CASES = tuple(itertools.product((0.3,), (3, 5), (50, 150, 450), (0.0, 0.02, 0.05, 0.1)))
"""Rate, training runs, episodes, and deviation of the runs' rates."""

LOW_RATE = (0.05, 3, 150, 0.05)
"""Rates of runs are skewed here."""

CONDITIONS = ("no-history", "k0", "k1", "k3", "k7")


def main() -> None:
    """Simulate and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--grids", type=positive, default=200, help="grids of a case")
    parser.add_argument("--reports", type=positive, default=200, help="reports of a case")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="interference-null-") as name:
        path = Path(name) / "rows.parquet"
        lines = [
            [
                *(f"{100 * rate:g}%", str(runs), str(episodes), f"{100 * spread:g}"),
                *over_runs(
                    path,
                    NullGrid(runs=runs, episodes=episodes, spread=spread, rate=rate),
                    options.grids,
                ),
            ]
            for rate, runs, episodes, spread in (*CASES, LOW_RATE)
        ]
        print_table(
            f"Four equal systems with several training runs, {options.grids} grids.",
            [
                ">rate",
                ">runs",
                ">episodes",
                ">spread",
                ">rates",
                ">effects",
                ">matrix",
                ">interaction",
            ],
            lines,
        )
        lines = [[str(count), *reports(path, count, options.reports)] for count in (3, 12)]
        print_table(
            f"Reports of nine families × 50 episodes, five conditions, {options.reports} each.",
            [">systems", ">primary", ">any table"],
            lines,
        )


def over_runs(path: Path, grid: NullGrid, count: int) -> list[str]:
    """Return the coverage of rates, and the size of tests, in percent."""
    held, found = (
        list[bool](),
        {name: list[bool]() for name in ("effects", "matrix", "interaction")},
    )
    for number in range(count):
        scored = _score(grid.write(path, f"{grid}, {number}"), draws=400)
        held += [row["low"] <= grid.rate <= row["high"] for row in scored.tables["main"].records()]
        for name, of_table in found.items():
            of_table += [row["p"] < 0.05 for row in scored.tables[name].records()]
    shares = [sum(of_table) / len(of_table) for of_table in (held, *found.values())]
    return [f"{100 * share:.1f}" for share in shares]


def reports(path: Path, systems: int, count: int) -> list[str]:
    """Return the share of reports with a finding: of the primary analysis, and of any table."""
    grid = NullGrid(systems, CONDITIONS, FAMILIES, 450)
    primary = whole = 0
    for number in range(count):
        scored = _score(grid.write(path, f"report, {systems}, {number}"), draws=10_000)
        rows = [row for table in scored.tables.values() for row in table.records()]
        primary += any(row.get("primary") and row["p_holm"] < 0.05 for row in rows)
        whole += any(_found(row) for row in rows)
    return [_share(primary, count), _share(whole, count)]


def _score(path: Path, draws: int) -> Score:
    return score(Settings((path,), expected=Expected.OBSERVED), draws)


def _found(row: dict[str, Any]) -> bool:
    return any(
        value is not None and value < 0.05 for name, value in row.items() if name.endswith("_holm")
    )


def _share(found: int, count: int) -> str:
    low, high = wilson(found, count)
    return f"{found / count:.0%} ({100 * low:.0f} to {100 * high:.0f})"


if __name__ == "__main__":
    main()
