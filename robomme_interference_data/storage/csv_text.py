"""Text in CSV files: spreadsheets run text that begins like a formula, so it is quoted.

An apostrophe before the text makes a spreadsheet show it. To read the same text back, texts that
already have apostrophes before such a beginning get one more.
"""

import re
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

_FORMULA = r"^('*[=+\-@\t\r\n])"
_QUOTED = r"^'('*[=+\-@\t\r\n])"


def quoted(value: Any) -> Any:
    """Return text as a cell that no spreadsheet runs; values of other types are unchanged."""
    return re.sub(_FORMULA, r"'\1", value, count=1) if isinstance(value, str) else value


def unquoted(text: str) -> str:
    """Return the text that `quoted` was given."""
    return re.sub(_QUOTED, r"\1", text, count=1)


def quoted_table(table: pa.Table) -> pa.Table:
    """Return a table whose text is `quoted`."""
    return _replaced(table, _FORMULA, r"'\1")


def unquoted_table(table: pa.Table) -> pa.Table:
    """Return a table whose text is `unquoted`."""
    return _replaced(table, _QUOTED, r"\1")


def _replaced(table: pa.Table, pattern: str, replacement: str) -> pa.Table:
    for position, field in enumerate(table.schema):
        if pa.types.is_string(field.type):
            column = pc.replace_substring_regex(table[position], pattern, replacement)
            table = table.set_column(position, field, column)
    return table
