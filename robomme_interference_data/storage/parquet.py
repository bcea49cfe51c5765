"""Read spans of rows and values of columns from parquet files; write parquet files.

`pyarrow.parquet.read_table` with filters is not used: its scanner takes seconds to load, and may
hang on a damaged file.
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

from robomme_interference_data.errors import FormatError

from .files import atomic_path, check_not_pointer, reading
from .parquet_pages import decoded_size

# An image may be a PNG of some megabytes.
_IMAGES_AT_ONCE = 8

_MAX_METADATA_BYTES = 16 << 20
"""Files of LeRobot of 100 MB, with a row group for each episode, have half of it."""

_MAGIC = b"PAR1"
"""First and last bytes of a Parquet file."""

_MAX_LIST = 1 << 14
"""Length of a list in the metadata, such as row groups: pyarrow allocates memory for it first."""

_MAX_VALUES = 1 << 26
"""Values of a read: a million rows of a run have a third of them."""

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
                raise ValueError(f"column {field.name!r} is of type {field.type}")
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
                size += decoded_size(raw, column, fixed_length, _MAX_BYTES)
                if size > _MAX_BYTES or values > _MAX_VALUES:
                    what = f"over {_MAX_BYTES:,} bytes or {_MAX_VALUES:,} values once decoded"
                    raise ValueError(what)


@contextmanager
def writing(path: Path) -> Iterator[BinaryIO]:
    """Open a file for pyarrow to write atomically; by name, it requires UTF-8."""
    with atomic_path(path) as partial, partial.open("wb") as file:
        yield file


_NUMBERS = (pa.int8(), pa.int16(), pa.int32(), pa.int64(), pa.float16(), pa.float32(), pa.float64())
_UNSIGNED = (pa.uint8(), pa.uint16(), pa.uint32(), pa.uint64())
_TEXTS = (pa.string(), pa.large_string(), pa.binary(), pa.large_binary())
_PLAIN = {pa.null(), pa.bool_(), *_NUMBERS, *_UNSIGNED, *_TEXTS}


def is_listed(kind: pa.DataType) -> bool:
    """Return whether a type is one of Arrow's lists."""
    return bool(
        pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    )


def is_plain(kind: pa.DataType) -> bool:
    """Return whether a type is text, bytes, number, bool, or a list or struct of these."""
    if pa.types.is_dictionary(kind) or is_listed(kind):
        return is_plain(kind.value_type)
    if pa.types.is_struct(kind):
        # Two fields of one name cannot become a dict.
        unique = len({field.name for field in kind}) == kind.num_fields
        return unique and all(is_plain(field.type) for field in kind)
    return kind in _PLAIN


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

    def scalars(self, name: str) -> NDArray[np.int64]:
        """Return a column of booleans or integers, or of lists of one such value, `(T,) int64`."""
        column = self.table([name])[name]
        kind = column.type
        if is_listed(kind):
            column, kind = pc.list_flatten(column), kind.value_type
            if len(column) != len(self):
                raise FormatError.damaged(self.path, f"column {name!r} has lists of several values")
        if not (pa.types.is_boolean(kind) or pa.types.is_integer(kind)) or column.null_count:
            raise FormatError(
                f"{self.path}: column {name!r} is of type {kind} with {column.null_count} empty "
                "values; expected booleans or integers, none empty"
            )
        with reading(self.path):  # a number too large
            return np.asarray(pc.cast(column, pa.int64()).to_numpy())

    def texts(self, name: str) -> list[str]:
        """Return a column of texts, with empty ones for nulls."""
        column = self.table([name])[name]
        if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
            raise FormatError(
                f"{self.path}: column {name!r} is of type {column.type}; expected texts"
            )
        with reading(self.path):  # invalid UTF-8
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
                "Every row needs a vector of the same length.",
            )
        values = flat.to_numpy().reshape(len(column), lengths[0].as_py())
        with np.errstate(over="ignore"):  # what is too large becomes infinite; callers refuse it
            return np.ascontiguousarray(values, dtype=np.float32)

    def images(self, name: str) -> Iterator[bytes]:
        """Yield the encoded images of a column of structs with the field `bytes`, in order.

        At most one row group is held in memory, and less if the file's pages are smaller.
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
