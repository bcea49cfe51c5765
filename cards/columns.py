"""What the columns of a table are: their types from its schema, their meaning from its record."""

from dataclasses import dataclass, fields, is_dataclass
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import pyarrow as pa

from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import arrow_schema, descriptions

_WORDS = {
    pa.string(): "text",
    pa.int64(): "whole number",
    pa.float64(): "number",
    pa.bool_(): "true or false",
    pa.binary(): "bytes",
}


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: Its name.
        type: Its type in Arrow.
        about: What it says, in a sentence or more; empty where nothing is told.
        parts: What a record in it is made of.
    """

    name: str
    type: pa.DataType
    about: str
    parts: tuple["Column", ...] = ()

    @property
    def repeated(self) -> bool:
        """Whether a value is a list."""
        return bool(pa.types.is_list(self.type))

    @property
    def item(self) -> pa.DataType:
        """Type of a value, or of one in its list."""
        return self.type.value_type if self.repeated else self.type

    @property
    def words(self) -> str:
        """Its type in words."""
        one = _WORDS.get(self.item, "record")
        return f"list of {one}s".replace("texts", "text") if self.repeated else one


def columns_of(record: Any) -> tuple[Column, ...]:
    """Return the columns of a record; those of its maps, which differ between files, are left out.

    Args:
        record: The dataclass.
    """
    texts, hints = descriptions(record), get_type_hints(record)
    found = []
    for field in arrow_schema(record):
        inner = _record_in(hints.get(field.name))
        if pa.types.is_struct(field.type) and inner is None:
            continue  # a map
        about = texts[field.name].replace("`", "")
        parts = columns_of(inner) if inner else ()
        found.append(Column(field.name, field.type, about, parts))
    return tuple(found)


def _record_in(hint: Any) -> Any:
    """Return the record that a value is, or that its list is of, or None."""
    if get_origin(hint) in (tuple, UnionType):
        return next(filter(None, map(_record_in, get_args(hint))), None)
    own = is_dataclass(hint) and isinstance(hint, type) and hint is not EpisodeId
    return hint if own and fields(hint) else None
