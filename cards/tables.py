"""The tables of cards; their texts are already Markdown."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from itertools import chain
from statistics import mean, median
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import pyarrow as pa

from robomme_interference_data.constants import DIFFICULTIES
from robomme_interference_data.ids import EpisodeId, family_order
from robomme_interference_data.schema.codec import arrow_schema, descriptions
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.viz.tables import Columns, Table

from .markdown import code, escape

_WORDS = {
    pa.string(): "text",
    pa.int64(): "whole number",
    pa.float64(): "number",
    pa.bool_(): "true or false",
    pa.binary(): "bytes",
}
_DIFFICULTIES: Columns = {"easy": "count", "medium": "count", "hard": "count", "other": "count"}


def count_table(records: Iterable[EpisodeRecord]) -> Table:
    """Return the number of episodes by family and difficulty, and of their frames."""
    groups = _by_family(records)
    difficulties = _difficulty_columns(chain.from_iterable(groups.values()))
    rows = [
        (
            escape(name),
            len(of_family),
            *_count_difficulties(of_family, difficulties),
            sum(record.length for record in of_family),
        )
        for name, of_family in groups.items()
    ]
    columns: Columns = {"family": "text", "episodes": "count"}
    columns |= difficulties
    columns["frames"] = "count"
    return Table("counts", "Episodes", columns, [*rows, _total(rows)])


def unit_table(queries: Iterable[EpisodeRecord], units: Iterable[EpisodeRecord]) -> Table:
    """Return the number of queries by family and difficulty, and of units by family."""
    groups, pool = _by_family(queries), Counter(unit.episode_id.family for unit in units)
    difficulties = _difficulty_columns(chain.from_iterable(groups.values()))
    rows = []
    for name in sorted({*groups, *pool}, key=family_order):
        of_family = groups.get(name, [])
        counts = _count_difficulties(of_family, difficulties)
        rows.append((escape(name), len(of_family), *counts, pool[name]))
    columns: Columns = {"family": "text", "queries": "count"}
    columns |= difficulties
    columns["units"] = "count"
    return Table("counts", "Queries and units", columns, [*rows, _total(rows)])


def goal_table(records: Iterable[EpisodeRecord]) -> Table:
    """Return the goal of the first episode of each family."""
    first = [of_family[0] for of_family in _by_family(records).values()]
    rows = [
        (escape(record.episode_id), escape(record.difficulty or ""), escape(record.goal))
        for record in first
    ]
    columns: Columns = {"episode": "text", "difficulty": "text", "goal": "text"}
    return Table("goals", "Goals", columns, rows).without_empty("difficulty")


def condition_table(conditions: Iterable[str], manifests: Iterable[BufferManifest]) -> Table:
    """Return the contents of the buffers of each condition."""
    groups: dict[str, list[BufferManifest]] = {name: [] for name in conditions}
    for manifest in manifests:
        groups.setdefault(manifest.condition, []).append(manifest)
    rows = []
    for name, of_condition in groups.items():
        frames = [manifest.history_frames for manifest in of_condition] or [0]
        rows.append(
            (
                escape(name),
                "paper" if name in DEFAULT_CONDITIONS else "extension",
                len(of_condition),
                max((len(manifest.sessions) for manifest in of_condition), default=0),
                min(frames),
                round(median(frames)),
                max(frames),
                mean(manifest.lesson_share for manifest in of_condition) if of_condition else None,
            )
        )
    columns: Columns = {
        "condition": "text",
        "origin": "text",
        "buffers": "count",
        "sessions": "count",
        "min": "count",
        "median": "count",
        "max": "count",
        "lesson_share": "rate",
    }
    return Table("conditions", "Conditions", columns, rows)


def _by_family(records: Iterable[EpisodeRecord]) -> dict[str, list[EpisodeRecord]]:
    """Return records by family, in canonical order."""
    groups = defaultdict[str, list[EpisodeRecord]](list)
    for record in records:
        groups[record.episode_id.family].append(record)
    return {name: groups[name] for name in sorted(groups, key=family_order)}


def _difficulty_columns(records: Iterable[EpisodeRecord]) -> Columns:
    """Return the columns of the difficulties; none if no episode has one."""
    return _DIFFICULTIES if any(record.difficulty for record in records) else {}


def _count_difficulties(records: Sequence[EpisodeRecord], columns: Columns) -> tuple[int, ...]:
    if not columns:
        return ()
    counts = Counter(record.difficulty for record in records)
    known = [counts[name] for name in DIFFICULTIES]
    return (*known, len(records) - sum(known))


def _total(rows: Sequence[tuple[Any, ...]]) -> tuple[Any, ...]:
    return ("all", *(sum(column) for column in list(zip(*rows, strict=True))[1:]))


# --- the columns of a table ----------------------------------------------------------------------


@dataclass(frozen=True)
class CardColumn:
    """A column of a table; `parts` are the fields of a record in it."""

    name: str
    type: pa.DataType
    meaning: str
    parts: tuple["CardColumn", ...] = ()

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
        """The type in words."""
        item = _WORDS.get(self.item, "record")
        return f"list of {item}s".replace("texts", "text") if self.repeated else item


def columns_of(record: Any) -> tuple[CardColumn, ...]:
    """Return the columns of a dataclass, without maps, whose keys differ between files."""
    texts, hints = descriptions(record), get_type_hints(record)
    columns = []
    for field in arrow_schema(record):
        inner = _record_in(hints.get(field.name))
        if pa.types.is_struct(field.type) and inner is None:
            continue  # a map
        parts = columns_of(inner) if inner else ()
        meaning = texts[field.name].replace("`", "")
        columns.append(CardColumn(field.name, field.type, meaning, parts))
    return tuple(columns)


def column_table(record: type) -> Table:
    """Return the columns of a record as a table."""
    rows = [*_column_rows(columns_of(record), "")]
    return Table("columns", "Columns", {"column": "text", "type": "text", "meaning": "text"}, rows)


def _column_rows(columns: Iterable[CardColumn], within: str) -> Iterator[tuple[str, str, str]]:
    """Yield name, type and meaning of columns, and of the fields of records in them."""
    for column in columns:
        name = within + column.name
        yield code(name), column.words, escape(column.meaning)
        yield from _column_rows(column.parts, f"{name}.")


def _record_in(hint: Any) -> Any:
    """Return the dataclass of a value, or of the items of a list; None if there is none."""
    if get_origin(hint) in (tuple, UnionType):
        return next(filter(None, map(_record_in, get_args(hint))), None)
    own = is_dataclass(hint) and isinstance(hint, type) and hint is not EpisodeId
    return hint if own and fields(hint) else None
