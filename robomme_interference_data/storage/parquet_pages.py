"""Bound what the pages of a parquet file declare, before pyarrow reads them.

pyarrow allocates what the headers of pages declare, regardless of the file's metadata, and
expands a text that is stored once as often as it occurs: a file of 50 kB became 5 GB. The
format's `parquet.thrift` describes the headers.
"""

import os
from collections.abc import Iterator
from typing import Any, BinaryIO, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from robomme_interference_data.errors import FormatError

_DATA, _DICTIONARY, _DATA_V2 = 0, 2, 3
_DETAILS = {_DATA: 5, _DICTIONARY: 7, _DATA_V2: 8}
"""Types of pages, and the field of a header that holds what only pages of that type have."""

_BY_DICTIONARY = (2, 8)
_BY_PREFIX = 7
"""Encodings: indices into a dictionary; how much of the previous value is repeated."""

_WIDTHS = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "INT96": 12, "FLOAT": 4, "DOUBLE": 8}

_OVERHEAD = 16
"""Bytes that a value in Arrow takes in addition: offset, validity, levels of nesting."""

_TRUE, _FALSE, _I32, _I64, _BINARY, _STRUCT = 1, 2, 5, 6, 8, 12
"""Thrift's kinds of values that headers have."""


class _PageHeader(NamedTuple):
    """The header of a page, and where its content starts; `stored` is its size in the file."""

    kind: int
    size: int
    stored: int
    values: int
    encoding: int
    start: int


def decoded_size(
    file: BinaryIO, column: pq.ColumnChunkMetaData, fixed_length: int, most: int
) -> int:
    """Return an upper bound on the bytes of a column of a row group in Arrow.

    Beyond `most` bytes, the rest is not counted. `fixed_length` is the length of values of the type
    FIXED_LEN_BYTE_ARRAY.
    """
    if column.num_values < 0:
        raise ValueError(f"a column of {column.num_values} values")
    texts = column.physical_type == "BYTE_ARRAY"
    size = column.num_values * (_WIDTHS.get(column.physical_type, fixed_length) + _OVERHEAD)
    dictionary, references = None, 0
    for page in _read_pages(file, column):
        size += page.size
        if size > most:
            return size
        if page.kind == _DICTIONARY:
            dictionary = page
        elif page.encoding in _BY_DICTIONARY:
            references += page.values
        elif page.encoding == _BY_PREFIX and texts:
            raise FormatError(
                f"column {column.path_in_schema!r} is encoded by common prefixes "
                "(DELTA_BYTE_ARRAY), which is not read",
                "Write the file with another encoding, such as pyarrow's default.",
            )
    if texts and dictionary is not None:
        longest = dictionary.size
        if size + references * longest > most:  # only then, as it takes time
            longest = _longest_text(file, dictionary, column.compression)
        size += references * longest
    return size


def _read_pages(file: BinaryIO, column: pq.ColumnChunkMetaData) -> Iterator[_PageHeader]:
    """Yield the pages that pyarrow reads, which are those up to the last value."""
    position = column.data_page_offset
    if 0 < (column.dictionary_page_offset or 0) < position:
        position = column.dictionary_page_offset
    stop = position + column.total_compressed_size
    values = 0
    while values < column.num_values:
        file.seek(position)
        header = _read_struct(file)
        kind, size, stored = (header.get((number, _I32), -1) for number in (1, 2, 3))
        details = header.get((_DETAILS.get(kind, 0), _STRUCT), {})
        encoding = details.get((4 if kind == _DATA_V2 else 2, _I32), 0)
        page = _PageHeader(kind, size, stored, details.get((1, _I32), 0), encoding, file.tell())
        position = page.start + stored
        if not all(0 <= number < 1 << 31 for number in page[:5]) or position > stop:
            raise ValueError(f"{page} in a column of {stop - page.start} further bytes")
        if kind == _DICTIONARY and values:
            raise ValueError("a dictionary comes after values")
        if kind != _DICTIONARY:
            values += page.values
        yield page
    if values > column.num_values:
        raise ValueError(f"a column has {values} values; its metadata has {column.num_values}")


def _longest_text(file: BinaryIO, page: _PageHeader, compression: str) -> int:
    """Return the length of the longest text in a dictionary."""
    file.seek(page.start)
    data = file.read(page.stored)
    if compression != "UNCOMPRESSED":
        codec = "lz4_raw" if compression == "LZ4" else compression.lower()
        data = pa.decompress(data, page.size, codec, asbytes=True)
    longest = position = 0
    while position < len(data):
        length = int.from_bytes(data[position : position + 4], "little")
        longest = max(longest, length)
        position += 4 + length
    return min(longest, len(data))


def _read_struct(file: BinaryIO) -> dict[tuple[int, int], Any]:
    """Read a struct of Thrift's compact protocol: values by number and kind of their fields.

    So a field of a kind that is not expected is not found; pyarrow skips it.
    """
    fields: dict[tuple[int, int], Any] = {}
    number = 0
    while head := _read_byte(file):
        if head < 16:  # no writer needs this form, in which a field may occur twice
            raise ValueError("the fields of a page's header are not in order")
        number += head >> 4
        kind = head & 15
        value: Any = None
        if kind in (_I32, _I64):
            coded = _read_unsigned(file)
            value = (coded >> 1) ^ -(coded & 1)
        elif kind == _STRUCT:
            value = _read_struct(file)
        elif kind == _BINARY:
            file.seek(_read_unsigned(file), os.SEEK_CUR)
        elif kind not in (_TRUE, _FALSE):  # which have no further bytes
            raise ValueError(f"a page's header has a field of kind {kind}")
        fields[number, kind] = value
    return fields


def _read_unsigned(file: BinaryIO) -> int:
    value = 0
    for shift in range(0, 70, 7):
        byte = _read_byte(file)
        value |= (byte & 127) << shift
        if byte < 128:
            return value
    raise ValueError("a page's header has a number of over ten bytes")


def _read_byte(file: BinaryIO) -> int:
    byte = file.read(1)
    if not byte:
        raise ValueError("a page's header is truncated")
    return byte[0]
