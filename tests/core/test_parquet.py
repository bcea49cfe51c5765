"""Reading parquet files: spans of rows, nothing else of the file, and one error for damage."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.errors import FormatError
from robomme_interference_data.storage.parquet import RowSpan

IMAGE = pa.struct({"bytes": pa.binary(), "path": pa.string()})


def write(path: Path, rows_a_group: int = 10, **columns: Any) -> Path:
    pq.write_table(pa.table(columns), path, row_group_size=rows_a_group)
    return path


@given(st.lists(st.integers(1, 9), min_size=1, max_size=6), st.integers(1, 7), st.data())
def test_any_span_of_rows(tmp_path_factory, lengths, rows_a_group, data) -> None:
    total = sum(lengths)
    values = np.arange(2.0 * total, dtype=np.float32).reshape(total, 2)
    cells = pa.array([{"bytes": bytes([row]), "path": None} for row in range(total)], IMAGE)
    path = tmp_path_factory.mktemp("rows") / "table.parquet"
    write(path, rows_a_group, number=range(total), vector=list(values), image=cells)
    start = data.draw(st.integers(0, total - 1))
    stop = data.draw(st.integers(start + 1, total))
    span = RowSpan(path).part(start, stop)
    assert len(span) == stop - start
    assert span.scalars("number").tolist() == list(range(start, stop))
    np.testing.assert_array_equal(span.vectors("vector"), values[start:stop])
    assert [image[0] for image in span.images("image")] == list(range(start, stop))


def test_groups_without_such_rows_are_not_read(tmp_path: Path) -> None:
    """Damage elsewhere in the file is then not met."""
    path = write(tmp_path / "table.parquet", number=list(range(97)))
    data = bytearray(path.read_bytes())
    with pq.ParquetFile(path) as file:
        column = file.metadata.row_group(5).column(0)
    start = column.dictionary_page_offset or column.data_page_offset
    data[start : start + column.total_compressed_size] = bytes(column.total_compressed_size)
    path.write_bytes(data)
    assert RowSpan(path, 40, 50).scalars("number").tolist() == list(range(40, 50))
    with pytest.raises(FormatError, match=r"table\.parquet: cannot be read"):
        RowSpan(path).scalars("number")


@pytest.mark.parametrize(
    ("values", "method", "message"),
    [
        ([1, 2], "no", "no column 'no'; its columns are v"),
        (["a", "b"], "scalars", "of type string with 0 empty"),
        ([1, None], "scalars", "with 1 empty values"),
        ([[1], [1, 2]], "scalars", "lists of several values"),
        (pa.array([2**63, 1], pa.uint64()), "scalars", "cannot be read"),
        ([1.0, 2.0], "vectors", "expected lists of floats"),
        ([[1.0], [1.0, 2.0]], "vectors", r"several lengths: \[1, 2\]"),
        ([[1.0], [None]], "vectors", "empty values"),
        ([{"bytes": "a"}], "images", "expected images as struct"),
        (pa.array([{"path": "a.png"}], IMAGE), "images", "in row 0 of column 'v' is not stored"),
        (pa.array([None], IMAGE), "images", "is not stored in the file"),
    ],
)
def test_columns_of_another_kind(tmp_path: Path, values: Any, method: str, message: str) -> None:
    span = RowSpan(write(tmp_path / "t", v=values))
    with pytest.raises(FormatError, match=message):
        list(span.scalars("no") if method == "no" else getattr(span, method)("v"))


def test_no_parquet_file(tmp_path: Path) -> None:
    for data in (b"", b"episode_id,frame_index\n", b"PAR1" * 100):
        (tmp_path / "t").write_bytes(data)
        with pytest.raises(FormatError, match=r"t: cannot be read: .*\nThe file is damaged"):
            RowSpan(tmp_path / "t")


def test_fewer_rows_than_the_file_says(tmp_path: Path) -> None:
    """As of a damaged column: what is read has all of the rows, or is refused."""
    path = tmp_path / "rows.parquet"
    pq.write_table(pa.table({"n": range(5)}), path)
    assert RowSpan(path).part(3, 5).scalars("n").tolist() == [3, 4]
    with pytest.raises(FormatError, match="2 rows of n; expected 4"):
        RowSpan(path).part(3, 7).scalars("n")
