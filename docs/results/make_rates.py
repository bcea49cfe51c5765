"""Write training/rates.csv: how rollouts of each system end, also by family and training seed.

Beside the names that training.md explains, `wide` is `mixture` with same-k3, held-k3 and parts-k3
in training, `long` with k15 and k31; `window` has the last 32 frames in memory, `full` all;
`sampled` has 32 even samples, trained as `full`: 800 batches of 8, no attention dropout; `acted`
are rollouts that carry out a learner's answers.
"""

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import pyarrow.parquet as pq

FOLDER = Path(__file__).parent / "training"
KEY = ("system", "condition", "shift", "family", "training_seed")
ALL = "all"


def rates() -> str:
    """Return the table as CSV.

    `family` and `training_seed` are `all` where they are pooled. What is neither a success nor a
    timeout ended at its first wrong act, `fail_step` steps after the beginning (the median; empty
    for answers, which take no steps).
    """
    cells: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for path in sorted(FOLDER.glob("*.parquet")):
        for row in pq.read_table(path).to_pylist():
            for key in _keys(row):
                cells.setdefault(key, []).append(row)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow((*KEY, "n", "successes", "timeouts", "fail_step"))
    writer.writerows((*key, *_counts(cells[key])) for key in sorted(cells))
    return text.getvalue()


def _keys(row: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """Yield the lines of the table in which a rollout counts."""
    cell = str(row["system"]), str(row["condition"]), str(row["shift"])
    yield *cell, ALL, ALL
    yield *cell, str(row["family"]), ALL
    yield *cell, ALL, str(row["training_seed"])


def _counts(rows: list[dict[str, Any]]) -> tuple[int, int, int, str]:
    """Return the values of a line."""
    failed = [row["steps"] for row in rows if row["status"] == "fail" and row["steps"]]
    return (
        len(rows),
        sum(row["success"] for row in rows),
        sum(row["status"] == "timeout" for row in rows),
        f"{median(failed):g}" if failed else "",
    )


if __name__ == "__main__":
    (FOLDER / "rates.csv").write_text(rates(), encoding="utf-8")
