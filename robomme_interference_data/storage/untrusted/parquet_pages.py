"""What columns of a parquet file take once they are decoded, told before pyarrow reads them.

pyarrow allocates what the header of a page says, and as many values as it tells, whatever the
file's metadata say of them: of 287 bytes, it made 4 GB. So the headers are read here first.
pyarrow's own view of the metadata is left aside: it ends the process where they are damaged.
`parquet.thrift` of the format's project describes both.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

import pyarrow as pa

I32, I64, LIST, STRUCT = 5, 6, 9, 12
"""Kinds of values."""

type Wanted = Mapping[int, tuple[int, "Wanted | None"]]
"""Number of a field to its kind and, of a struct or a list of structs, what is wanted of these."""

_DEEPEST = 16
"""Structs and lists inside each other, at most: parquet has half as many."""

_MOST_STRUCTS = 1 << 20
"""Structs in all, at most: a column of a row group has six or so."""

_TRUE, _FALSE, _BYTE, _I16, _DOUBLE, _BINARY, _SET, _MAP = 1, 2, 3, 4, 7, 8, 10, 11
_NUMBERS = (_I16, I32, I64)

MOST_FOOTER = 16 << 20
"""Bytes of a file's metadata, at most: LeRobot's files of 100 MB, a row group an episode, have
less than half."""

_MOST_CHUNKS = 1 << 19
"""Columns of all row groups, at most: pyarrow takes a kilobyte for each."""

_MOST_PAGES = 1 << 16
"""Pages of a column in a row group, at most: writers make one of a megabyte or 20,000 rows."""

_HEADER_BYTES = (1 << 9, 1 << 20)
"""Of a page's header: what is read first, and the most that it may have; it may quote values."""

_DATA, _DICTIONARY, _DATA_V2 = 0, 2, 3
"""Kinds of pages."""

_BY_DICTIONARY = (2, 8)
_BY_PREFIX = 7
"""Encodings: numbers of values in a dictionary; how much of the value before is repeated."""

_WIDTHS = {"BOOLEAN": 1, "INT32": 4, "INT64": 8, "INT96": 12, "FLOAT": 4, "DOUBLE": 8}

_BESIDE = 16
"""Bytes of a value in Arrow beside its own, at most: offset, validity, levels of nesting."""

_NEGLIGIBLE = 16 << 20
"""Bytes for which the longest value of a dictionary is not looked for."""

_CODECS = {1: "snappy", 2: "gzip", 4: "brotli", 6: "zstd", 7: "lz4_raw"}
"""Ways of compression that are read, besides none at all, which is 0."""

_COLUMN: Wanted = {4: (I32, None), 5: (I64, None), 7: (I64, None), 9: (I64, None), 11: (I64, None)}
_GROUP: Wanted = {1: (LIST, {3: (STRUCT, _COLUMN)}), 3: (I64, None)}
_FILE: Wanted = {4: (LIST, _GROUP)}
_DATA_HEADER: Wanted = {1: (I32, None), 2: (I32, None)}
_DATA_V2_HEADER: Wanted = {1: (I32, None), 4: (I32, None)}
_PAGE: Wanted = {
    **{field: (I32, None) for field in (1, 2, 3)},
    **{field: (STRUCT, _DATA_HEADER) for field in (5, 7)},
    8: (STRUCT, _DATA_V2_HEADER),
}


@dataclass(frozen=True)
class Chunk:
    """A column in a row group: its compression, its values, and where its pages lie."""

    codec: int
    values: int
    start: int
    stop: int


@dataclass(frozen=True)
class _Page:
    """A page: its kind, its size before and after compression, its values and their encoding."""

    kind: int
    size: int
    stored: int
    place: int
    values: int
    encoding: int


