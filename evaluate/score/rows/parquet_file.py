"""Parquet files with a row for each rollout, as runs export them."""

from collections.abc import Sequence

from robomme_interference_data.storage.parquet import open_parquet, read_table

from .columns import select, with_outcomes
from .row_format import FileColumns, RowFile, check_count, plain_columns


def read(file: RowFile, names: Sequence[str]) -> FileColumns:
    """Read those of the named columns that the file has."""
    path = file.path
    with open_parquet(path) as opened:
        check_count(opened.metadata.num_rows)
        selected = select(path, opened.schema_arrow.names, names)
        table = read_table(opened, path, list(selected.values()))
    columns = plain_columns(path, table)
    return with_outcomes(
        FileColumns(
            {name: columns[column] for name, column in selected.items()}, range(1, len(table) + 1)
        )
    )
