"""Find files of rollout rows and read their columns; `reading` checks the values."""

import codecs
import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.json as pa_json

from robomme_interference_data.constants import MAX_ROW_BYTES, RUN_HEADER, RUN_RECORD, RUN_TABLES
from robomme_interference_data.errors import (
    FormatError,
    InvalidOptionError,
    MissingFileError,
    named,
)
from robomme_interference_data.ids import nth_number
from robomme_interference_data.schema.rollouts import KEY_COLUMNS, Status
from robomme_interference_data.storage.files import parse_json, read_bytes, read_header, reading

from .values import record_schema

if TYPE_CHECKING:
    from robomme_interference_data.evaluate.run.log import RunHeader

_REQUIRED = ("family", "condition", "episode", "status", "success")
_RELEASED_NAMES = {"variant": "system", "retrieval_model": "retrieval"}
"""Columns of released files to their names here."""

_MAX_ROWS = 1 << 20
"""Rows in a file, at most: the paper's grid has 25,200."""


@dataclass(frozen=True)
class FileColumns:
    """The columns of one file, the line of each row, and why other lines are not rows."""

    columns: Mapping[str, Sequence[Any]]
    lines: Sequence[int]
    malformed: Mapping[int, str] = field(default_factory=dict)


def find_sources(paths: Sequence[Path]) -> "dict[Path, RunHeader | None]":
    """Return the file of rows of each path, with the header of the run that it belongs to.

    In a run's folder the file is the record.
    """
    sources: dict[Path, RunHeader | None] = {}
    for path_or_folder in paths:
        path = path_or_folder
        if path.is_dir():
            path = path / RUN_RECORD
        if not path.is_file():
            raise MissingFileError(
                f"there is no file {path}",
                "Give folders of runs, .csv, .parquet or .jsonl files, or .json of vla-eval.",
            )
        if any(path.samefile(source) for source in sources):
            raise InvalidOptionError(f"{path} is given twice", "Give each file once.")
        header = path.parent / RUN_HEADER
        of_run = path.name in (RUN_RECORD, *RUN_TABLES) and header.is_file()
        sources[path] = _read_run_header(header) if of_run else None
    return sources


def _read_run_header(path: Path) -> "RunHeader":
    # Files of rows alone do without runs.
    from robomme_interference_data.evaluate.run.log import RunHeader

    return read_header(path, RunHeader)


def system_of(path: Path) -> str | None:
    """Return the system in the name of an exported file (see `export`), or None."""
    match = re.fullmatch(r"(.+)-[^-]+_rollouts\.csv", path.name)
    return match[1] if match else None