def read_chunks(path: Path) -> list[list[Chunk]]:
    """Read where the columns of each row group lie, as the end of a file tells it."""
    with path.open("rb") as file:
        end = file.seek(0, 2)
        file.seek(max(0, end - 8))
        size = int.from_bytes(file.read(4), "little")
        if file.read(4) != b"PAR1":
            raise ValueError("it does not end as a parquet file does")
        if not 0 < size <= min(MOST_FOOTER, end - 12):
            raise ValueError(f"{size:,} bytes of metadata; at most {MOST_FOOTER:,} are read")
        file.seek(end - 8 - size)
        return _parsed(file.read(size), end)


@lru_cache(8)  # an episode is read several times in a row
def _parsed(metadata: bytes, end: int) -> list[list[Chunk]]:
    try:
        told = Thrift(metadata).struct(_FILE)
    except IndexError:
        raise ValueError("its metadata are cut short") from None
    groups = [group.get(1, []) for group in told.get(4, [])]
    if sum(map(len, groups)) > _MOST_CHUNKS:
        raise ValueError(f"over {_MOST_CHUNKS:,} columns in all row groups")
    return [[_chunk(column.get(3, {}), end) for column in group] for group in groups]


def _chunk(told: dict[int, int], end: int) -> Chunk:
    codec, values, stored, start = (told.get(field, -1) for field in (4, 5, 7, 9))
    first = told.get(11, 0)
    if 0 < first < start:
        start = first
    if not (0 <= values < 1 << 62 and 0 <= start <= start + stored <= end and stored >= 0):
        raise ValueError(f"a column of {values} values and {stored} bytes at {start} of {end}")
    return Chunk(codec, values, start, start + stored)


def decoded_size(file: BinaryIO, chunk: Chunk, kind: str, length: int, most: int) -> int:
    """Return what a column of a row group takes in Arrow at most, in bytes.

    Args:
        file: The parquet file.
        chunk: Where it lies.
        kind: Its physical type, such as `BYTE_ARRAY`.
        length: Bytes of a value of fixed length.
        most: Bytes beyond which nothing is looked into any more.
    """
    variable = kind == "BYTE_ARRAY"
    width = length if kind == "FIXED_LEN_BYTE_ARRAY" else _WIDTHS.get(kind, 0)
    size = values = numbered = 0
    dictionary: _Page | None = None
    for page in _pages(file, chunk):
        size += page.size
        if page.kind == _DICTIONARY:
            dictionary = page
            continue
        values += page.values
        if page.encoding in _BY_DICTIONARY:
            numbered += page.values
        elif page.encoding == _BY_PREFIX and variable:
            raise ValueError("a column is encoded by common prefixes, which is not read")
        if size > most:
            return size
    if values != chunk.values:  # for so many, pyarrow makes room
        raise ValueError(f"a column has {values} values; {chunk.values} are told")
    size += values * (width + _BESIDE)
    if dictionary is not None and variable:
        longest = max(0, dictionary.size - 4 * (dictionary.values - 1))
        if numbered * longest > _NEGLIGIBLE and size <= most:
            longest = _longest(file, dictionary, chunk.codec)
        size += numbered * longest
    return size


def _pages(file: BinaryIO, chunk: Chunk) -> Iterator[_Page]:
    place = chunk.start
    for _ in range(_MOST_PAGES):
        if place >= chunk.stop:
            return
        page = _page(file, place, chunk.stop)
        yield page
        place = page.place + page.stored
    raise ValueError(f"a column has over {_MOST_PAGES} pages")


def _page(file: BinaryIO, place: int, stop: int) -> _Page:
    for most in _HEADER_BYTES:
        file.seek(place)
        header = Thrift(file.read(min(most, stop - place)))
        try:
            told = header.struct(_PAGE)
            break
        except IndexError:
            continue
    else:
        raise ValueError("a page's header is cut short")
    kind = told.get(1, -1)
    about = told.get({_DATA: 5, _DICTIONARY: 7, _DATA_V2: 8}.get(kind, -1), {})
    encoding = about.get(4 if kind == _DATA_V2 else 2, 0)
    numbers = (kind, told.get(2, -1), told.get(3, -1), about.get(1, 0), encoding)
    if not all(0 <= number < 1 << 31 for number in numbers):
        raise ValueError(f"a page's header holds the numbers {numbers}")
    return _Page(*numbers[:3], place + header.at, *numbers[3:])


