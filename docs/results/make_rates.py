"""Write training/rates.csv: successes of each system, also by family and by training seed."""

import csv
import io
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq

FOLDER = Path(__file__).parent / "training"
COLUMNS = ("system", "condition", "shift", "family", "training_seed", "n", "successes")
ALL = "all"


def rates() -> str:
    """Return the table as CSV; `family` and `training_seed` are `all` where they are pooled."""
    counts: dict[tuple[str, ...], list[int]] = {}
    for path in sorted(FOLDER.glob("*.parquet")):
        for row in pq.read_table(path).to_pylist():
            for key in _keys(row):
                count = counts.setdefault(key, [0, 0])
                count[0] += 1
                count[1] += row["success"]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows((*key, *counts[key]) for key in sorted(counts))
    return text.getvalue()


def _keys(row: dict[str, object]) -> Iterator[tuple[str, ...]]:
    """Yield the lines of the table in which a rollout counts."""
    cell = str(row["system"]), str(row["condition"]), str(row["shift"])
    yield *cell, ALL, ALL
    yield *cell, str(row["family"]), ALL
    yield *cell, ALL, str(row["training_seed"])


if __name__ == "__main__":
    (FOLDER / "rates.csv").write_text(rates(), encoding="utf-8")
