"""Files that are damaged bit by bit, and buffer sets whose content is changed."""

import json
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from robomme_interference_data.constants import QUESTIONS_PATH
from robomme_interference_data.storage.files import sha256_file

HEADER = "manifests/manifest.json"
ROWS = "manifests/buffers.parquet"


def flipped_bits(path: Path, count: int) -> Iterator[None]:
    """Flip one bit of a file after the other, spread over it; in the end all is as before."""
    data, bits = path.read_bytes(), random.Random(path.name)
    try:
        for number in range(count):
            place = number * (len(data) - 1) // max(1, count - 1)
            flipped = bytearray(data)
            flipped[place] ^= 1 << bits.randrange(8)
            path.write_bytes(flipped)
            yield
    finally:
        path.write_bytes(data)


def edit(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """Change a Parquet file."""
    pq.write_table(change(pq.read_table(path)), path)


def put(table: pa.Table, name: str, values: Any) -> pa.Table:
    """Replace a column's values, with the same type."""
    place = table.column_names.index(name)
    return table.set_column(place, name, pa.array(values, table.schema.field(name).type))


def renew_header(root: Path, **changes: Any) -> None:
    """Record rows and questions as they are now in a buffer set's header; change its fields."""
    path = root / HEADER
    header = json.loads(path.read_text())
    header["rows"] = sha256_file(root / ROWS)
    if (root / QUESTIONS_PATH).is_file():
        header["questions"] = sha256_file(root / QUESTIONS_PATH)
    path.write_text(json.dumps(header | changes))


def reverse_sessions(root: Path) -> None:
    """Reverse the sessions of all buffers, and renew the sum of the rows."""

    def change(table: pa.Table) -> pa.Table:
        sessions = table["sessions"].to_pylist()
        return put(table, "sessions", [row[::-1] for row in sessions])

    edit(root / ROWS, change)
    renew_header(root)
