"""Text in CSV files: no spreadsheet runs it, and it is read back the same."""

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.storage.csv_text import (
    quoted,
    quoted_table,
    unquoted,
    unquoted_table,
)
from robomme_interference_data.viz.tables import Table

FORMULAS = "=+-@\t\r\n"


@pytest.mark.parametrize(
    ("text", "cell"),
    [
        ('=HYPERLINK("http://x","y")', '\'=HYPERLINK("http://x","y")'),
        ("-1+1|cmd", "'-1+1|cmd"),
        ("'=1", "''=1"),
        ("'plain", "'plain"),
        ("a=1", "a=1"),
        ("", ""),
        (-0.5, -0.5),
        (None, None),
    ],
)
def test_cells(text: object, cell: object) -> None:
    assert quoted(text) == cell


@given(st.lists(st.text(alphabet=[*FORMULAS, "'", "a", "é"], max_size=5)))
def test_text_is_read_back_the_same(texts: list[str]) -> None:
    cells = list(map(quoted, texts))
    assert not any(cell.startswith(tuple(FORMULAS)) for cell in cells)
    assert list(map(unquoted, cells)) == texts
    table = pa.table({"text": pa.array(texts, pa.string()), "number": [-1.5] * len(texts)})
    assert quoted_table(table)["text"].to_pylist() == cells
    assert unquoted_table(quoted_table(table)) == table


def test_tables_quote_text_but_no_numbers() -> None:
    table = Table("t", "T", {"system": "text", "gain": "points"}, [("@SUM(A1)", -0.25)])
    assert table.csv() == "system,gain\n'@SUM(A1),-0.250000\n"
