"""Read Thrift's compact protocol, in which parquet files describe themselves: what is asked for.

Stricter than the libraries: what they skip, cut off or take the last of is an error here, so that
nobody reads other numbers than were looked at.
"""

from collections.abc import Mapping
from typing import Any

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
