"""Reading parquet files: spans of rows, nothing else of the file, and one error for damage."""

import io
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises

from robomme_interference_data.errors import FormatError
from robomme_interference_data.storage.parquet import RowSpan
from robomme_interference_data.storage.parquet_pages import _read_struct, decoded_size

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
    with raises(FormatError):
        RowSpan(path).scalars("number")


@pytest.mark.parametrize(
    ("values", "method"),
    [
        ([1, 2], "no"),
        (["a", "b"], "scalars"),
        ([1, None], "scalars"),
        ([[1], [1, 2]], "scalars"),
        (pa.array([2**63, 1], pa.uint64()), "scalars"),
        (["1.0", "2.0"], "vectors"),
        ([[True]], "vectors"),
        ([[(1 << 24) + 1]], "vectors"),
        ([1.0, 2.5], "scalars"),
        ([1.0, float("nan")], "scalars"),
        ([1.0, None], "vectors"),
        ([[1], []], "scalars"),
        ([[[1]]], "vectors"),
        ([[1.0], [1.0, 2.0]], "vectors"),
        ([[1.0], [None]], "vectors"),
        ([{"bytes": "a"}], "images"),
        (pa.array([{"path": "a.png"}], IMAGE), "images"),
        (pa.array([None], IMAGE), "images"),
    ],
)
def test_columns_of_another_kind(tmp_path: Path, values: Any, method: str) -> None:
    span = RowSpan(write(tmp_path / "t", v=values))
    with raises(FormatError):
        list(span.scalars("no") if method == "no" else getattr(span, method)("v"))


TWO = [[1.0, 2.0], [3.0, -4.0]]
TEXTS = ["a", None, "a"]
PICTURES = [b"one", b"two"]


@pytest.mark.parametrize(
    ("column", "method", "expected"),
    [
        # vectors: lists of any kind and width, tensors, and single values
        (pa.array(TWO, pa.list_(pa.float64())), "vectors", TWO),
        (pa.array(TWO, pa.list_(pa.float32(), 2)), "vectors", TWO),
        (pa.array(TWO, pa.large_list(pa.float16())), "vectors", TWO),
        (pa.array([[1, 2], [3, -4]], pa.list_(pa.int8(), 2)), "vectors", TWO),
        (pa.array([[Decimal("0.5")]], pa.list_(pa.decimal128(4, 2))), "vectors", [[0.5]]),
        (pa.FixedShapeTensorArray.from_numpy_ndarray(np.array(TWO)), "vectors", TWO),
        (pa.array([1.5, -2.0], pa.float32()), "vectors", [[1.5], [-2.0]]),
        (pa.array([3, 4], pa.uint16()), "vectors", [[3.0], [4.0]]),
        (pa.array([[1 << 24]]), "vectors", [[16_777_216.0]]),
        # whole numbers
        (pa.array([1, 2], pa.uint8()), "scalars", [1, 2]),
        (pa.array([294.0, -1.0]), "scalars", [294, -1]),
        (pa.array([[True], [False]], pa.list_(pa.bool_(), 1)), "scalars", [1, 0]),
        (pa.array([7, 7, 9]).dictionary_encode(), "scalars", [7, 7, 9]),
        # texts
        (pa.array(TEXTS, pa.large_string()), "texts", ["a", "", "a"]),
        (pa.array(TEXTS, pa.string_view()), "texts", ["a", "", "a"]),
        (pa.array(TEXTS).dictionary_encode(), "texts", ["a", "", "a"]),
        # images: in structs of LeRobot and others, or as plain bytes
        (pa.array([{"bytes": data, "path": "x"} for data in PICTURES], IMAGE), "images", PICTURES),
        (pa.array([{"path": None, "bytes": data} for data in PICTURES]), "images", PICTURES),
        (pa.array(PICTURES), "images", PICTURES),
        (pa.array(PICTURES, pa.large_binary()), "images", PICTURES),
    ],
)
def test_columns_as_other_programs_write_them(
    tmp_path: Path, column: pa.Array, method: str, expected: list[Any]
) -> None:
    found = getattr(RowSpan(write(tmp_path / "t", v=column)), method)("v")
    assert (found.tolist() if isinstance(found, np.ndarray) else list(found)) == expected


def test_no_parquet_file(tmp_path: Path) -> None:
    for data in (b"", b"episode_id,frame_index\n", b"PAR1" * 100):
        (tmp_path / "t").write_bytes(data)
        with raises(FormatError):
            RowSpan(tmp_path / "t")


def test_fewer_rows_than_the_file_says(tmp_path: Path) -> None:
    """As in a damaged column: a read returns all rows or raises."""
    path = tmp_path / "rows.parquet"
    pq.write_table(pa.table({"n": range(5)}), path)
    assert RowSpan(path).part(3, 5).scalars("n").tolist() == [3, 4]
    with raises(FormatError):
        RowSpan(path).part(3, 7).scalars("n")


# --- the size of columns, from their page headers ------------------------------------------------

GIBIBYTE = 1 << 30


def sizes(path: Path) -> list[int]:
    """What each column of the first row group takes at most."""
    metadata = pq.read_metadata(path)
    with path.open("rb") as file:
        return [
            decoded_size(file, metadata.row_group(0).column(number), 0, GIBIBYTE)
            for number in range(metadata.num_columns)
        ]


COLUMNS = {
    "text": st.text(max_size=30) | st.none(),
    "long": st.sampled_from(["a" * 5000, "b", ""]),
    "number": st.integers(-(2**63), 2**63 - 1) | st.none(),
    "truth": st.booleans(),
    "list": st.lists(st.floats(width=32), max_size=5) | st.none(),
    "struct": st.fixed_dictionaries({"a": st.lists(st.text(max_size=3), max_size=3)}),
}


