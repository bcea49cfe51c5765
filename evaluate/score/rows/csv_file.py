"""CSV files with a row for each rollout: exported runs, and the paper's released rows."""

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path

from robomme_interference_data.constants import MAX_ROW_BYTES
from robomme_interference_data.errors import FormatError, counted
from robomme_interference_data.storage.csv_text import unquoted
from robomme_interference_data.storage.text import read_text

from .columns import select, with_outcomes
from .row_format import FileColumns, RowFile, check_count

_CANONICAL = "canonical_rollouts.csv"
_CANONICAL_COLUMNS = ("system", "family", "condition", "episode", "difficulty", "success")
"""The columns that the paper's analysis reads. The file has more, with values of their own."""

_RELEASED_SYSTEMS = {"retrieval_rollouts.csv": "retrieval-framesamp-modul"}
"""File of released rows without a column for the system, to the system in `SYSTEMS`."""


def read(file: RowFile, names: Sequence[str]) -> FileColumns:
    """Read those of the named columns that the file has."""
    path = file.path
    if path.name == _CANONICAL:
        names = [name for name in names if name in _CANONICAL_COLUMNS]
    text = read_text(path, MAX_ROW_BYTES)
    before = csv.field_size_limit(len(text) + 1)  # of the whole process
    try:
        return _parse(path, text, names)
    finally:
        csv.field_size_limit(before)


def _parse(path: Path, text: str, names: Sequence[str]) -> FileColumns:
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: dict[int, list[str]] = {}
    malformed: dict[int, str] = {}
    try:
        header = next(reader, [])
        _check_separator(path, header)
        selected = select(path, header, names)
        line = reader.line_num + 1
        for fields in reader:
            check_count(len(rows) + len(malformed))
            if not any(field.strip() for field in fields):
                pass  # a blank line, as editors leave at the end, and spreadsheets with commas
            elif len(fields) == len(header):
                rows[line] = fields
            else:
                malformed[line] = (
                    f"the line has {counted(len(fields), 'field')}; expected {len(header)}"
                )
            line = reader.line_num + 1  # quoted text may contain line breaks
    except csv.Error as error:
        raise ValueError(f"line {reader.line_num}: {error}") from None
    columns = {
        name: [unquoted(row[at]) for row in rows.values()]
        for name, column in selected.items()
        for at in [header.index(column)]
    }
    return with_outcomes(FileColumns(columns, list(rows), malformed, system_of(path)))


def _check_separator(path: Path, header: Sequence[str]) -> None:
    for separator, name in ((";", "semicolons"), ("\t", "tabs")):
        if len(header) == 1 and separator in header[0]:
            raise FormatError(
                f"{path} separates its columns by {name}; expected commas",
                "Save it again with commas between columns.",
            )


def system_of(path: Path) -> str | None:
    """Return the system in the name of a released or an exported file (see `export`), or None."""
    if path.name in _RELEASED_SYSTEMS:
        return _RELEASED_SYSTEMS[path.name]
    match = re.fullmatch(r"(.+)-[^-]+_rollouts\.csv", path.name)
    return match[1] if match else None
