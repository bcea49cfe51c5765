"""Rows and headers as frozen dataclasses: their Arrow schema and JSON follow from the fields.

A field is text, a whole number, a number, a truth value, an `EpisodeId`, another such record, a
tuple of one of these, a map from text to one of these, or one of these or None. A record with a
field `episode_id` also has the columns `family`, `split` and `index`, to filter by.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import pyarrow as pa

from robomme_interference_data.constants import FORMAT_VERSION
from robomme_interference_data.errors import FormatError, InterferenceError
from robomme_interference_data.files import read_json
from robomme_interference_data.ids import EpisodeId

__all__ = ["arrow_schema", "from_dict", "from_table", "read_header", "to_dict", "to_table"]

_SCALARS: dict[Any, tuple[pa.DataType, str]] = {
    str: (pa.string(), "text"),
    int: (pa.int64(), "a whole number"),
    float: (pa.float64(), "a number"),
    bool: (pa.bool_(), "true or false"),
    EpisodeId: (pa.string(), "an episode id"),
}
_PARTS = ("family", "split", "index")
"""Columns that the field `episode_id` has beside its own."""


def arrow_schema(record: type, keys: Sequence[str] = ()) -> pa.Schema:
    """Return the columns of a record.

    Args:
        record: The dataclass.
        keys: Names that maps of text to text have; Arrow has them as structs.
    """
    return pa.schema(_arrow_fields(record, tuple(keys)))


def to_dict(record: Any) -> dict[str, Any]:
    """Return a record as plain values, for JSON and Arrow: columns in order."""
    plain: dict[str, Any] = _record_writer(type(record))(record, {})
    return plain


def to_table(records: Iterable[Any], schema: pa.Schema) -> pa.Table:
    """Return records as a table; parts that records share are converted once."""
    kept = list(records)  # alive, so that an id is one object's
    write = _record_writer(type(kept[0])) if kept else None
    shared: dict[int, Any] = {}
    rows = [write(record, shared) for record in kept] if write else []
    columns = {field.name: [row.get(field.name) for row in rows] for field in schema}
    return pa.table([_column(columns[field.name], field.type) for field in schema], schema=schema)


def _column(values: list[Any], kind: pa.DataType) -> pa.Array:
    """Return a column; of lists of records, each record that several lists share goes in once."""
    if not (pa.types.is_list(kind) and pa.types.is_struct(kind.value_type)):
        return pa.array(values, kind)
    place: dict[int, int] = {}
    distinct: list[Any] = []
    picks: list[int] = []
    offsets = [0]
    for listed in values:
        for one in listed:
            if id(one) not in place:
                place[id(one)] = len(distinct)
                distinct.append(one)
            picks.append(place[id(one)])
        offsets.append(len(picks))
    items = pa.array(distinct, kind.value_type).take(pa.array(picks, pa.int64()))
    return pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), items, type=kind)


def from_table[T](record: type[T], table: pa.Table, path: object) -> Iterator[T]:
    """Yield the records of a table's rows; further columns are left aside.

    Raises:
        FormatError: A column is missing or of another type, or a value is not what it should be;
            `path` is named.
    """
    names = _names(record)
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise FormatError.damaged(path, f"column {', '.join(missing)} is missing")
    return (from_dict(record, row, path) for row in table.select(list(names)).to_pylist())


def from_dict[T](record: type[T], value: Any, path: object, *, strict: bool = False) -> T:
    """Return the record that plain values stand for; the inverse of `to_dict`.

    Args:
        record: The dataclass.
        value: What was read.
        path: Where, for messages.
        strict: Refuse names that the record does not have.

    Raises:
        FormatError: A value is missing, or not of its field's type, or contradicts another.
    """
    try:
        if strict and isinstance(value, Mapping):
            known = set(_names(record))
            known |= set(_PARTS) if "episode_id" in known else set()
            if unknown := sorted(map(str, value.keys() - known)):
                raise ValueError(f"unknown {', '.join(unknown)}")
        kind: Any = record
        found: T = _reader(kind)(value)
        return found
    except InterferenceError as error:
        raise FormatError.damaged(path, error.message) from None
    except ValueError as error:
        raise FormatError.damaged(path, error) from None


def read_header[T](path: Path, record: type[T], *, strict: bool = True) -> T:
    """Read a JSON file with a `format_version` as a record.

    Raises:
        FormatError: It is damaged, or of a format version that this package does not know.
    """
    value = read_json(path)
    if "format_version" in _names(record):
        version = value.get("format_version")
        if version != FORMAT_VERSION:
            raise FormatError.version(path, version, FORMAT_VERSION)
    return from_dict(record, value, path, strict=strict)


# --- to plain values and Arrow -----------------------------------------------------------------

_Writer = Callable[[Any, dict[int, Any]], Any]
"""From a value to a plain one; what is shared by many rows is remembered by its id."""


@cache
def _writer(hint: Any) -> _Writer | None:
    """Return what makes plain values of a type; None where they are plain already."""
    plain, optional = _split(hint)
    if plain is EpisodeId:
        write: _Writer = _remembered(lambda value, shared: str(value))
    elif is_dataclass(plain):
        write = _remembered(_record_writer(plain))
    elif get_origin(plain) is tuple:
        write = _listed(_writer(get_args(plain)[0]))
    elif get_origin(plain) is dict and _writer(get_args(plain)[1]) is not None:
        write = _mapped(_writer(get_args(plain)[1]))
    else:
        return None
    if not optional:
        return write
    return lambda value, shared: None if value is None else write(value, shared)


def _remembered(write: _Writer) -> _Writer:
    def found(value: Any, shared: dict[int, Any]) -> Any:
        plain = shared.get(id(value))
        if plain is None:
            plain = shared[id(value)] = write(value, shared)
        return plain

    return found


def _record_writer(record: Any) -> _Writer:
    writers = [(name, _writer(hint)) for name, hint in _hints(record).items()]
    identified = "episode_id" in _hints(record)

    def write(value: Any, shared: dict[int, Any]) -> Any:
        found = {}
        for name, item in writers:
            one = getattr(value, name)
            found[name] = one if item is None else item(one, shared)
        if identified:
            episode = value.episode_id
            found |= {"family": episode.family, "split": episode.split, "index": episode.index}
        return found

    return write


def _listed(item: _Writer | None) -> _Writer:
    if item is None:
        return lambda value, shared: list(value)
    return lambda value, shared: [item(one, shared) for one in value]


def _mapped(item: _Writer | None) -> _Writer:
    return lambda value, shared: {key: item and item(one, shared) for key, one in value.items()}


def _names(record: Any) -> tuple[str, ...]:
    return tuple(_hints(record))


def _arrow_fields(record: type, keys: tuple[str, ...]) -> list[pa.Field]:
    found = []
    for name, hint in _hints(record).items():
        plain, optional = _split(hint)
        found.append(pa.field(name, _arrow_type(plain, keys), nullable=optional))
        if name == "episode_id":
            found += [
                pa.field("family", pa.string(), nullable=False),
                pa.field("split", pa.string(), nullable=False),
                pa.field("index", pa.int64(), nullable=False),
            ]
    return found


def _arrow_type(hint: Any, keys: tuple[str, ...]) -> pa.DataType:
    if hint in _SCALARS:
        return _SCALARS[hint][0]
    if is_dataclass(hint):
        return pa.struct(_arrow_fields(hint, keys))  # type: ignore[arg-type]
    if get_origin(hint) is tuple:
        return pa.list_(pa.field("item", _arrow_type(get_args(hint)[0], keys), nullable=False))
    value = _arrow_type(get_args(hint)[1], keys)
    return pa.struct([pa.field(key, value, nullable=False) for key in keys])


# --- from plain values -------------------------------------------------------------------------


def _hints(record: Any) -> dict[str, Any]:
    return _cached_hints(record)


@cache
def _cached_hints(record: Any) -> dict[str, Any]:
    hints = get_type_hints(record)
    return {field.name: hints[field.name] for field in fields(record)}


def _split(hint: Any) -> tuple[Any, bool]:
    """Return a type without None, and whether None was allowed."""
    if get_origin(hint) in (UnionType, Union):
        plain = [part for part in get_args(hint) if part is not NoneType]
        return plain[0], True
    return hint, False


@cache
def _reader(hint: Any) -> Callable[[Any], Any]:
    """Return what checks and converts a plain value of a type."""
    plain, optional = _split(hint)
    nested = is_dataclass(plain) and plain is not EpisodeId
    read = _record_reader(plain) if nested else _value_reader(plain)
    if not optional:
        return read
    return lambda value: None if value is None else read(value)


def _value_reader(hint: Any) -> Callable[[Any], Any]:
    if hint is EpisodeId:
        return EpisodeId.parse
    if hint is Any:
        return lambda value: value
    if hint is float:
        return lambda value: float(_of((float, int), value, "a number"))
    if hint in _SCALARS:
        expected = _SCALARS[hint][1]
        return lambda value: _of((hint,), value, expected)
    if get_origin(hint) is tuple:
        item = _reader(get_args(hint)[0])
        return lambda value: tuple(map(item, _of((list, tuple), value, "a list")))
    item = _reader(get_args(hint)[1]) if get_args(hint) else lambda value: value
    return lambda value: {
        _of((str,), key, "text"): item(one) for key, one in _of((dict,), value, "a map").items()
    }


def _of(types: tuple[type, ...], value: Any, expected: str) -> Any:
    if type(value) not in types:
        shown = repr(value)
        raise ValueError(f"{shown if len(shown) < 80 else shown[:77] + '…'}; expected {expected}")
    return value


def _record_reader(record: Any) -> Callable[[Any], Any]:
    readers = {name: _reader(hint) for name, hint in _hints(record).items()}
    optional = {name for name, hint in _hints(record).items() if _split(hint)[1]}

    def read(value: Any) -> Any:
        given = _of((dict,), value, "a map")
        found = {}
        for name, reader in readers.items():
            if name not in given and name not in optional:
                raise ValueError(f"{name} is missing")
            try:
                found[name] = reader(given.get(name))
            except InterferenceError as error:
                raise ValueError(f"{name}: {error.message}") from None
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
        return record(**found)

    return read
