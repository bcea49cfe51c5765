"""Read parquet files: spans of rows, values out of columns, and one clear error for damage; write.

`pyarrow.parquet.read_table` with filters is left aside: its scanner takes seconds to load, and
can wait forever on a damaged file.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError, InterferenceError

from .files import atomic_path
from .untrusted.parquet_pages import (
    MOST_FOOTER,
    decoded_size,
    read_chunks,
)

_IMAGES_AT_ONCE = 8

_MOST_LISTED = 1 << 14
"""Row groups, columns, and other lists in the metadata, at most: for so many, room is made before
one is read, and columns that lie in each other so deep take so much of the stack."""

_MOST_ROWS = 1 << 26
_MOST_VALUES = 1 << 26
"""Rows of a file and values of a read, at most: a million rows of a run have a third of them."""

_MOST_BYTES = 2 << 30
"""Bytes that a read, or the images of a row group, may take once decoded."""


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what pyarrow raises while the block reads a file into one clear error."""
    try:
        yield
    except InterferenceError:
        raise
    except (pa.ArrowException, OSError, ValueError, OverflowError, RecursionError) as error:
        text = str(error).partition("\n")[0]
        raise FormatError.damaged(path, f"cannot be read: {text}") from None


def open_parquet(path: Path) -> pq.ParquetFile:
    """Open a parquet file for reading piece by piece."""
    with reading(path):
        chunks = read_chunks(path)
        file = pq.ParquetFile(
            pa.OSFile(os.fsencode(path)),  # as pyarrow cannot encode names that are not UTF-8
            buffer_size=1 << 20,
            page_checksum_verification=True,  # of pages that have one
            thrift_string_size_limit=MOST_FOOTER,
            thrift_container_size_limit=_MOST_LISTED,
        )
        told = file.metadata
        if [len(group) for group in chunks] != [told.num_columns] * told.num_row_groups:
            raise ValueError("its row groups do not have the columns of its schema")
        rows = [told.row_group(group).num_rows for group in range(told.num_row_groups)]
        if min(rows, default=0) < 0 or sum(rows) != told.num_rows:
            raise ValueError(f"{told.num_rows} rows; its row groups have {sum(rows)}")
        if told.num_rows > _MOST_ROWS:
            raise ValueError(f"{told.num_rows:,} rows; at most {_MOST_ROWS:,} are read")
        _ = file.schema_arrow.names  # which may be no text
        return file


def read_table(
    file: pq.ParquetFile,
    path: Path,
    columns: Sequence[str] | None = None,
    groups: Sequence[int] | None = None,
) -> pa.Table:
    """Return columns of a file, checked value by value: texts are texts, lists lie where they say.

    Args:
        file: What `open_parquet` returned.
        path: The file's path.
        columns: Names of the columns; None for all.
        groups: Numbers of row groups; None for all.
    """
    chosen = range(file.num_row_groups) if groups is None else groups
    names = None if columns is None else list(columns)
    with reading(path):
        for field in file.schema_arrow:
            if (names is None or field.name in names) and not is_plain(field.type):
                raise ValueError(f"column {field.name!r} is of type {field.type}")
        _check_size(file, path, names, chosen)
        table = file.read_row_groups(list(chosen), columns=names)
        table.validate(full=True)
        if len(set(table.column_names)) < table.num_columns:
            raise ValueError("two columns have the same name")
    return table


def _check_size(
    file: pq.ParquetFile, path: Path, columns: list[str] | None, groups: Sequence[int]
) -> None:
    """Refuse what would take too much memory."""
    size = values = 0
    told = [file.metadata.schema.column(number) for number in range(file.metadata.num_columns)]
    wanted = None if columns is None else tuple(f"{name}." for name in columns)
    numbers = [n for n, c in enumerate(told) if wanted is None or f"{c.path}.".startswith(wanted)]
    chunks = read_chunks(path)
    with path.open("rb") as bare:
        for group in groups:
            for number in numbers:
                chunk, column = chunks[group][number], told[number]
                values += chunk.values
                kind, length = column.physical_type, column.length
                size += decoded_size(bare, chunk, kind, length, _MOST_BYTES)
                if size > _MOST_BYTES or values > _MOST_VALUES:
                    what = f"over {_MOST_BYTES:,} bytes or {_MOST_VALUES:,} values once decoded"
                    raise ValueError(what)


@contextmanager
def writing(path: Path) -> Iterator[BinaryIO]:
    """Open a file for pyarrow to write, whole or not at all: it cannot encode every name itself."""
    with atomic_path(path) as partial, partial.open("wb") as file:
        yield file


