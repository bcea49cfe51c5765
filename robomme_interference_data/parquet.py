"""Read parquet files: the rows with given values, and one clear error for damaged files.

`pyarrow.parquet.read_table` with filters is left aside: its scanner takes seconds to load, and
can wait forever on a damaged file.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError, InterferenceError

__all__ = ["matching", "read_rows", "reading"]


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what pyarrow raises while the block reads a file into one clear error.

    Raises:
        FormatError: The file is damaged or not a parquet file.
    """
    try:
        yield
    except InterferenceError:
        raise
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        text = str(error).partition("\n")[0]
        raise FormatError(
            f"{path} cannot be read: {text}", "The file is damaged: download or build it again."
        ) from None


def matching(table: pa.Table, equal: Mapping[str, Any]) -> NDArray[np.bool_]:
    """Return for each row whether its columns have the given values, `(N,) bool`."""
    matches = np.ones(len(table), bool)
    for name, value in equal.items():
        column = table[name]
        same = pc.equal(column, pa.scalar(value, column.type)).fill_null(False)
        matches &= same.to_numpy()
    return matches


def read_rows(
    file: pq.ParquetFile, columns: list[str] | None, keep: NDArray[np.bool_] | None = None
) -> Iterator[pa.Table]:
    """Yield rows, row group by row group; groups without a row to keep are not read.

    To know the rows to keep, read the columns that tell: the statistics of a row group may not be
    asked, as pyarrow ends the process where those are damaged.

    Args:
        file: The opened file.
        columns: Columns to yield, None for all.
        keep: For each row of the file whether to yield it, `(N,) bool`; None for all rows.
    """
    first = 0
    for group in range(file.num_row_groups):
        rows = file.metadata.row_group(group).num_rows
        if keep is None:
            yield file.read_row_group(group, columns=columns)
        elif keep[first : first + rows].any():
            table = file.read_row_group(group, columns=columns)
            yield table.filter(keep[first : first + rows])
        first += rows
