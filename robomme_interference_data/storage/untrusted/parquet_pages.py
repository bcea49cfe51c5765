"""Compute what columns of a parquet file take once decoded, before pyarrow reads them.

pyarrow allocates what the headers of pages declare, regardless of the file's metadata: 4 GB for a
file of 287 bytes. So the headers are read here first. pyarrow's own view of the metadata is not
used: damaged metadata crashes it. The format's `parquet.thrift` describes both.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

import pyarrow as pa

MAX_FOOTER_BYTES = 16 << 20
"""Metadata of a file: files of LeRobot of 100 MB, a row group per episode, have half as much."""

_MAX_CHUNKS = 1 << 19  # columns of all row groups: pyarrow takes a kilobyte for each
_MAX_PAGES = 1 << 16  # of a column in a row group: writers make one per megabyte or 20,000 rows
_MAX_DEPTH = 16  # of structs and lists in metadata: parquet has half as many
_MAX_STRUCTS = 1 << 20  # in all: a column of a row group has about six

_HEADER_BYTES = (1 << 9, 1 << 20)
"""Bytes of a page's header that are read first, and at most: it may quote values."""

_DATA, _DICTIONARY, _DATA_V2 = 0, 2, 3
"""Kinds of pages."""

_BY_DICTIONARY = (2, 8)
_BY_PREFIX = 7
"""Encodings: indices into a dictionary; how much of the previous value is repeated."""

_WIDTHS = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "INT96": 12, "FLOAT": 4, "DOUBLE": 8}

_OVERHEAD = 16
"""Bytes that a value in Arrow takes in addition: offset, validity, levels of nesting."""

_NEGLIGIBLE = 16 << 20
"""Bytes up to which the longest value of a dictionary is estimated."""

_CODECS = {1: "snappy", 2: "gzip", 4: "brotli", 6: "zstd", 7: "lz4_raw"}
"""Supported compression, in addition to 0 for none."""

I32, I64, LIST, STRUCT = 5, 6, 9, 12
_TRUE, _FALSE, _BYTE, _I16, _DOUBLE, _BINARY, _SET = 1, 2, 3, 4, 7, 8, 10
_NUMBERS = (_I16, I32, I64)
"""Thrift's kinds of values."""

type Fields = Mapping[int, tuple[int, "Fields | None"]]
"""Kind of each field to read by number and, for (lists of) structs, their fields."""

_COLUMN: Fields = {4: (I32, None), 5: (I64, None), 7: (I64, None), 9: (I64, None), 11: (I64, None)}
_GROUP: Fields = {1: (LIST, {3: (STRUCT, _COLUMN)}), 3: (I64, None)}
_FILE: Fields = {4: (LIST, _GROUP)}
_DATA_HEADER: Fields = {1: (I32, None), 2: (I32, None)}
_DATA_V2_HEADER: Fields = {1: (I32, None), 4: (I32, None)}
_PAGE: Fields = {
    **{field: (I32, None) for field in (1, 2, 3)},
    **{field: (STRUCT, _DATA_HEADER) for field in (5, 7)},
    8: (STRUCT, _DATA_V2_HEADER),
}


@dataclass(frozen=True)
class Chunk:
    """A column in a row group: its compression, number of values, and position in the file."""

    codec: int
    values: int
    start: int
    stop: int


@dataclass(frozen=True)
class _Page:
    """A page: its kind, decompressed and stored size, position, number of values, and encoding."""

    kind: int
    size: int
    stored: int
    start: int
    values: int
    encoding: int


def read_chunks(path: Path) -> list[list[Chunk]]:
    """Read the columns of each row group from the metadata at the end of a file."""
    with path.open("rb") as file:
        end = file.seek(0, 2)
        file.seek(max(0, end - 8))
        size = int.from_bytes(file.read(4), "little")
        if file.read(4) != b"PAR1":
            raise ValueError("it does not end like a parquet file")
        if not 0 < size <= min(MAX_FOOTER_BYTES, end - 12):
            raise ValueError(f"{size:,} bytes of metadata; expected at most {MAX_FOOTER_BYTES:,}")
        file.seek(end - 8 - size)
        return _parsed(file.read(size), end)