@given(
    st.lists(st.fixed_dictionaries(COLUMNS), min_size=1, max_size=40),
    st.sampled_from(["none", "snappy", "gzip", "brotli", "zstd", "lz4"]),
    st.sampled_from(["1.0", "2.0"]),
    st.booleans(),
)
def test_it_is_never_less_than_what_is_read(
    tmp_path_factory: Any, rows: list[Any], compression: str, version: str, dictionary: bool
) -> None:
    path = tmp_path_factory.mktemp("pages") / "t"
    table = pa.table({name: [row[name] for row in rows] for name in COLUMNS})
    pq.write_table(
        table, path, compression=compression, data_page_version=version, use_dictionary=dictionary
    )
    table = RowSpan(path).table()
    assert sum(sizes(path)) >= table.nbytes
    assert table.num_rows == len(rows)


def test_texts_by_number_count_as_often_as_they_come(tmp_path: Path) -> None:
    texts = pa.DictionaryArray.from_arrays(np.zeros(20_000, np.int8), ["x" * 10_000, "y"])
    pq.write_table(pa.table({"v": texts}), tmp_path / "t", store_schema=False)
    [size] = sizes(tmp_path / "t")
    assert 200_000_000 < size < 210_000_000  # 20,000 texts of 10,000 bytes


def test_many_short_texts_are_not_taken_for_long_ones(tmp_path: Path) -> None:
    names = [f"MoveCube/train/{number}" for number in range(20_000)] * 10
    pq.write_table(pa.table({"v": names}), tmp_path / "t", dictionary_pagesize_limit=1 << 30)
    [size] = sizes(tmp_path / "t")
    assert size < 20_000_000
    assert len(RowSpan(tmp_path / "t").table()) == 200_000


@pytest.mark.parametrize(
    "column",
    [
        pa.array([1], pa.timestamp("us", "Mars/Olympus")),
        pa.array([[(1, 2)]], pa.map_(pa.int64(), pa.int64())),
        pa.array([b"ab"], pa.binary(2)),
    ],
)
def test_kinds_of_columns_that_no_table_of_ours_has(tmp_path: Path, column: pa.Array) -> None:
    pq.write_table(pa.table({"v": column, "w": [1]}), tmp_path / "t")
    with raises(FormatError):
        RowSpan(tmp_path / "t").table()
    assert RowSpan(tmp_path / "t").table(["w"]).num_rows == 1


def test_an_encoding_that_is_not_read(tmp_path: Path) -> None:
    """Each value may repeat the one before, so that a small file has a large content."""
    encoding = {"v": "DELTA_BYTE_ARRAY"}
    table = pa.table({"v": ["ab", "abc"]})
    pq.write_table(table, tmp_path / "t", use_dictionary=False, column_encoding=encoding)
    with raises(FormatError) as raised:
        RowSpan(tmp_path / "t").table()
    assert raised.value.hint and "download" not in raised.value.hint


def test_text_that_is_none(tmp_path: Path) -> None:
    column = pa.Array.from_buffers(
        pa.string(), 1, [None, pa.array([0, 1], pa.int32()).buffers()[1], pa.py_buffer(b"\xff")]
    )
    pq.write_table(pa.table({"v": column}), tmp_path / "t")
    with raises(FormatError):
        RowSpan(tmp_path / "t").table()


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"\x00", {}),
        (b"\x15\x03\x00", {(1, 5): -2}),
        (b"\x16\x80\x02\x00", {(1, 6): 128}),
        (b"\x3c\x25\x02\x00\x00", {(3, 12): {(2, 5): 1}}),
        (b"\x48\x03abc\x11\x12\x00", {(4, 8): None, (5, 1): None, (6, 2): None}),
    ],
)
def test_a_struct_of_thrift(data: bytes, expected: dict[tuple[int, int], Any]) -> None:
    file = io.BytesIO(data + b"more")
    assert _read_struct(file) == expected
    assert file.tell() == len(data)
    for length in range(len(data)):
        with raises(ValueError):
            _read_struct(io.BytesIO(data[:length]))


@pytest.mark.parametrize("data", [b"\x05\x02\x02\x00", b"\x15" + b"\xff" * 11, b"\x19\x15\x02\x00"])
def test_a_struct_that_pyarrow_might_read_otherwise(data: bytes) -> None:
    with raises(ValueError):
        _read_struct(io.BytesIO(data))


def test_a_page_header_is_found_however_long_it_is(tmp_path: Path) -> None:
    table, written = pa.table({"v": ["a" * 3000, "b" * 3000]}), io.BytesIO()
    pq.write_table(table, written, use_dictionary=False, compression="none")
    (tmp_path / "t").write_bytes(written.getvalue())
    assert RowSpan(tmp_path / "t").table() == table


def test_a_text_file_is_no_parquet_file(tmp_path: Path) -> None:
    """Its last bytes are not taken for the size of its metadata."""
    (tmp_path / "frames.parquet").write_text("episode_id,frame_index\n" * 9)
    with pytest.raises(FormatError) as raised:
        RowSpan(tmp_path / "frames.parquet").table()
    assert "not a Parquet file" in raised.value.message
    assert "bytes of metadata" not in raised.value.message


@pytest.mark.filterwarnings("error")
def test_numbers_beyond_float32_become_infinite_without_a_warning(tmp_path: Path) -> None:
    path = write(tmp_path / "t.parquet", state=pa.array([[1.0, 1e300]]))
    assert np.isinf(RowSpan(path).vectors("state")[0, 1])
