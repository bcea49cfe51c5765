"""Collect what day.sh measured: `python docs/results/make_day.py FOLDER` writes day/."""

import csv
import json
import shutil
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

OUT = Path(__file__).parent / "day"


def main(folder: Path) -> None:
    """Write the ceilings, the shortcuts, the grades of retrieval, and the rows."""
    OUT.mkdir(exist_ok=True)
    with (OUT / "ceilings.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("memory", "part", "condition", "queries", "evidence_kept", "success"))
        for path in sorted(folder.glob("ceiling-*.json")):
            memory = path.stem.removeprefix("ceiling-")
            for cell in json.loads(path.read_text(encoding="utf-8")):
                table.writerow((memory, *cell.values()))
    shortcuts = json.loads((folder / "verify.json").read_text(encoding="utf-8"))["day_shortcuts"]
    with (OUT / "shortcuts.csv").open("w", encoding="utf-8", newline="") as file:
        rows = csv.DictWriter(file, shortcuts[0], lineterminator="\n")
        rows.writeheader()
        rows.writerows(shortcuts)
    shutil.copy(folder / "graded/cells.csv", OUT / "retrieval.csv")
    for name in ("asked", "acted"):
        runs = [pq.read_table(path) for path in sorted(folder.glob(f"{name}/*/rollouts.parquet"))]
        pq.write_table(pa.concat_tables(runs), OUT / f"{name}.parquet", compression="zstd")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
