"""Collect what day.sh measured: `python docs/results/make_day.py FOLDER` writes day/.

The spans, rollouts and learner of day/ are of a second build, on a processor of Intel; all else is
of an earlier one, on another machine, whose states differ in the last bits.
"""

import csv
import json
import shutil
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow import csv as arrow_csv

from robomme_interference_data import Rollout, load_buffer_set
from robomme_interference_data.constants import DAYS
from robomme_interference_data.schema.codec import arrow_schema

OUT = Path(__file__).parent / "day"


def main(folder: Path) -> None:
    """Write the spans, the ceilings, the shortcuts, the grades of retrieval, and the rows."""
    OUT.mkdir(exist_ok=True)
    with (OUT / "spans.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("day", "source", "part", "shift", "frames"))
        for name in ("test-days", "train-days"):
            for record in load_buffer_set(folder / name).datasets[DAYS].records():
                for span in record.day.spans:
                    described = (span.source, span.part, span.shift)
                    table.writerow((record.episode_id, *described, span.stop - span.start))
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
    schema = arrow_schema(Rollout)
    types = {field.name: field.type for field in schema}
    options = arrow_csv.ConvertOptions(column_types=types, strings_can_be_null=True)
    runs = [
        arrow_csv.read_csv(path, convert_options=options).cast(schema)
        for path in sorted(folder.glob("learned/*.csv"))
    ]
    pq.write_table(pa.concat_tables(runs), OUT / "learned.parquet", compression="zstd")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