def _longest(file: BinaryIO, page: _Page, codec: int) -> int:
    """Return the length of the longest value in a dictionary."""
    file.seek(page.place)
    data = file.read(page.stored)
    if codec != 0:
        if codec not in _CODECS:
            raise ValueError(f"a column is compressed in way {codec}, which is not read")
        data = pa.decompress(data, page.size, _CODECS[codec], asbytes=True)
    longest = at = 0
    for _ in range(page.values):
        if at + 4 > len(data):
            break
        length = int.from_bytes(data[at : at + 4], "little")
        longest, at = max(longest, length), at + 4 + length
    return min(longest, len(data))


class Thrift:
    """Values in bytes, from a place on; `IndexError` where the bytes end too early.

    Attributes:
        at: The place, which moves as values are read.
    """

    def __init__(self, data: bytes, at: int = 0):
        self._data = data
        self._structs_left = _MOST_STRUCTS
        self.at = at

    def struct(self, wanted: Wanted, depth: int = 0) -> dict[int, Any]:
        """Read a struct: the wanted fields that it has."""
        self._structs_left -= 1
        if depth > _DEEPEST or self._structs_left < 0:
            raise ValueError("its metadata are nested too deeply, or too many")
        found: dict[int, Any] = {}
        data, at, field = self._data, self.at, 0
        # Most of a file's metadata is skipped: here, without a call for each byte.
        while head := data[at]:
            kind, at = head & 15, at + 1
            if head >> 4:
                field += head >> 4
            else:
                self.at = at
                field, at = self._signed(), self.at
            if not 0 <= field < 1 << 15:
                raise ValueError(f"its metadata have a field {field}")
            about = wanted.get(field)
            if about is not None:
                if kind != about[0] or field in found:
                    what = f"field {field} of its metadata is of kind {kind}, or there twice"
                    raise ValueError(what)
                self.at = at
                found[field] = self._value(kind, about[1] or {}, depth)
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
        return found

    def _value(self, kind: int, wanted: Wanted, depth: int) -> Any:
        if kind == STRUCT:
            return self.struct(wanted, depth + 1)
        return self._structs(wanted, depth + 1) if kind == LIST else self._signed()

    def _structs(self, wanted: Wanted, depth: int) -> list[dict[int, Any]]:
        kind, count = self._items()
        if count and kind != STRUCT:
            raise ValueError(f"its metadata list values of kind {kind}")
        return [self.struct(wanted, depth) for _ in range(count)]

    def _items(self) -> tuple[int, int]:
        """Read how a list begins: the kind of its values, and how many there are."""
        head = self._byte()
        count = self._unsigned() if head >> 4 == 15 else head >> 4
        if count > len(self._data) - self.at:  # a value has a byte at least
            raise IndexError
        return head & 15, count

    def _skip(self, kind: int, depth: int) -> None:
        if depth > _DEEPEST:
            raise ValueError("its metadata are nested too deeply")
        if kind in _NUMBERS:
            while self._byte() > 127:
                pass
        elif kind == _BINARY:
            self._jump(self._unsigned())
        elif kind == STRUCT:
            self.struct({}, depth + 1)
        elif kind in (LIST, _SET):
            inner, count = self._items()
            for _ in range(count):
                self._skip(_BYTE if inner in (_TRUE, _FALSE) else inner, depth + 1)
        elif kind in (_BYTE, _DOUBLE):
            self._jump(1 if kind == _BYTE else 8)
        elif kind not in (_TRUE, _FALSE):  # parquet has no maps
            raise ValueError(f"its metadata hold a value of kind {kind}")

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
        raise ValueError("its metadata hold a number of too many bytes")

    def _signed(self) -> int:
        value = self._unsigned()
        return (value >> 1) ^ -(value & 1)
