"""The table of a frames folder: `frames.parquet`, one row a frame."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.sources.tables import open_parquet
from robomme_interference_data.errors import FormatError, InvalidIdError, SourceError, nearest
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.parquet import reading

__all__ = ["TABLE", "EpisodeRows", "FramesTable", "read_frames_table"]

TABLE = "frames.parquet"
"""Name of the table in a frames folder."""

_DIFFICULTIES = ("easy", "medium", "hard")
_SEE = "docs/sources.md describes the table, with an example that writes one."


@dataclass(frozen=True)
class EpisodeRows:
    """An episode as the table tells it.

    Attributes:
        id: Episode id.
        start: Its first row.
        length: Its rows, which are its frames.
        goal: The goal in words.
        demonstration_length: Frames with `is_demo`; None if the table has no such column.
        values: `seed`, `difficulty`, `simulator` and `exact`; None where not told.
    """

    id: EpisodeId
    start: int
    length: int
    goal: str
    demonstration_length: int | None
    values: dict[str, Any]


@dataclass(frozen=True)
class FramesTable:
    """All episodes in the order of the table, and the sizes of state and action (or None)."""

    episodes: tuple[EpisodeRows, ...]
    state_size: int
    action_size: int | None


def _is_text(kind: pa.DataType) -> bool:
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    return pa.types.is_string(kind) or pa.types.is_large_string(kind)


def _is_vector(kind: pa.DataType) -> bool:
    listed = pa.types.is_list(kind) or pa.types.is_large_list(kind)
    return (listed or pa.types.is_fixed_size_list(kind)) and pa.types.is_floating(kind.value_type)


_REQUIRED: dict[str, tuple[Callable[[pa.DataType], bool], str]] = {
    "episode_id": (_is_text, "text such as MoveCube/train/3"),
    "frame_index": (pa.types.is_integer, "whole numbers"),
    "state": (_is_vector, "lists of floats"),
    "goal": (_is_text, "text"),
}
_OPTIONAL: dict[str, tuple[Callable[[pa.DataType], bool], str]] = {
    "action": (_is_vector, "lists of floats"),
    "is_demo": (pa.types.is_boolean, "true or false"),
    "seed": (pa.types.is_integer, "whole numbers"),
    "difficulty": (_is_text, "text"),
    "simulator": (_is_text, "text"),
    "exact": (pa.types.is_boolean, "true or false"),
}

_WHOLE = ("action", "is_demo")
"""Optional columns that have a value in every row, if they are there."""


def read_frames_table(path: Path) -> FramesTable:
    """Read and check the table of a frames folder.

    Raises:
        SourceError: It is missing or malformed; says which episode and row, and what to do.
    """
    if not path.is_file():
        raise SourceError(f"{path} is missing", _SEE)
    try:
        with reading(path):
            table = open_parquet(path).read()
    except FormatError as error:
        raise SourceError(error.message, _SEE) from None
    _check_columns(path, table)
    spans = _spans(path, table)
    sizes = {
        name: _vector_size(path, table[name], name, spans)
        for name in ("state", "action")
        if name in table.column_names
    }
    episodes = tuple(_episode(path, table, *span) for span in spans)
    return FramesTable(episodes, sizes["state"], sizes.get("action"))


def _check_columns(path: Path, table: pa.Table) -> None:
    known = _REQUIRED | _OPTIONAL
    for name in table.column_names:
        if name not in known:
            raise SourceError(
                f"{path}: unknown column {name!r}; known are {', '.join(known)}",
                f"Leave it out or rename it. {nearest(name, known)}",
            )
    for name, (fits, expected) in known.items():
        if name not in table.column_names:
            if name in _REQUIRED:
                raise SourceError(f"{path}: column {name!r} is missing", _SEE)
            continue
        kind = table.schema.field(name).type
        if not fits(kind):
            raise SourceError(f"{path}: column {name!r} holds {kind}; expected {expected}", _SEE)
        if table[name].null_count and (name in _REQUIRED or name in _WHOLE):
            row = pc.index(pc.is_null(table[name]), True).as_py()
            raise SourceError(f"{path}: column {name!r} has no value in row {row}", _SEE)
    if not table.num_rows:
        raise SourceError(f"{path} has no rows", _SEE)


def _spans(path: Path, table: pa.Table) -> list[tuple[EpisodeId, int, int]]:
    """Return `(id, first row, row after the last)` of every episode."""
    names = np.array(table["episode_id"].to_pylist(), dtype=object)
    cuts = [0, *(np.flatnonzero(names[1:] != names[:-1]) + 1).tolist(), len(names)]
    spans: dict[EpisodeId, tuple[int, int]] = {}
    frames = table["frame_index"].to_numpy()
    for start, stop in pairwise(cuts):
        try:
            name = EpisodeId.parse(names[start])
        except InvalidIdError as error:
            raise SourceError(f"{path}, row {start}: {error.message}", error.hint) from None
        if name in spans:
            raise SourceError(
                f"{path}: the rows of {name} are not together: they go on in row {start}",
                "Sort the table by episode_id and frame_index before it is written.",
            )
        wrong = np.flatnonzero(frames[start:stop] != np.arange(stop - start))
        if len(wrong):
            row = start + int(wrong[0])
            raise SourceError(
                f"{path}, row {row}: frame_index of {name} is {frames[row]}; expected "
                f"{row - start}, for it counts from 0 without gaps",
                "Sort the table by episode_id and frame_index, and add the frames that are "
                "missing or number them again.",
            )
        spans[name] = (start, stop)
    return [(name, start, stop) for name, (start, stop) in spans.items()]


def _vector_size(
    path: Path, column: pa.ChunkedArray, name: str, spans: list[tuple[EpisodeId, int, int]]
) -> int:
    lengths: NDArray[np.int64] = pc.list_value_length(column).to_numpy()
    size = int(lengths[0])
    wrong = np.flatnonzero(lengths != size)
    if len(wrong) or size == 0:
        row = int(wrong[0]) if len(wrong) else 0
        owner = next(episode for episode, _, stop in spans if row < stop)
        raise SourceError(
            f"{path}, row {row}: {name} of {owner} has {lengths[row]} values; the first row has "
            f"{size}",
            f"Give every row a {name} of the same length, at least 1.",
        )
    if pc.list_flatten(column).null_count:
        raise SourceError(f"{path}: column {name!r} has vectors with empty values", _SEE)
    return size


def _episode(path: Path, table: pa.Table, name: EpisodeId, start: int, stop: int) -> EpisodeRows:
    rows = table.slice(start, stop - start)
    values: dict[str, Any] = {}
    for column in ("goal", "seed", "difficulty", "simulator", "exact"):
        if column not in rows.column_names:
            values[column] = None
            continue
        found = pc.unique(rows[column]).to_pylist()
        if len(found) != 1:
            raise SourceError(
                f"{path}: {name} has several values of {column!r}: "
                f"{', '.join(map(repr, found[:3]))}",
                "Give all rows of an episode the same one, or make two episodes of it.",
            )
        values[column] = found[0]
    goal = values.pop("goal")
    if not goal.strip():
        raise SourceError(f"{path}: the goal of {name} is empty", "Say it in words.")
    if values["difficulty"] not in (None, *_DIFFICULTIES):
        raise SourceError(
            f"{path}: the difficulty of {name} is {values['difficulty']!r}; expected one of "
            f"{', '.join(_DIFFICULTIES)}",
            nearest(values["difficulty"], _DIFFICULTIES),
        )
    length = None
    if "is_demo" in rows.column_names:
        flags = rows["is_demo"].to_numpy()
        length = int(flags.sum())
        if flags[length:].any():
            raise SourceError(
                f"{path}: is_demo of {name} is true in {length} frames, not all of them at the "
                "beginning",
                "A demonstration comes first and in one piece.",
            )
    return EpisodeRows(name, start, stop - start, goal, length, values)
