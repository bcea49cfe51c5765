"""The record of a run, `rollouts.jsonl`: a line for each rollout."""

from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.json as pa_json

from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.run.record import rows_that_count, whole_lines
from robomme_interference_data.schema.rollouts import KEY_COLUMNS

from .row_format import FileColumns, RowFile, check_count, plain_columns
from .values import record_schema


def read(file: RowFile, names: Sequence[str]) -> FileColumns:
    """Read every finished row, and of other rollouts the last row.

    The types are those of a rollout's row; a row object for each line would take ten times as long.
    """
    path = file.path
    data = whole_lines(path)
    if not data:
        return FileColumns(dict.fromkeys(names, ()), [])
    check_count(data.count(b"\n"))
    columns = plain_columns(path, _parse(path, data, record_schema({*names, *KEY_COLUMNS})))
    keys = [*zip(*(columns[name] for name in KEY_COLUMNS), strict=True)]
    kept = rows_that_count(keys, columns["status"])
    return FileColumns(
        {name: [columns[name][at] for at in kept] for name in names}, [at + 1 for at in kept]
    )


def _parse(path: Path, data: bytes, schema: pa.Schema) -> pa.Table:
    """Parse the lines of a record; name the first damaged one, counted from 1 as editors do."""
    options = pa_json.ParseOptions(schema, unexpected_field_behavior="ignore")

    def parse(part: bytes) -> pa.Table:
        return pa_json.read_json(pa.BufferReader(part), parse_options=options)

    try:
        return parse(data)
    except pa.ArrowInvalid:
        # Its number of a row is that in a block of the file: look for the line in halves.
        lines = data.removesuffix(b"\n").split(b"\n")
        number = 1
        while len(lines) > 1:
            half = len(lines) // 2
            try:
                parse(b"\n".join(lines[:half]))
            except pa.ArrowInvalid:
                lines = lines[:half]
            else:
                number, lines = number + half, lines[half:]
        try:
            parse(lines[0])
        except pa.ArrowInvalid as error:
            reason = str(error).partition("\n")[0].partition(" in row ")[0]
            raise FormatError(
                f"{path}, line {number} (counted from 1) is no row of a rollout: {reason}",
                "Remove the line, and run the command of the run again: it repeats that rollout.",
            ) from None
        raise
