"""The table of a frames folder: `frames.parquet`, one row per frame."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from robomme_interference_data.constants import ACTION, STATE
from robomme_interference_data.errors import FormatError, InvalidIdError, SourceError, nearest
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.storage.arrow_columns import (
    is_listed,
    is_number,
    is_text,
    simplified,
)
from robomme_interference_data.storage.files import reading
from robomme_interference_data.storage.limits import MAX_RATE, MIN_RATE
from robomme_interference_data.storage.parquet import RowSpan

from .base import demonstration_length
from .episode_columns import parse_column

TABLE = "frames.parquet"
LAYOUT = "docs/how-to/your-own-recordings.md describes the layout, with an example that writes it."


@dataclass(frozen=True)
class EpisodeRows:
    """An episode in the table: first row, rows, demonstration frames, and its values, if any."""

    start: int
    length: int
    lesson: int | None
    goal: str
    seed: int | None
    difficulty: str | None
    simulator: str | None
    exact: bool | None
    fps: float | None
    state_names: tuple[str, ...] | None
    action_names: tuple[str, ...] | None

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """The names of the values of the state and the action, where they are known."""
        named = {STATE: self.state_names, ACTION: self.action_names}
        return {feature: names for feature, names in named.items() if names is not None}


def _is_vector(kind: pa.DataType) -> bool:
    return is_number(kind.value_type if is_listed(kind) else kind)


def _is_names(kind: pa.DataType) -> bool:
    return is_listed(kind) and is_text(kind.value_type)


def _is_flag(kind: pa.DataType) -> bool:
    return pa.types.is_boolean(kind) or is_number(kind) or is_text(kind)


def _is_number_or_text(kind: pa.DataType) -> bool:
    return is_number(kind) or is_text(kind) or pa.types.is_null(kind)


def _is_text_or_none(kind: pa.DataType) -> bool:
    return is_text(kind) or pa.types.is_null(kind)


_TEXT = is_text, "text"
_TEXT_OR_NONE = _is_text_or_none, "text"
_NAMES = _is_names, "lists of text"
_RATE = is_number, "numbers"
_VECTOR = _is_vector, "lists of numbers"
_COUNT = is_number, "whole numbers"
# Text and floats are read where they have one meaning: "7" and 7.0.
_NUMBER = _is_number_or_text, "whole numbers"
_FLAG = _is_flag, "true or false"
_REQUIRED: dict[str, tuple[Callable[[pa.DataType], bool], str]] = {
    "episode_id": _TEXT,
    "frame_index": _COUNT,
    "state": _VECTOR,
    "goal": _TEXT,
}
_NULLABLE = {
    "seed": _NUMBER,
    "difficulty": _TEXT_OR_NONE,
    "simulator": _TEXT_OR_NONE,
    "exact": _FLAG,
    "fps": _RATE,
    "state_names": _NAMES,
    "action_names": _NAMES,
}
_PANDAS_INDEX = "__index_level_0__"
_PARSED = ("seed", "difficulty", "simulator", "exact")
"""Columns whose values may be stored in several types, see `episode_columns`."""
_COLUMNS = {**_REQUIRED, "action": _VECTOR, "is_demo": _FLAG, **_NULLABLE}


def read_frames_table(path: Path) -> dict[EpisodeId, EpisodeRows | SourceError]:
    """Read and check the table of a frames folder; an episode may have an error instead of rows."""
    try:
        table = RowSpan(path).table()
        with reading(path):
            table = _simplified(table)
    except FormatError as error:
        raise SourceError(error.message, error.hint or LAYOUT) from None
    if not table.num_rows:
        raise SourceError(f"{path} has no rows", LAYOUT)
    if problem := _column_problem(table):
        raise SourceError(f"{path}: {problem}", LAYOUT)
    episodes: dict[EpisodeId, EpisodeRows | SourceError] = {}
    names = np.array(table["episode_id"].to_pylist(), dtype=object)
    cuts = [0, *(np.flatnonzero(names[1:] != names[:-1]) + 1).tolist(), len(names)]
    for start, stop in pairwise(cuts):
        try:
            name = EpisodeId.parse(names[start])
        except InvalidIdError as error:
            raise SourceError(f"{path}, row {start}: {error.message}", error.hint) from None
        if name in episodes:
            raise SourceError(
                f"{path}: the rows of {name} are not together: row {start} is another part",
                "Sort the table by episode_id and frame_index.",
            )
        try:
            episodes[name] = _episode(f"{path}: {name}", table.slice(start, stop - start), start)
        except SourceError as error:
            episodes[name] = error
    return episodes


def _simplified(table: pa.Table) -> pa.Table:
    """Return the table with columns of simple types, but for the vectors, which are large."""
    columns = {
        name: table[name] if name in ("state", "action") else simplified(table[name])
        for name in table.column_names
    }
    return pa.table(columns)


def _column_problem(table: pa.Table) -> str | None:
    """Return what is wrong with the columns of a table, if anything."""
    for name in table.column_names:
        if name == _PANDAS_INDEX:
            return f"column {name!r} is the index of a pandas table: write it with index=False"
        if name not in _COLUMNS:
            guess = nearest(name, _COLUMNS, more="")
            return f"unknown column {name!r}; known are {', '.join(_COLUMNS)}. {guess}"
    for name, (fits, expected) in _COLUMNS.items():
        if name not in table.column_names:
            if name in _REQUIRED:
                return f"column {name!r} is missing"
            continue
        kind = table.schema.field(name).type
        if not fits(kind):
            return f"column {name!r} holds {kind}; expected {expected}"
        if table[name].null_count and name not in _NULLABLE:
            row = pc.index(pc.is_null(table[name]), True).as_py()
            return f"column {name!r} has no value in row {row}"
    return None


def _episode(where: str, rows: pa.Table, start: int) -> EpisodeRows:
    numbers = rows["frame_index"].to_numpy()
    wrong = np.flatnonzero(numbers != np.arange(len(rows)))
    if len(wrong):
        raise SourceError(
            f"{where}: frame_index in row {start + int(wrong[0])} is {numbers[wrong[0]]}; "
            f"expected {wrong[0]}: it counts from 0 without gaps",
            "Sort the table by episode_id and frame_index, and add missing frames.",
        )
    values: dict[str, Any] = {}
    for column in ("goal", *_NULLABLE):
        distinct = [None]
        if column in rows.column_names:
            distinct = _distinct(where, column, rows[column])
        if len(distinct) != 1:
            raise SourceError(
                f"{where} has several values of {column!r}: {', '.join(map(repr, distinct[:3]))}",
                "An episode has one: make two episodes of it.",
            )
        values[column] = distinct[0]
    if values["fps"] is not None and not MIN_RATE <= values["fps"] <= MAX_RATE:
        raise SourceError(
            f"{where}: fps is {values['fps']:g}; expected {MIN_RATE:g} to {MAX_RATE:,.0f} frames "
            "per second",
            "Correct the column fps.",
        )
    marked = "is_demo" in rows.column_names
    lesson = None
    if marked:
        lesson = demonstration_length(rows["is_demo"].to_pylist(), f"{where}: is_demo")
    return EpisodeRows(start, len(rows), lesson, **values)


def _distinct(where: str, name: str, column: pa.ChunkedArray) -> list[Any]:
    """Return the distinct values of a column; lists, which pyarrow cannot compare, as tuples."""
    if is_listed(column.type):
        values = [None if value is None else tuple(value) for value in column.to_pylist()]
    else:
        values = pc.unique(column).to_pylist()
    if name in _PARSED:
        try:
            values = [parse_column(name, value) for value in values]
        except ValueError as error:
            raise SourceError(f"{where}: {error}", LAYOUT) from None
    return list(dict.fromkeys(values))
