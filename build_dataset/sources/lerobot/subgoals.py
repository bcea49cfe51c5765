"""The subgoal of each frame of a LeRobot episode, as a text."""

import math
from typing import Any

from robomme_interference_data.errors import FormatError, MissingFileError, SourceError, named
from robomme_interference_data.storage.arrow_columns import is_text
from robomme_interference_data.storage.lerobot.dataset import LeRobotFiles
from robomme_interference_data.storage.parquet import RowSpan

_SUBTASKS = "meta/subtasks.parquet"
_STYLE = "subtask"
_LATE = 0.01
"""Largest part of a frame by which a rounded time may miss it."""


def subgoal_texts(lerobot: LeRobotFiles, rows: RowSpan, column: str) -> list[str]:
    """Return the subgoal of each of an episode's rows; empty where there is none.

    The column holds texts; or numbers of rows of `meta/subtasks.parquet`, negative for none; or
    LeRobot's language annotations, of which those of the style `subtask` count, each from its time
    on until the next.

    Raises:
        SourceError: The column has no such values, or its table of texts is missing.
        FormatError: A number has no text.
    """
    kind = lerobot.features[column]["dtype"]
    if kind == "string":
        return rows.texts(column)
    if kind == "language":
        return _annotated(lerobot, rows, column)
    texts = _subtasks(lerobot, column)
    numbers = rows.scalars(column).tolist()
    for number in numbers:
        if number >= 0 and number not in texts:
            what = f"column {column!r} holds {number}, which {_SUBTASKS} does not list"
            raise FormatError(f"{rows.path}: {what}", "Correct the dataset.")
    return [texts.get(number, "") for number in numbers]


def _subtasks(lerobot: LeRobotFiles, column: str) -> dict[int, str]:
    """Return the texts of the dataset's subtasks by number."""
    try:
        path = lerobot.files.path(_SUBTASKS)
    except MissingFileError:
        raise SourceError(
            f"column {column!r} of {lerobot.files.describe()} holds numbers of subtasks, but "
            f"{_SUBTASKS} with their texts is missing",
            f"Name a column of texts with {named('columns', 'subgoal=COLUMN')}, or leave it out.",
        ) from None
    table = RowSpan(path).table()
    texts = [field.name for field in table.schema if is_text(field.type)]
    if len(texts) != 1:
        raise FormatError(
            f"{path} has the columns {', '.join(table.column_names)}; expected subtask_index and "
            "one of texts",
            "Correct the dataset.",
        )
    values = table[texts[0]].to_pylist()
    numbers: list[Any] = [*range(len(table))]
    if "subtask_index" in table.column_names:
        numbers = table["subtask_index"].to_pylist()
    return {number: text or "" for number, text in zip(numbers, values, strict=True)}


def _annotated(lerobot: LeRobotFiles, rows: RowSpan, column: str) -> list[str]:
    """Return the texts of LeRobot's annotations, which each row has all of."""
    cells = rows.part(rows.start, rows.start + 1).table([column])[column].to_pylist()
    begin: dict[int, str] = {}
    for annotation in cells[0] or ():
        if "timestamp" not in annotation or "style" not in annotation:
            raise SourceError(
                f"column {column!r} holds annotations without the time from which they hold",
                f"Name LeRobot's with {named('columns', 'subgoal=language_persistent')}.",
            )
        if annotation["style"] == _STYLE:
            frame = max(0, math.ceil(annotation["timestamp"] * lerobot.fps - _LATE))
            if frame in begin:
                raise SourceError(
                    f"column {column!r} has two subtasks from frame {frame} on: {begin[frame]!r} "
                    f"and {annotation['content']!r}",
                    "Correct the dataset, or leave the column out.",
                )
            begin[frame] = annotation["content"] or ""
    texts, current = [], ""
    for frame in range(len(rows)):
        current = begin.get(frame, current)
        texts.append(current)
    return texts
