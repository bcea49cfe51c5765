"""Read the tables of a LeRobot dataset's `meta/`: its episodes, and the texts of its tasks."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from robomme_interference_data.constants import EPISODES_DIR, TASKS_PATH
from robomme_interference_data.errors import FormatError, MissingFileError

from ..arrow_columns import concatenated, is_plain, simplified
from ..files import Files, reading
from ..parquet import RowSpan, open_parquet, read_table
from ..text import parse_json, read_bytes

_LINES_OF_EPISODES = "meta/episodes.jsonl"
_LINES_OF_TASKS = "meta/tasks.jsonl"

# Upper bounds, checked before anything is allocated.
_MAX_LINES_BYTES = 64 << 20  # of the per-episode columns as lines: those of half a million episodes
_MAX_COLUMNS = 1000  # of these: each line may name others
_MAX_TABLE_BYTES = 1 << 30  # of the per-episode columns in all: a million episodes have less

_STATISTICS = "stats/"
"""What the names of columns with statistics begin with."""

_WHOLE = ("episode_index", "length", "dataset_from_index", "dataset_to_index")
_WHOLE_ENDS = ("/chunk_index", "/file_index")
"""LeRobot's own columns of whole numbers: these names, and names with these ends."""

_TASK_COLUMNS = ("task", "__index_level_0__")
"""LeRobot stores the texts as pandas' index, which pandas names so if it has no name."""


def read_episodes(
    files: Files, names: Sequence[str] = (), statistics: Sequence[str] = ()
) -> pa.Table:
    """Read the per-episode columns of a dataset v3.0, its rows in the order of the files.

    Args:
        files: The dataset's files.
        names: Its tables, if they are known; else those of `meta/episodes`.
        statistics: Features whose statistics are read, too.
    """
    paths = [files.path(name) for name in names] or _episode_tables(files)
    wanted = tuple(f"{_STATISTICS}{feature}/" for feature in statistics)
    tables = []
    for path in paths:
        file = open_parquet(path)
        columns = [
            field.name
            for field in file.schema_arrow
            if is_plain(field.type)
            and (not field.name.startswith(_STATISTICS) or field.name.startswith(wanted))
        ]
        tables.append(read_table(file, path, columns))
        if sum(table.nbytes for table in tables) > _MAX_TABLE_BYTES:
            what = f"the episode tables have over {_MAX_TABLE_BYTES:,} bytes"
            raise FormatError.damaged(path, what)
    try:
        table = concatenated(tables)
    except pa.ArrowException as error:
        raise FormatError(
            f"the tables in {files.describe()}/{EPISODES_DIR} have columns of different types: "
            f"{error}",
            "Write the column with one type in all of them.",
        ) from None
    return _with_plain_numbers(table)


def _episode_tables(files: Files) -> list[Path]:
    paths = [files.path(name) for name in files.list(EPISODES_DIR, ".parquet")]
    if not paths:
        raise MissingFileError(
            f"{EPISODES_DIR} holds no parquet file in {files.describe()}",
            "The dataset is incomplete: download or build it again.",
        )
    return paths


def episode_column_names(files: Files) -> list[str]:
    """Return the names of all per-episode columns of a dataset v3.0, statistics among them."""
    tables = (open_parquet(path).schema_arrow.names for path in _episode_tables(files))
    return list(dict.fromkeys(name for names in tables for name in names))


def _with_plain_numbers(table: pa.Table) -> pa.Table:
    """Return the table with floats for decimals, and LeRobot's whole numbers as integers.

    DuckDB makes decimals of numbers, pandas makes floats of whole ones.
    """
    for position, name in enumerate(table.column_names):
        column = table[name]
        if pa.types.is_decimal(column.type):
            column = simplified(column)
            table = table.set_column(position, name, column)
        if pa.types.is_floating(column.type) and (name in _WHOLE or name.endswith(_WHOLE_ENDS)):
            whole = pc.cast(column, pa.int64(), safe=False)
            if pc.all(pc.equal(whole, column)).as_py():
                table = table.set_column(position, name, whole)
    return table


def read_episode_lines(files: Files) -> pa.Table:
    """Read the per-episode columns of a dataset v2.1."""
    rows = list(_json_lines(files, _LINES_OF_EPISODES))
    names = dict.fromkeys(name for row in rows for name in row)
    path = files.path(_LINES_OF_EPISODES)
    if len(names) > _MAX_COLUMNS:
        raise FormatError.damaged(path, f"{len(names)} columns")
    with reading(path):
        return pa.table({name: [row.get(name) for row in rows] for name in names})


def read_tasks(files: Files, *, lines: bool) -> dict[int, str]:
    """Read the texts of a dataset's tasks by their index; `lines` are those of v2.1."""
    path = files.path(_LINES_OF_TASKS if lines else TASKS_PATH)
    if lines:
        rows = list(_json_lines(files, _LINES_OF_TASKS))
        column = "task"
    else:
        table = RowSpan(path)
        column = next((name for name in _TASK_COLUMNS if name in table.names), _TASK_COLUMNS[0])
        rows = table.table(["task_index", column]).to_pylist()
    texts: dict[int, str] = {}
    for row in rows:
        index, text = row.get("task_index"), row.get(column)
        if isinstance(index, float) and index.is_integer():
            index = int(index)
        if not isinstance(index, int) or not isinstance(text, str):
            raise FormatError.damaged(path, f"task_index is {index!r}, and its text {text!r}")
        if texts.setdefault(index, text) != text:
            raise FormatError(
                f"{path}: task_index {index} is both {texts[index]!r} and {text!r}",
                "Give every task an index of its own.",
            )
    # LeRobot finds a task of v3.0 by its place, not by its number.
    if not lines and [*texts] != [*range(len(texts))]:
        raise FormatError(
            f"{path} lists the tasks {', '.join(map(str, [*texts][:5]))}, …; expected 0, 1, … in "
            "this order, as LeRobot reads them by their place",
            "Sort the table by task_index, and number the tasks without gaps.",
        )
    return texts


def _json_lines(files: Files, relative: str) -> Iterator[dict[str, Any]]:
    path = files.path(relative)
    for number, line in enumerate(read_bytes(path, _MAX_LINES_BYTES).splitlines(), 1):
        if line.strip():
            yield parse_json(line, f"{path}, line {number}", nan_as_none=True)