_NUMBERS = (pa.int8(), pa.int16(), pa.int32(), pa.int64(), pa.float16(), pa.float32(), pa.float64())
_UNSIGNED = (pa.uint8(), pa.uint16(), pa.uint32(), pa.uint64())
_TEXTS = (pa.string(), pa.large_string(), pa.binary(), pa.large_binary())
_PLAIN = {pa.null(), pa.bool_(), *_NUMBERS, *_UNSIGNED, *_TEXTS}


def is_listed(kind: pa.DataType) -> bool:
    """Tell whether a type is one of Arrow's lists."""
    return bool(
        pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    )


def is_plain(kind: pa.DataType) -> bool:
    """Tell whether values of a type are texts, numbers, truth values, or made of these."""
    if pa.types.is_dictionary(kind) or is_listed(kind):
        return is_plain(kind.value_type)
    if pa.types.is_struct(kind):
        named = len({field.name for field in kind}) == kind.num_fields
        return named and all(is_plain(field.type) for field in kind)
    return kind in _PLAIN


class RowSpan:
    """Rows of a parquet file that lie one after the other.

    Only the row groups that hold them are read. The statistics of row groups are never asked:
    pyarrow ends the process where those are damaged.

    Args:
        path: The file.
        start: First row.
        stop: Row after the last one; None for all that there are.
    """

    def __init__(self, path: Path, start: int = 0, stop: int | None = None):
        self.path = path
        self._file = open_parquet(path)
        self.start = start
        self.stop = self._file.metadata.num_rows if stop is None else stop

    def __len__(self) -> int:
        return self.stop - self.start

    def part(self, start: int, stop: int) -> "RowSpan":
        """Return rows of the same file, numbered as in the file; it is not opened again."""
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
        if len(rows) < len(self):  # a damaged column may hold fewer than the file says
            what = f"{len(rows)} rows of {', '.join(rows.column_names)}, not {len(self)}"
            raise FormatError.damaged(self.path, what)
        return rows

    def scalars(self, name: str) -> NDArray[np.int64]:
        """Return a column of booleans or integers, or of lists of one such value, `(T,) int64`."""
        column, what = self.table([name])[name], f"column {name!r}"
        kind = column.type
        if is_listed(kind):
            column, kind = pc.list_flatten(column), kind.value_type
            if len(column) != len(self):
                raise FormatError.damaged(self.path, f"{what} has lists of several values")
        if not (pa.types.is_boolean(kind) or pa.types.is_integer(kind)) or column.null_count:
            raise FormatError(
                f"{self.path}: {what} is of type {kind} with {column.null_count} empty values; "
                "expected booleans or integers, none empty"
            )
        with reading(self.path):  # a number too large
            return np.asarray(pc.cast(column, pa.int64()).to_numpy())

    def texts(self, name: str) -> list[str]:
        """Return a column of texts; one that is missing is empty."""
        column = self.table([name])[name]
        if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
            raise FormatError(
                f"{self.path}: column {name!r} is of type {column.type}; expected texts"
            )
        with reading(self.path):  # what is no UTF-8
            return [text or "" for text in column.to_pylist()]

    def vectors(self, name: str) -> NDArray[np.float32]:
        """Return a column of lists of numbers as `(T, D) float32`."""
        column, what = self.table([name])[name], f"{self.path}: column {name!r}"
        kind = column.type
        if not is_listed(kind) or not pa.types.is_floating(kind.value_type):
            raise FormatError(f"{what} is of type {kind}; expected lists of floats")
        lengths = pc.unique(pc.list_value_length(column))
        flat = pc.list_flatten(column)
        if column.null_count or flat.null_count or len(lengths) != 1:
            raise FormatError(
                f"{what} has empty values or vectors of several lengths: "
                f"{sorted(lengths.drop_null().to_pylist())}",
                "Every row needs a vector, and all of them the same length.",
            )
        values = flat.to_numpy().reshape(len(column), lengths[0].as_py())
        return np.ascontiguousarray(values, dtype=np.float32)

    def images(self, name: str) -> Iterator[bytes]:
        """Yield the encoded images of a column in order, a few of them in memory at a time.

        The column is a struct with the field `bytes`, as Hugging Face `Image` columns are. At
        most the encoded bytes of one row group are held, and less where the writer allows it.
        """
        kind = self._type(name)
        stored = pa.types.is_struct(kind) and kind.get_field_index("bytes") >= 0
        if not stored or not pa.types.is_binary(kind.field("bytes").type):
            raise FormatError(
                f"{self.path}: column {name!r} is of type {kind}; expected images as "
                "struct<bytes, path>"
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
                        data = cell["bytes"].as_py()
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
