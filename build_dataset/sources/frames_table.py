"""The table of a frames folder: `frames.parquet`, one row a frame."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from robomme_interference_data.errors import FormatError, InvalidIdError, SourceError, nearest
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.storage.parquet import RowSpan, is_listed

from .base import demonstration_length

TABLE = "frames.parquet"
"""Name of the table in a frames folder."""

_SEE = "docs/sources.md describes the table, with an example that writes one."


@dataclass(frozen=True)
class EpisodeRows:
    """An episode as the table tells it; small and picklable.

    Attributes:
        start: Its first row.
        length: Its rows, which are its frames.
        lesson: Frames with `is_demo`; None if the table has no such column.
        goal: The goal in words.
        seed: Seed of the simulator, or None.
        difficulty: `easy`, `medium`, `hard`, or None.
        simulator: Its name, or None.
        exact: Whether the frames are the recorded pixels; None if not told.
    """

    start: int
    length: int
    lesson: int | None
    goal: str
    seed: int | None
    difficulty: str | None
    simulator: str | None
    exact: bool | None


def _is_text(kind: pa.DataType) -> bool:
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _is_vector(kind: pa.DataType) -> bool:
    return is_listed(kind) and bool(pa.types.is_floating(kind.value_type))


_COLUMNS: dict[str, tuple[Callable[[pa.DataType], bool], str]] = {
    "episode_id": (_is_text, "text such as MoveCube/train/3"),
    "frame_index": (pa.types.is_integer, "whole numbers"),
    "state": (_is_vector, "lists of floats"),
    "goal": (_is_text, "text"),
    "action": (_is_vector, "lists of floats"),
    "is_demo": (pa.types.is_boolean, "true or false"),
    "seed": (pa.types.is_integer, "whole numbers"),
    "difficulty": (_is_text, "text"),
    "simulator": (_is_text, "text"),
    "exact": (pa.types.is_boolean, "true or false"),
}
_REQUIRED = ("episode_id", "frame_index", "state", "goal")
_MAY_BE_EMPTY = ("seed", "difficulty", "simulator", "exact")


def read_frames_table(path: Path) -> dict[EpisodeId, EpisodeRows]:
    """Read and check the table of a frames folder."""
    try:
        table = RowSpan(path).table()
    except FormatError as error:
        raise SourceError(error.message, _SEE) from None
    _check_columns(path, table)
    found: dict[EpisodeId, EpisodeRows] = {}
    names = np.array(table["episode_id"].to_pylist(), dtype=object)
    cuts = [0, *(np.flatnonzero(names[1:] != names[:-1]) + 1).tolist(), len(names)]
    for start, stop in pairwise(cuts):
        try:
            name = EpisodeId.parse(names[start])
        except InvalidIdError as error:
            raise SourceError(f"{path}, row {start}: {error.message}", error.hint) from None
        if name in found:
            raise SourceError(
                f"{path}: the rows of {name} are not together: they go on in row {start}",
                "Sort the table by episode_id and frame_index before it is written.",
            )
        found[name] = _episode(f"{path}: {name}", table.slice(start, stop - start), start)
    return found


def _check_columns(path: Path, table: pa.Table) -> None:
    if not table.num_rows:
        raise SourceError(f"{path} has no rows", _SEE)
    for name in table.column_names:
        if name not in _COLUMNS:
            raise SourceError(
                f"{path}: unknown column {name!r}; known are {', '.join(_COLUMNS)}",
                f"Leave it out or rename it. {nearest(name, _COLUMNS, more='')}",
            )
    for name, (fits, expected) in _COLUMNS.items():
        if name not in table.column_names:
            if name in _REQUIRED:
                raise SourceError(f"{path}: column {name!r} is missing", _SEE)
            continue
        kind = table.schema.field(name).type
        if not fits(kind):
            raise SourceError(f"{path}: column {name!r} holds {kind}; expected {expected}", _SEE)
        if table[name].null_count and name not in _MAY_BE_EMPTY:
            row = pc.index(pc.is_null(table[name]), True).as_py()
            raise SourceError(f"{path}: column {name!r} has no value in row {row}", _SEE)


def _episode(where: str, rows: pa.Table, start: int) -> EpisodeRows:
    numbers = rows["frame_index"].to_numpy()
    wrong = np.flatnonzero(numbers != np.arange(len(rows)))
    if len(wrong):
        raise SourceError(
            f"{where}: frame_index in row {start + int(wrong[0])} is {numbers[wrong[0]]}; "
            f"expected {wrong[0]}, for it counts from 0 without gaps",
            "Sort the table by episode_id and frame_index, and add the frames that are missing "
            "or number them again.",
        )
    values: dict[str, Any] = {}
    for column in ("goal", *_MAY_BE_EMPTY):
        found = pc.unique(rows[column]).to_pylist() if column in rows.column_names else [None]
        if len(found) != 1:
            raise SourceError(
                f"{where} has several values of {column!r}: {', '.join(map(repr, found[:3]))}",
                "Give all rows of an episode the same one, or make two episodes of it.",
            )
        values[column] = found[0]
    marked = "is_demo" in rows.column_names
    lesson = demonstration_length(rows["is_demo"], f"{where}: is_demo") if marked else None
    return EpisodeRows(start, len(rows), lesson, **values)
