"""Reading parquet files: the rows that match, and nothing else of the file."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data import parquet
from robomme_interference_data.errors import FormatError, MissingFileError
from robomme_interference_data.files import LocalFiles


@pytest.fixture(scope="module")
def many_groups(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pa.Table]:
    """97 rows in groups of 10."""
    table = pa.table(
        {
            "name": [None if n % 13 == 0 else f"n{n % 7}" for n in range(97)],
            "number": [n // 25 for n in range(97)],
            "row": range(97),
        }
    )
    path = tmp_path_factory.mktemp("groups") / "table.parquet"
    pq.write_table(table, path, row_group_size=10)
    return path, table


def read(path: Path, columns: list[str] | None, keep: Any) -> Iterator[dict[str, Any]]:
    with parquet.reading(path), pq.ParquetFile(path) as file:
        for table in parquet.read_rows(file, columns, keep):
            yield from table.to_pylist()


def test_matching(many_groups: tuple[Path, pa.Table]) -> None:
    _, table = many_groups
    for equal in ({}, {"name": "n3"}, {"number": 2}, {"name": "n3", "number": 2}, {"name": "no"}):
        expected = [
            all(row[name] == value for name, value in equal.items()) for row in table.to_pylist()
        ]
        assert parquet.matching(table, equal).tolist() == expected


@given(st.lists(st.integers(0, 96), max_size=8), st.sampled_from([None, ["row"], ["row", "name"]]))
def test_read_rows(
    many_groups: tuple[Path, pa.Table], rows: list[int], columns: list[str] | None
) -> None:
    path, table = many_groups
    keep = np.zeros(97, bool)
    keep[rows] = True
    expected = table.select(columns or table.column_names).to_pylist()
    assert list(read(path, columns, keep)) == [expected[row] for row in sorted(set(rows))]
    assert list(read(path, columns, None)) == expected


def test_groups_without_such_rows_are_not_read(
    many_groups: tuple[Path, pa.Table], tmp_path: Path
) -> None:
    """Damage elsewhere in the file is then not met."""
    path, _ = many_groups
    data = bytearray(path.read_bytes())
    with pq.ParquetFile(path) as file:
        column = file.metadata.row_group(5).column(2)
    start = column.dictionary_page_offset or column.data_page_offset
    data[start : start + column.total_compressed_size] = bytes(column.total_compressed_size)
    damaged = tmp_path / "damaged.parquet"
    damaged.write_bytes(data)
    keep = np.zeros(97, bool)
    keep[[3, 64]] = True
    assert [row["row"] for row in read(damaged, None, keep)] == [3, 64]
    with pytest.raises(FormatError, match=r"damaged\.parquet cannot be read: .*\nThe file is"):
        list(read(damaged, None, None))


def test_reading_lets_our_own_errors_pass(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError), parquet.reading(tmp_path / "x"):
        LocalFiles(tmp_path).path("x")
    with pytest.raises(ZeroDivisionError), parquet.reading(tmp_path / "x"):
        raise ZeroDivisionError
    message = "x cannot be read: first line\nThe file is damaged: download or build it again."
    with pytest.raises(FormatError) as caught, parquet.reading(tmp_path / "x"):
        raise pa.ArrowInvalid("first line\nand many more")
    assert str(caught.value) == f"{tmp_path}/{message}"
