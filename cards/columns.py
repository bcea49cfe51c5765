"""What the columns of a table are: their types from its schema, their meaning from its record."""

import inspect
import re
from dataclasses import dataclass, fields, is_dataclass
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import pyarrow as pa

from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import arrow_schema
from robomme_interference_data.schema.manifest import ROLES

_ATTRIBUTE = re.compile(r"^    (\w+(?:, \w+)*): (.+?)(?=^    \w|^\S|\Z)", re.MULTILINE | re.DOTALL)
_ELSEWHERE = re.compile(r" \(see [^)]*\)|, see [\w.]+(?=\.(?:\s|$))")  # where the code says more
_WORDS = {
    pa.string(): "text",
    pa.int64(): "whole number",
    pa.float64(): "number",
    pa.bool_(): "true or false",
    pa.binary(): "bytes",
}


_PARTS = {
    "family": "Family of the episode: the first part of its id.",
    "split": "Split of the episode: the second part of its id.",
    "index": "Number of the episode: the last part of its id.",
}
"""Columns that a record with an episode id has beside its fields."""


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
        record: A dataclass whose docstring has a section `Attributes`.
    """
    told, hints = _told(record), get_type_hints(record)
    found = []
    for field in arrow_schema(record):
        inner = _record_in(hints.get(field.name))
        if pa.types.is_struct(field.type) and inner is None:
            continue  # a map
        about = told.get(field.name, _PARTS.get(field.name, ""))
        parts = columns_of(inner) if inner else ()
        found.append(Column(field.name, field.type, about, parts))
    return tuple(found)


def _told(record: Any) -> dict[str, str]:
    text = (inspect.getdoc(record) or "").partition("Attributes:\n")[2]
    found = {}
    for names, about in _ATTRIBUTE.findall(text):
        for name in names.split(", "):
            text = " ".join(about.split()).replace("`ROLES`", ", ".join(ROLES))
            found[name] = _ELSEWHERE.sub("", text.replace("`", ""))
    return found


def _record_in(hint: Any) -> Any:
    """Return the record that a value is, or that its list is of, or None."""
    if get_origin(hint) in (tuple, UnionType):
        return next(filter(None, map(_record_in, get_args(hint))), None)
    own = is_dataclass(hint) and isinstance(hint, type) and hint is not EpisodeId
    return hint if own and fields(hint) else None
