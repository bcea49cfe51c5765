"""Convert frozen dataclasses (rows and headers) to and from Arrow tables and JSON.

A field is a str, int, float, bool, bytes (in tables only), `EpisodeId`, another such dataclass, a
tuple of one of these, a dict from str to one of these, or one of these or None. A dataclass with a
field `episode_id` also has the columns `family`, `split` and `index`, for filters. The annotation
describes the field: `Annotated[int, "Stored frames."]`.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from itertools import accumulate
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import pyarrow as pa

from robomme_interference_data.errors import FormatError, MissingExtraError, first_line
from robomme_interference_data.ids import EpisodeId

_SCALARS: dict[Any, tuple[pa.DataType, tuple[type, ...], str]] = {
    str: (pa.string(), (str,), "text"),
    int: (pa.int64(), (int,), "a whole number"),
    float: (pa.float64(), (float, int), "a number"),
    bool: (pa.bool_(), (bool,), "true or false"),
    bytes: (pa.binary(), (bytes,), "bytes"),
}
_LARGEST = 1 << 63
"""Integers in tables and JSON are smaller."""

_PARTS = {
    "family": (pa.string(), "Family of the episode: the first part of its id."),
    "split": (pa.string(), "Split of the episode: the second part of its id."),
    "index": (pa.int64(), "Number of the episode: the last part of its id."),
}
"""Further columns of the field `episode_id`: type and description."""
_PART_FIELDS = [pa.field(name, kind, nullable=False) for name, (kind, _) in _PARTS.items()]


def arrow_schema(record: type, keys: Sequence[str] = ()) -> pa.Schema:
    """Return the columns of a dataclass; `keys` are those of its dicts, which become structs."""
    return pa.schema(list(_codec(record).arrow(keys)))


def descriptions(record: type) -> dict[str, str]:
    """Return the description of each column: the text of its field's `Annotated`."""
    texts = {}
    for name, hint in get_type_hints(record, include_extras=True).items():
        texts[name] = next(iter(getattr(hint, "__metadata__", ())), "")
        if name == "episode_id":
            texts |= {part: text for part, (_, text) in _PARTS.items()}
    return texts


def to_dict(record: Any) -> dict[str, Any]:
    """Return a record as plain values, for JSON and Arrow, columns in order."""
    write = _codec(type(record)).write
    plain: dict[str, Any] = write(record) if write else record
    return plain


def to_table(records: Iterable[Any], schema: pa.Schema) -> pa.Table:
    """Return records as a table; records that several lists share are converted once."""
    rows = list(records)
    return pa.table([_column(field, rows) for field in schema], schema=schema)


def _column(field: pa.Field, records: Sequence[Any]) -> pa.Array:
    if not records:
        return pa.array([], field.type)
    if field.name not in _names(records[0]):  # a part of the id
        return pa.array([getattr(record.episode_id, field.name) for record in records], field.type)
    values = [getattr(record, field.name) for record in records]
    codec = _codec(_hints(type(records[0]))[field.name])
    if codec.write is None:
        return pa.array(values, field.type)
    if codec.item is None:
        return pa.array([codec.write(value) for value in values], field.type)
    listed = [item for value in values for item in value]
    # By identity: the rows of a query share their sessions, which are costly to compare.
    distinct = {id(item): item for item in listed}
    position = {key: number for number, key in enumerate(distinct)}
    converted = [codec.item(item) for item in distinct.values()]
    order = pa.array([position[id(item)] for item in listed], pa.int64())
    items = pa.array(converted, field.type.value_type).take(order)
    offsets = pa.array([0, *accumulate(map(len, values))], pa.int32())
    return pa.ListArray.from_arrays(offsets, items, type=field.type)


def to_pandas(table: pa.Table) -> Any:
    """Return a table as a pandas `DataFrame`; pandas is not a dependency of this package."""
    try:
        import pandas  # noqa: F401 - pyarrow imports it with a less helpful error
    except ImportError as error:
        raise MissingExtraError(
            "to_pandas needs pandas, which is not installed", "Install it: pip install pandas"
        ) from error
    return table.to_pandas()


def from_table[T](record: type[T], table: pa.Table, path: object) -> Iterator[T]:
    """Yield the records of a table's rows; other columns are ignored."""
    names = _names(record)
    if missing := [name for name in names if name not in table.column_names]:
        raise FormatError.damaged(path, f"column {', '.join(missing)} is missing")
    names += [part for part in _PARTS if "episode_id" in names and part in table.column_names]
    return (from_dict(record, row, path) for row in table.select(names).to_pylist())