@lru_cache(8)  # an episode is read several times in a row
def _parsed(metadata: bytes, end: int) -> list[list[Chunk]]:
    try:
        parsed = Thrift(metadata).struct(_FILE)
    except IndexError:
        raise ValueError("its metadata is truncated") from None
    groups = [group.get(1, []) for group in parsed.get(4, [])]
    if sum(map(len, groups)) > _MAX_CHUNKS:
        raise ValueError(f"over {_MAX_CHUNKS:,} columns in all row groups")
    return [[_chunk(column.get(3, {}), end) for column in group] for group in groups]


def _chunk(column: dict[int, int], end: int) -> Chunk:
    codec, values, stored, start = (column.get(field, -1) for field in (4, 5, 7, 9))
    dictionary = column.get(11, 0)
    if 0 < dictionary < start:
        start = dictionary
    if not (0 <= values < 1 << 62 and 0 <= start <= start + stored <= end and stored >= 0):
        raise ValueError(f"a column of {values} values and {stored} bytes at {start} of {end}")
    return Chunk(codec, values, start, start + stored)


def decoded_size(file: BinaryIO, chunk: Chunk, kind: str, length: int, most: int) -> int:
    """Return an upper bound on the bytes of a column of a row group in Arrow.

    `kind` is its physical type, such as `BYTE_ARRAY`, and `length` the bytes of a value of fixed
    length. Beyond `most` bytes, the rest is not counted.
    """
    variable = kind == "BYTE_ARRAY"
    width = length if kind == "FIXED_LEN_BYTE_ARRAY" else _WIDTHS.get(kind, 0)
    size = values = indices = 0
    dictionary: _Page | None = None
    for page in _pages(file, chunk):
        size += page.size
        if page.kind == _DICTIONARY:
            dictionary = page
            continue
        values += page.values
        if page.encoding in _BY_DICTIONARY:
            indices += page.values
        elif page.encoding == _BY_PREFIX and variable:
            raise ValueError("a column is encoded by common prefixes, which is not supported")
        if size > most:
            return size
    if values != chunk.values:  # for which pyarrow allocates memory
        raise ValueError(f"a column has {values} values; its metadata has {chunk.values}")
    size += values * (width + _OVERHEAD)
    if dictionary is not None and variable:
        longest = max(0, dictionary.size - 4 * (dictionary.values - 1))
        if indices * longest > _NEGLIGIBLE and size <= most:
            longest = _longest(file, dictionary, chunk.codec)
        size += indices * longest
    return size


def _pages(file: BinaryIO, chunk: Chunk) -> Iterator[_Page]:
    position = chunk.start
    for _ in range(_MAX_PAGES):
        if position >= chunk.stop:
            return
        page = _page(file, position, chunk.stop)
        yield page
        position = page.start + page.stored
    raise ValueError(f"a column has over {_MAX_PAGES} pages")


def _page(file: BinaryIO, position: int, stop: int) -> _Page:
    for most in _HEADER_BYTES:
        file.seek(position)
        reader = Thrift(file.read(min(most, stop - position)))
        try:
            header = reader.struct(_PAGE)
            break
        except IndexError:
            continue
    else:
        raise ValueError("a page's header is truncated")
    kind = header.get(1, -1)
    details = header.get({_DATA: 5, _DICTIONARY: 7, _DATA_V2: 8}.get(kind, -1), {})
    encoding = details.get(4 if kind == _DATA_V2 else 2, 0)
    numbers = (kind, header.get(2, -1), header.get(3, -1), details.get(1, 0), encoding)
    if not all(0 <= number < 1 << 31 for number in numbers):
        raise ValueError(f"a page's header holds the numbers {numbers}")
    return _Page(*numbers[:3], position + reader.at, *numbers[3:])