def read_file(path: Path, names: Sequence[str], has_system: bool) -> FileColumns:
    """Read those of the named columns that a file has.

    The file must have a column `system` unless the system is known otherwise (`has_system`).
    """
    readers = {
        ".parquet": _read_parquet,
        ".csv": _read_csv,
        ".jsonl": _read_record,
        ".json": _read_vla_eval,
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise FormatError(f"{path} is not a {' or '.join(readers)} file", "Give a file of rows.")
    with reading(path):
        return reader(path, names, has_system)


def _select(
    path: Path, header: Sequence[str], names: Sequence[str], has_system: bool
) -> dict[str, str]:
    """Return the column of the file that holds each of the named columns."""
    if twice := [name for name in header if header.count(name) > 1]:
        raise FormatError(f"{path} has two columns {twice[0]!r}", "Rename one of them.")
    columns = {_RELEASED_NAMES.get(name, name): name for name in header}
    if missing := [name for name in _REQUIRED if name not in columns]:
        raise FormatError(
            f"{path} lacks the columns {', '.join(missing)}; it has {', '.join(header) or 'none'}",
            "Expected the rows of a run, or of the released CSVs (docs/reference/score-tables.md).",
        )
    if "system" not in columns and not has_system:
        raise FormatError(
            f"{path} names no system: it has no column 'system', and its name is not "
            "SYSTEM-SIMULATOR_rollouts.csv",
            f"Name it, such as {named('system', 'retrieval-framesamp-modul')} (of two files "
            "that are "
            f"compared: {named('system_a')}, {named('system_b')}).",
        )
    return {name: columns[name] for name in names if name in columns}


def _check_count(rows: int) -> None:
    if rows > _MAX_ROWS:
        raise ValueError(f"more than {_MAX_ROWS:,} rows; expected at most that many")


def _columns(path: Path, table: pa.Table) -> dict[str, list[Any]]:
    for column in table.columns:
        kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
        if pa.types.is_nested(kind):
            raise FormatError.damaged(path, f"a column holds {kind}; expected text and numbers")
    return {name: table[name].to_pylist() for name in table.column_names}


def _read_parquet(path: Path, names: Sequence[str], has_system: bool) -> FileColumns:
    # Only for these files: a run is read from its record.
    from robomme_interference_data.storage.parquet import open_parquet, read_table

    with open_parquet(path) as file:
        _check_count(file.metadata.num_rows)
        selected = _select(path, file.schema_arrow.names, names, has_system)
        table = read_table(file, path, list(selected.values()))
    columns = _columns(path, table)
    return FileColumns(
        {name: columns[column] for name, column in selected.items()}, range(1, len(table) + 1)
    )


def _read_csv(path: Path, names: Sequence[str], has_system: bool) -> FileColumns:
    text = read_bytes(path, MAX_ROW_BYTES).removeprefix(codecs.BOM_UTF8).decode()
    before = csv.field_size_limit(len(text) + 1)  # of the whole process
    try:
        return _parse_csv(path, text, names, has_system)
    finally:
        csv.field_size_limit(before)


def _parse_csv(path: Path, text: str, names: Sequence[str], has_system: bool) -> FileColumns:
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: dict[int, list[str]] = {}
    malformed: dict[int, str] = {}
    try:
        header = next(reader, [])
        selected = _select(path, header, names, has_system)
        line = reader.line_num + 1
        for fields in reader:
            _check_count(len(rows) + len(malformed))
            if len(fields) == len(header):
                rows[line] = fields
            else:
                malformed[line] = f"the line has {len(fields)} fields; expected {len(header)}"
            line = reader.line_num + 1  # quoted text may contain line breaks
    except csv.Error as error:
        raise ValueError(f"line {reader.line_num}: {error}") from None
    columns = {
        name: [row[at] for row in rows.values()]
        for name, column in selected.items()
        for at in [header.index(column)]
    }
    return FileColumns(columns, list(rows), malformed)


def _read_record(path: Path, names: Sequence[str], has_system: bool) -> FileColumns:
    """Read a run's record: every finished row, and of other rollouts the last row.

    The types are those of a rollout's row; a row object for each line would take ten times as long.
    """
    from robomme_interference_data.evaluate.run.row import rows_that_count, whole_lines

    data = whole_lines(path)
    if not data:
        return FileColumns({}, [])
    _check_count(data.count(b"\n"))
    columns = _columns(path, _parse_record(path, data, record_schema({*names, *KEY_COLUMNS})))
    keys = [*zip(*(columns[name] for name in KEY_COLUMNS), strict=True)]
    kept = rows_that_count(keys, columns["status"])
    return FileColumns(
        {name: [columns[name][at] for at in kept] for name in names}, [at + 1 for at in kept]
    )


def _parse_record(path: Path, data: bytes, schema: pa.Schema) -> pa.Table:
    """Parse the lines of a record; name the first damaged one, counted from 1 as editors do."""
    options = pa_json.ParseOptions(schema, unexpected_field_behavior="ignore")

    def parse(part: bytes) -> pa.Table:
        return pa_json.read_json(pa.BufferReader(part), parse_options=options)

    try:
        return parse(data)
    except pa.ArrowInvalid:
        # Its number of a row is that in a block of the file: look for the line in halves.
        lines = data.removesuffix(b"\n").split(b"\n")
        number = 1
        while len(lines) > 1:
            half = len(lines) // 2
            try:
                parse(b"\n".join(lines[:half]))
            except pa.ArrowInvalid:
                lines = lines[:half]
            else:
                number, lines = number + half, lines[half:]
        try:
            parse(lines[0])
        except pa.ArrowInvalid as error:
            reason = str(error).partition("\n")[0].partition(" in row ")[0]
            raise FormatError(
                f"{path}, line {number} (counted from 1) is no row of a rollout: {reason}",
                "Remove the line, and run the command of the run again: it repeats that rollout.",
            ) from None
        raise


def _read_vla_eval(path: Path, names: Sequence[str], has_system: bool) -> FileColumns:
    """Read the results of `vla-eval run` with the benchmark of `evaluate.vla_eval`.

    An episode's metrics are a row. One that has a reason of a failure instead is an error: it says
    nothing about the policy, though vla-eval counts it as no success.
    """
    results = parse_json(read_bytes(path, MAX_ROW_BYTES), str(path))
    rows: dict[int, list[Any]] = {}
    malformed: dict[int, str] = {}
    try:
        episodes = [episode for task in results["tasks"] for episode in task["episodes"]]
        _check_count(len(episodes))
        for line, episode in enumerate(episodes, 1):
            row = episode["metrics"]
            if episode.get("failure_reason"):
                number = nth_number(episode["episode"], episode["episode_idx"])
                if number is None:
                    malformed[line] = f"{episode['name']} has fewer episodes: see episodes_per_task"
                    continue
                row = {**episode, "episode": number, "status": Status.ERROR, "success": None}
            rows[line] = [row[name] if name in KEY_COLUMNS else row.get(name) for name in names]
            if any(isinstance(value, list | dict) for value in rows[line]):
                raise TypeError
    except (KeyError, TypeError, AttributeError, IndexError):
        raise FormatError(
            f"{path} holds no results of this benchmark in vla-eval",
            "Expected a file of `vla-eval run` or `vla-eval export`: see "
            "docs/how-to/connect-a-policy.md.",
        ) from None
    columns = {name: [row[at] for row in rows.values()] for at, name in enumerate(names)}
    return FileColumns(columns, list(rows), malformed)