def from_dict[T](record: type[T], value: Any, path: object, *, strict: bool = False) -> T:
    """Return the record of plain values, the inverse of `to_dict`; `path` is for messages.

    If `strict`, unknown names are an error.
    """
    try:
        if strict and isinstance(value, Mapping):
            names = _names(record)
            known = {*names, *_PARTS} if "episode_id" in names else {*names}
            if unknown := sorted(map(str, value.keys() - known)):
                raise ValueError(f"unknown {', '.join(unknown)}")
        return _codec(record).read(value)  # type: ignore[no-any-return]
    except ValueError as error:
        raise FormatError.damaged(path, first_line(error)) from None


_hints: Callable[[type], dict[str, Any]] = cache(get_type_hints)  # which compiles every annotation


def _names(record: Any) -> list[str]:
    return [field.name for field in fields(record)]


# --- conversion by type ------------------------------------------------------------------------


@dataclass(frozen=True)
class _Converter:
    """Conversions of a type; `arrow` takes the keys of dicts.

    Without `write`, values are plain already. `item` is the `write` of a list's values.
    """

    arrow: Callable[[Sequence[str]], pa.DataType]
    read: Callable[[Any], Any]
    write: Callable[[Any], Any] | None = None
    optional: bool = False
    item: Callable[[Any], Any] | None = None


def _codec_of(hint: Any) -> _Converter:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (UnionType, Union):
        return _or_none(_codec(next(part for part in arguments if part is not NoneType)))
    if hint in _SCALARS:
        kind, types, expected = _SCALARS[hint]

        def scalar(value: Any) -> Any:
            # Not `isinstance`: to Python, true is also a whole number.
            if type(value) is not hint:
                _of(types, value, expected)
            if type(value) is int and not -_LARGEST <= value < _LARGEST:
                raise ValueError(f"a number of {value.bit_length()} bits; expected at most 64")
            return value if type(value) is hint else hint(value)

        return _Converter(lambda keys: kind, scalar)
    if hint is EpisodeId:
        return _Converter(lambda keys: pa.string(), EpisodeId.parse, str)
    if is_dataclass(hint):
        return _record(hint)
    if origin in (tuple, dict):
        return _list(_codec(arguments[0])) if origin is tuple else _map(_codec(arguments[1]))
    return _Converter(lambda keys: pa.null(), lambda value: value)


# Types are few, and read and written for every row.
_codec: Callable[[Any], _Converter] = cache(_codec_of)


def _or_none(plain: _Converter) -> _Converter:
    read, write = plain.read, plain.write
    return _Converter(
        plain.arrow,
        lambda value: None if value is None else read(value),
        write and (lambda value: None if value is None else write(value)),
        optional=True,
    )


def _list(item: _Converter) -> _Converter:
    read, write = item.read, item.write
    return _Converter(
        lambda keys: pa.list_(pa.field("item", item.arrow(keys), nullable=False)),
        lambda value: tuple(map(read, _of((list, tuple), value, "a list"))),
        lambda value: list(map(write, value) if write else value),
        item=write,
    )


def _map(item: _Converter) -> _Converter:
    read, write = item.read, item.write

    def checked(value: Any) -> Any:
        items = _of((dict,), value, "a map").items()
        return {_of((str,), key, "text"): read(inner) for key, inner in items}

    return _Converter(
        lambda keys: pa.struct([pa.field(key, item.arrow(keys), nullable=False) for key in keys]),
        checked,
        write and (lambda value: {key: write(inner) for key, inner in value.items()}),
    )


def _record(record: Any) -> _Converter:
    hints = _hints(record)
    codecs = {name: _codec(hints[name]) for name in _names(record)}
    identified = "episode_id" in codecs

    def arrow(keys: Sequence[str]) -> pa.DataType:
        columns = []
        for name, codec in codecs.items():
            columns.append(pa.field(name, codec.arrow(keys), nullable=codec.optional))
            if name == "episode_id":
                columns += _PART_FIELDS
        return pa.struct(columns)

    def read(value: Any) -> Any:
        given = _of((dict,), value, "a map")
        values = {}
        for name, codec in codecs.items():
            if name not in given and not codec.optional:
                raise ValueError(f"{name} is missing")
            try:
                values[name] = codec.read(given.get(name))
            except ValueError as error:
                raise ValueError(f"{name}: {first_line(error)}") from None
        for part in _PARTS if identified else ():
            expected = getattr(values["episode_id"], part)
            if given.get(part, expected) != expected:
                raise ValueError(f"{part} of {values['episode_id']} is {given[part]!r}")
        return record(**values)

    def write(value: Any) -> Any:
        plain = {}
        for name, codec in codecs.items():
            field_value = getattr(value, name)
            plain[name] = field_value if codec.write is None else codec.write(field_value)
        if identified:
            plain |= {part: getattr(value.episode_id, part) for part in _PARTS}
        return plain

    return _Converter(arrow, read, write)


def _of(types: tuple[type, ...], value: Any, expected: str) -> Any:
    if type(value) not in types:
        shown = repr(value)
        raise ValueError(f"{shown if len(shown) < 80 else shown[:77] + '…'}; expected {expected}")
    return value
