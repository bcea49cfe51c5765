"""Parquet files with a row for each rollout, as runs export them."""

from collections.abc import Sequence

from .columns import plain_columns, select, with_outcomes
from .row_format import FileColumns, RowFile, RowFormat, check_count


def _read(file: RowFile, names: Sequence[str]) -> FileColumns:
    # Only for these files: a run is read from its record.
    from robomme_interference_data.storage.parquet import open_parquet, read_table

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


PARQUET = RowFormat("rows of a run as .parquet", lambda file: file.suffix == ".parquet", _read)
