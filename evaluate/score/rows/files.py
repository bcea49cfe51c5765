"""Find files of rollout rows and read them as plain values; `reading` judges the values."""

import codecs
import csv
import io
import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.json as pa_json

from robomme_interference_data.constants import RUN_HEADER, RUN_RECORD, RUN_TABLES
from robomme_interference_data.errors import FormatError, InvalidOptionError, MissingFileError
from robomme_interference_data.evaluate.run.log import MOST_BYTES, RunHeader, whole_lines
from robomme_interference_data.schema.codec import arrow_schema
from robomme_interference_data.schema.rollouts import KEY_COLUMNS, Rollout, Status
from robomme_interference_data.storage.files import read_bytes, read_header
from robomme_interference_data.storage.parquet import open_parquet, read_table, reading

_SCHEMA = arrow_schema(Rollout)
_REQUIRED = ("family", "condition", "episode", "status", "success")
_RUN_ONLY = {"buffer_set", "revision", "split", "shift", "model_seed", "protocol_version"}
"""Key columns of a run's rows. The released layout is without them, and without `simulator`,
which exported rows of other simulators have as one column more."""
_MOST_ROWS = 1 << 20
"""Rows of a file, at most: the paper's grid has 25,200."""

_ALIASES = {"variant": "system"}  # its name in the paper's released tables


class Part(NamedTuple):
    """The rows of one file.

    Attributes:
        columns: Column of `Rollout` to its value in each row.
        lines: The line on which each row begins; in parquet its number from 1.
        malformed: Line to why it is no row.
    """

    columns: Mapping[str, Sequence[Any]]
    lines: Sequence[int]
    malformed: Mapping[int, str] = {}


def find_sources(paths: Sequence[Path]) -> dict[Path, RunHeader | None]:
    """Find the file of rows that each path stands for: of a run's folder it is the record.

    Returns:
        File to what `run.json` says about its run, None for a file outside a run's folder.
    """
    found: dict[Path, RunHeader | None] = {}
    for given in paths:
        path = given / RUN_RECORD if given.is_dir() else given
        if not path.is_file():
            raise MissingFileError(
                f"there is no file {path}",
                "Give folders of runs, or .csv, .parquet or .jsonl files.",
            )
        if any(path.samefile(other) for other in found):
            raise InvalidOptionError(f"{path} is given twice", "Give each file once.")
        run = path.parent / RUN_HEADER
        of_run = path.name in (RUN_RECORD, *RUN_TABLES) and run.is_file()
        found[path] = read_header(run, RunHeader) if of_run else None
    return found


def system_of(path: Path) -> str | None:
    """Return the system in the name of an exported file (see `export`), or None."""
    found = re.fullmatch(r"(.+)-[^-]+_rollouts\.csv", path.name)
    return found[1] if found else None


def read_file(path: Path, names: Sequence[str], has_system: bool) -> Part:
    """Read columns of a file's rows, as far as the file has them.

    It has to name systems itself unless the system of its rows is known (`has_system`).
    """
    readers = {".parquet": _read_parquet, ".csv": _read_csv, ".jsonl": _read_record}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise FormatError(f"{path} is no {' or '.join(readers)} file", "Give a file of rows.")
    with reading(path):
        return reader(path, names, has_system)


def _match(
    path: Path, existing: Sequence[str], names: Sequence[str], has_system: bool
) -> dict[str, str]:
    """Return which of the wanted columns is which of the file's."""
    ours = {_ALIASES.get(name, name): name for name in existing}
    for name in existing:
        known = [*_SCHEMA.names, *_ALIASES]
        near = [] if name in known else get_close_matches(name, known, n=1, cutoff=0.8)
        if near:
            raise FormatError(f"{path} has the column {name!r}", f"Did you mean {near[0]!r}?")
        if existing.count(name) > 1:
            raise FormatError(f"{path} has two columns {name!r}", "Rename one of them.")
    of_run = "simulator" in ours and not _RUN_ONLY.isdisjoint(ours)
    required = dict.fromkeys((*KEY_COLUMNS, *_REQUIRED) if of_run else _REQUIRED)
    if missing := [name for name in required if name not in ours]:
        raise FormatError(
            f"{path} lacks the columns {', '.join(missing)}; it has "
            f"{', '.join(existing) or 'none'}",
            "Expected the rows of a run, or of the released CSVs (docs/score.md).",
        )
    if "system" not in ours and not has_system:
        raise FormatError(
            f"{path} names no system: it has no column 'system', nor is it called "
            "SYSTEM-SIMULATOR_rollouts.csv",
            'Name it, such as system="retrieval-framesamp-modul" '
            "(of two files that are compared: system_a, system_b).",
        )
    return {name: ours[name] for name in names if name in ours}


def _bound(rows: int) -> None:
    if rows > _MOST_ROWS:
        raise ValueError(f"more than {_MOST_ROWS:,} rows; expected at most so many")


def _columns(path: Path, table: pa.Table) -> dict[str, list[Any]]:
    for column in table.columns:
        kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
        if pa.types.is_nested(kind):
            raise FormatError.damaged(path, f"a column holds {kind}; expected text and numbers")
    return {name: table[name].to_pylist() for name in table.column_names}


def _read_parquet(path: Path, names: Sequence[str], has_system: bool) -> Part:
    with open_parquet(path) as file:
        _bound(file.metadata.num_rows)
        chosen = _match(path, file.schema_arrow.names, names, has_system)
        table = read_table(file, path, list(chosen.values()))
    columns = _columns(path, table)
    found = {name: columns[existing] for name, existing in chosen.items()}
    return Part(found, range(1, len(table) + 1))


def _read_csv(path: Path, names: Sequence[str], has_system: bool) -> Part:
    text = read_bytes(path, MOST_BYTES).removeprefix(codecs.BOM_UTF8).decode()
    csv.field_size_limit(len(text) + 1)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: dict[int, list[str]] = {}
    malformed: dict[int, str] = {}
    try:
        header = next(reader, [])
        chosen = _match(path, header, names, has_system)
        line = reader.line_num + 1
        for fields in reader:
            _bound(len(rows) + len(malformed))
            if len(fields) == len(header):
                rows[line] = fields
            else:
                malformed[line] = f"the line has {len(fields)} fields; expected {len(header)}"
            line = reader.line_num + 1  # quoted text may hold line breaks
    except csv.Error as error:
        raise ValueError(f"line {reader.line_num}: {error}") from None
    places = {name: header.index(existing) for name, existing in chosen.items()}
    columns = {name: [row[place] for row in rows.values()] for name, place in places.items()}
    return Part(columns, list(rows), malformed)


def _read_record(path: Path, names: Sequence[str], has_system: bool) -> Part:
    """Read the record of a run: every finished row, and of other rollouts the last row."""
    if not (whole := whole_lines(path)):
        return Part({}, [])
    _bound(whole.count(b"\n"))
    schema = pa.schema([_SCHEMA.field(name) for name in dict.fromkeys((*names, *KEY_COLUMNS))])
    options = pa_json.ParseOptions(schema, unexpected_field_behavior="ignore")
    table = pa_json.read_json(pa.BufferReader(whole), parse_options=options)
    columns = _columns(path, table)
    keys = [*zip(*(columns[name] for name in KEY_COLUMNS), strict=True)]
    last = dict(zip(keys, range(len(keys)), strict=True))
    counts = [
        place
        for place, (key, status) in enumerate(zip(keys, columns["status"], strict=True))
        if status != Status.ERROR or last[key] == place
    ]
    found = {name: [columns[name][place] for place in counts] for name in names}
    return Part(found, [place + 1 for place in counts])
