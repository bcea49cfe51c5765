"""Read spans of rows and values of columns from parquet files; write parquet files.

`pyarrow.parquet.read_table` with filters is not used: its scanner takes seconds to load, and may
hang on a damaged file.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError, counted

from .arrow_columns import (
    is_listed,
    is_number,
    is_plain,
    is_text,
    is_whole,
    simple_type,
    simplified,
)
from .files import atomic_path, reading
from .limits import MAX_READ_VALUES
from .parquet_pages import decoded_size
from .text import check_not_pointer

# An image may be a PNG of some megabytes.
_IMAGES_AT_ONCE = 8

_MAX_METADATA_BYTES = 16 << 20
"""Files of LeRobot of 100 MB, with a row group for each episode, have half of it."""

_MAGIC = b"PAR1"
"""First and last bytes of a Parquet file."""

_MAX_LIST = 1 << 14
"""Length of a list in the metadata, such as row groups: pyarrow allocates memory for it first."""

_MAX_BYTES = 2 << 30
"""Decoded bytes of a read, or of the images of a row group."""


def open_parquet(path: Path) -> pq.ParquetFile:
    """Open a parquet file for reading piece by piece."""
    with reading(path):
        check_not_pointer(path)
        _check_metadata_size(path)
        file = pq.ParquetFile(
            pa.OSFile(os.fsencode(path)),  # as pyarrow cannot encode names that are not UTF-8
            buffer_size=1 << 20,
            pre_buffer=False,
            page_checksum_verification=True,  # of pages that have one
            thrift_container_size_limit=_MAX_LIST,
        )
        metadata = file.metadata
        rows = [metadata.row_group(group).num_rows for group in range(metadata.num_row_groups)]
        if min(rows, default=0) < 0 or sum(rows) != metadata.num_rows:
            raise ValueError(f"{metadata.num_rows} rows; its row groups have {sum(rows)}")
        names = file.schema_arrow.names  # raises if one is not UTF-8
        if len({*names}) < len(names):
            raise ValueError("two columns have the same name")
        return file


def _check_metadata_size(path: Path) -> None:
    """Raise if a file has more metadata than it needs: parsed, it takes up to 240 times as much."""
    with path.open("rb") as file:
        begin = file.read(len(_MAGIC))
        end = file.seek(0, os.SEEK_END)
        file.seek(max(0, end - 8))
        size = int.from_bytes(file.read(4), "little")
        if _MAGIC not in (begin, file.read(4)):
            raise ValueError("not a Parquet file")
    if size > _MAX_METADATA_BYTES:
        raise ValueError(f"{size:,} bytes of metadata; expected at most {_MAX_METADATA_BYTES:,}")


def read_table(
    file: pq.ParquetFile,
    path: Path,
    columns: Sequence[str] | None = None,
    groups: Sequence[int] | None = None,
) -> pa.Table:
    """Return columns and row groups of an open file (None for all), with every value validated."""
    chosen = range(file.num_row_groups) if groups is None else groups
    names = None if columns is None else list(columns)
    with reading(path):
        for field in file.schema_arrow:
            if (names is None or field.name in names) and not is_plain(field.type):
                raise FormatError(
                    f"{path}: column {field.name!r} is of type {field.type}; expected text, "
                    "numbers, true or false, or lists or structs of these",
                    "Write the column with another type, or leave it out.",
                )
        _check_size(file, path, names, chosen)
        table = file.read_row_groups(list(chosen), columns=names)
        table.validate(full=True)
    return table


def _check_size(
    file: pq.ParquetFile, path: Path, columns: list[str] | None, groups: Sequence[int]
) -> None:
    """Raise if a read would take too much memory."""
    # A list or struct is stored as columns of its own, such as `image.bytes`.
    schema = file.metadata.schema
    stored = [schema.column(number) for number in range(file.metadata.num_columns)]
    prefixes = None if columns is None else tuple(f"{name}." for name in columns)
    chosen = [
        (number, column.length or 0)
        for number, column in enumerate(stored)
        if prefixes is None or f"{column.path}.".startswith(prefixes)
    ]
    # Batches of no rows read no page, but raise if the metadata of a column is damaged: asking for
    # that metadata would then end the process.
    numbers = [number for number, _ in chosen]
    for _ in file.reader.iter_batches(0, list(groups), numbers, use_threads=False):
        pass
    size = values = 0
    with path.open("rb") as raw:
        for group in groups:
            for number, fixed_length in chosen:
                column = file.metadata.row_group(group).column(number)
                values += column.num_values
                try:
                    size += decoded_size(raw, column, fixed_length, _MAX_BYTES)
                except FormatError as error:
                    raise error.about(path) from None
                if size > _MAX_BYTES or values > MAX_READ_VALUES:
                    what = f"over {_MAX_BYTES:,} bytes or {MAX_READ_VALUES:,} values once decoded"
                    raise ValueError(what)


@contextmanager
def writing(path: Path) -> Iterator[BinaryIO]:
    """Open a file for pyarrow to write atomically; by name, it requires UTF-8."""
    with atomic_path(path) as partial, partial.open("wb") as file:
        yield file


_EXACT_FLOAT32 = 1 << 24
"""Whole numbers up to this one are exact as float32."""


class RowSpan:
    """The rows `start` to `stop` (excluded; None for all) of a parquet file.

    Only the row groups that hold them are read. The statistics of row groups are never used:
    damaged ones crash pyarrow.
    """

    def __init__(self, path: Path, start: int = 0, stop: int | None = None):
        self.path = path
        self._file = open_parquet(path)
        self.start = start
        self.stop = self._file.metadata.num_rows if stop is None else stop

    def __len__(self) -> int:
        return self.stop - self.start

    def part(self, start: int, stop: int) -> "RowSpan":
        """Return other rows of the same open file, numbered as in the file."""
        part = copy(self)
        part.start, part.stop = start, stop
        return part

    @property
    def names(self) -> list[str]:
        """Names of the columns."""
        return list(self._file.schema_arrow.names)

    def table(self, columns: list[str] | None = None) -> pa.Table:
        """Return the rows with the given columns, or with all."""
        for name in columns or ():
            self._type(name)
        groups, first = self._row_groups()
        table = read_table(self._file, self.path, columns, groups)
        rows = table.slice(self.start - first, len(self))
        if len(rows) < len(self):  # a damaged column may be shorter
            what = f"{len(rows)} rows of {', '.join(rows.column_names)}; expected {len(self)}"
            raise FormatError.damaged(self.path, what)
        return rows

    def values(self, name: str) -> pa.ChunkedArray:
        """Return a column in its simple type, and of lists of one value the values."""
        column = self.table([name])[name]
        with reading(self.path):
            column = simplified(column)
        if is_listed(column.type):
            flat = pc.list_flatten(column)
            lengths = pc.unique(pc.list_value_length(column)).to_pylist()
            if len(flat) != len(self) or lengths not in ([1], []):
                raise FormatError.damaged(self.path, f"column {name!r} has lists of several values")
            return flat
        return column

    def scalars(self, name: str) -> NDArray[np.int64]:
        """Return a column of booleans or whole numbers, or of lists of one, `(T,) int64`."""
        column = self.values(name)
        kind = column.type
        if not (pa.types.is_boolean(kind) or is_number(kind)) or column.null_count:
            raise FormatError(
                f"{self.path}: column {name!r} is of type {kind} with {column.null_count} empty "
                "values; expected booleans or whole numbers, none empty"
            )
        values = np.asarray(column.to_numpy())
        # pandas makes floats of whole numbers where rows were empty for a time.
        with np.errstate(invalid="ignore"):
            whole = values.astype(np.int64)
        if wrong := np.flatnonzero(whole != values).tolist():
            raise FormatError(
                f"{self.path}: column {name!r} is {values[wrong[0]]} in row "
                f"{self.start + wrong[0]}; expected whole numbers"
            )
        return whole

    def texts(self, name: str) -> list[str]:
        """Return a column of texts, with empty ones for nulls."""
        column = self.table([name])[name]
        if not is_text(column.type):
            raise FormatError(
                f"{self.path}: column {name!r} is of type {column.type}; expected texts"
            )
        with reading(self.path):  # invalid UTF-8
            return [text or "" for text in column.to_pylist()]

    def vectors(self, name: str) -> NDArray[np.float32]:
        """Return a column of lists of numbers, or of numbers, as `(T, D) float32`."""
        column, what = self.table([name])[name], f"{self.path}: column {name!r}"
        stored = column.type
        if not (is_listed(stored) and pa.types.is_floating(stored.value_type)):
            with reading(self.path):
                column = simplified(column)
        # LeRobot stores vectors of one value as the value.
        flat = pc.list_flatten(column) if is_listed(column.type) else column
        if not is_number(flat.type):
            raise FormatError(
                f"{what} is of type {stored}; expected lists of numbers",
                "Store the values of each row as a list of numbers, always in the same order.",
            )
        lengths = [1]
        if is_listed(column.type):
            lengths = pc.unique(pc.list_value_length(column)).drop_null().to_pylist()
        if column.null_count or flat.null_count or len(lengths) != 1:
            raise FormatError(
                f"{what}: {self._first_uneven(column)}",
                "Every row needs a vector of the same length, without empty values.",
            )
        values = flat.to_numpy().reshape(len(column), lengths[0])
        if is_whole(flat.type) and not (np.abs(values.astype(float)) <= _EXACT_FLOAT32).all():
            raise FormatError(
                f"{what} has whole numbers from {values.min():,} to {values.max():,}; states and "
                f"actions are stored as float32, which is exact up to {_EXACT_FLOAT32:,}",
                "Scale them, for example from ticks to radians.",
            )
        with np.errstate(over="ignore"):  # what is too large becomes infinite; callers refuse it
            return np.ascontiguousarray(values, dtype=np.float32)

    def _first_uneven(self, column: pa.ChunkedArray) -> str:
        """Return what is wrong with the first vector that is empty, or of another length."""
        size = None
        for frame, cell in enumerate(column):
            value = cell.as_py()
            vector = value if isinstance(value, list) else [value]
            where = f"frame {frame} (row {self.start + frame})"
            if value is None or None in vector:
                return f"{where} has an empty value"
            if size not in (None, len(vector)):
                return f"{where} has {counted(len(vector), 'value')}, those before it {size}"
            size = len(vector)
        return "it has no rows"

    def images(self, name: str) -> Iterator[bytes]:
        """Yield the encoded images of a column of structs with the field `bytes`, in order.

        At most one row group is held in memory, and less if the file's pages are smaller.
        """
        kind = self._type(name)
        stored: Any = simple_type(kind)
        in_structs = stored is not None and pa.types.is_struct(stored)
        if in_structs and stored.get_field_index("bytes") >= 0:
            stored = stored.field("bytes").type
        if stored != pa.binary():
            raise FormatError(
                f"{self.path}: column {name!r} is of type {kind}; expected images as PNG or JPEG, "
                "in struct<bytes, path>",
                "Encode the images as PNG, which is lossless.",
            )
        groups, row = self._row_groups()
        with reading(self.path):
            for group in groups:
                _check_size(self._file, self.path, [name], [group])
        batches = self._file.iter_batches(_IMAGES_AT_ONCE, row_groups=groups, columns=[name])
        with reading(self.path):
            for batch in batches:
                for cell in batch.column(name):
                    if self.start <= row < self.stop:
                        value = cell.as_py()
                        data = value["bytes"] if in_structs and value else value
                        if data is None:
                            raise FormatError(
                                f"{self.path}: the image in row {row} of column {name!r} is not "
                                "stored in the file",
                                "Write the dataset again with the images in its parquet files.",
                            )
                        yield data
                    row += 1

    def _type(self, name: str) -> pa.DataType:
        if name not in self.names:
            raise FormatError.damaged(
                self.path, f"no column {name!r}; its columns are {', '.join(self.names)}"
            )
        return self._file.schema_arrow.field(name).type

    def _row_groups(self) -> tuple[list[int], int]:
        """Return the row groups that hold the span, and the first row of them."""
        groups: list[int] = []
        first = row = 0
        for group in range(self._file.metadata.num_row_groups):
            rows = self._file.metadata.row_group(group).num_rows
            if row < self.stop and row + rows > self.start:
                first = first if groups else row
                groups.append(group)
            row += rows
        return groups, first