def _longest(file: BinaryIO, page: _Page, codec: int) -> int:
    """Return the length of the longest value in a dictionary."""
    file.seek(page.start)
    data = file.read(page.stored)
    if codec != 0:
        if codec not in _CODECS:
            raise ValueError(f"a column has compression {codec}, which is not supported")
        data = pa.decompress(data, page.size, _CODECS[codec], asbytes=True)
    longest = at = 0
    for _ in range(page.values):
        if at + 4 > len(data):
            break
        length = int.from_bytes(data[at : at + 4], "little")
        longest, at = max(longest, length), at + 4 + length
    return min(longest, len(data))


class Thrift:
    """Reads Thrift's compact protocol, from the position `at` on.

    It is stricter than libraries, which skip, truncate or overwrite some values, so that others
    cannot read different numbers. It raises `IndexError` if the bytes end too early.
    """

    def __init__(self, data: bytes, at: int = 0):
        self._data = data
        self._structs_left = _MAX_STRUCTS
        self.at = at

    def struct(self, fields: Fields, depth: int = 0) -> dict[int, Any]:
        """Read a struct; return those of the given fields that it has."""
        self._structs_left -= 1
        if depth > _MAX_DEPTH or self._structs_left < 0:
            raise ValueError("its metadata is nested too deeply, or too long")
        values: dict[int, Any] = {}
        data, at, number = self._data, self.at, 0
        # Most metadata is skipped, here without a call for each byte.
        while head := data[at]:
            kind, at = head & 15, at + 1
            if head >> 4:
                number += head >> 4
            else:
                self.at = at
                number, at = self._signed(), self.at
            if not 0 <= number < 1 << 15:
                raise ValueError(f"its metadata has a field {number}")
            field = fields.get(number)
            if field is not None:
                if kind != field[0] or number in values:
                    what = f"field {number} of its metadata is of kind {kind}, or occurs twice"
                    raise ValueError(what)
                self.at = at
                values[number] = self._value(kind, field[1] or {}, depth)
                at = self.at
            elif kind in _NUMBERS:
                while data[at] > 127:
                    at += 1
                at += 1
            elif kind == _BINARY and data[at] < 128:
                at += 1 + data[at]
            else:
                self.at = at
                self._skip(kind, depth)
                at = self.at
        self.at = at + 1
        return values

    def _value(self, kind: int, fields: Fields, depth: int) -> Any:
        if kind == STRUCT:
            return self.struct(fields, depth + 1)
        if kind != LIST:
            return self._signed()
        inner, count = self._list()
        if count and inner != STRUCT:
            raise ValueError(f"its metadata lists values of kind {inner}")
        return [self.struct(fields, depth + 1) for _ in range(count)]

    def _list(self) -> tuple[int, int]:
        """Read the start of a list: the kind of its values, and their number."""
        head = self._byte()
        count = self._unsigned() if head >> 4 == 15 else head >> 4
        if count > len(self._data) - self.at:  # a value has at least a byte
            raise IndexError
        return head & 15, count

    def _skip(self, kind: int, depth: int) -> None:
        if depth > _MAX_DEPTH:
            raise ValueError("its metadata is nested too deeply")
        if kind in _NUMBERS:
            self._unsigned()
        elif kind == _BINARY:
            self._jump(self._unsigned())
        elif kind == STRUCT:
            self.struct({}, depth + 1)
        elif kind in (LIST, _SET):
            inner, count = self._list()
            for _ in range(count):
                self._skip(_BYTE if inner in (_TRUE, _FALSE) else inner, depth + 1)
        elif kind in (_BYTE, _DOUBLE):
            self._jump(1 if kind == _BYTE else 8)
        elif kind not in (_TRUE, _FALSE):  # parquet has no maps
            raise ValueError(f"its metadata holds a value of kind {kind}")

    def _jump(self, length: int) -> None:
        self.at += length
        if self.at > len(self._data):
            raise IndexError

    def _byte(self) -> int:
        self.at += 1
        return self._data[self.at - 1]

    def _unsigned(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = self._byte()
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        raise ValueError("its metadata holds a number of too many bytes")

    def _signed(self) -> int:
        value = self._unsigned()
        return (value >> 1) ^ -(value & 1)
