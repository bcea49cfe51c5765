"""Find files of rollout rows and read their columns, whatever wrote them; nothing is judged here.

Columns come as codes and distinct values: pyarrow would import pandas, where that is installed,
to make arrays of its own or to give them away, which takes seconds.
"""

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robomme_interference_data.constants import (
    FORMAT_VERSION,
    RUN_HEADER,
    RUN_RECORD,
    RUN_TABLES,
)
from robomme_interference_data.errors import FormatError, InvalidOptionError, MissingFileError
from robomme_interference_data.files import read_json
from robomme_interference_data.parquet import reading
from robomme_interference_data.records import KEY_COLUMNS, Rollout, Status
from robomme_interference_data.rows import arrow_schema

__all__ = ["COLUMNS", "Codes", "Part", "Source", "find_sources", "read_part"]

Codes = NDArray[np.int64]

_SCHEMA = arrow_schema(Rollout)
_NEEDED = ("family", "condition", "episode", "status", "success")
_RUN_ONLY = {"split", "revision", "episode_split", "model_seed", "protocol_version"}
"""Key columns of a run's rows. The released layout is without them, and without `simulator`,
which exported rows of other simulators have as one column more."""
_FRACTIONS = tuple(name for name in _SCHEMA.names if name.endswith("_fraction"))
COLUMNS = tuple(
    name
    for name in _SCHEMA.names
    if name in {*KEY_COLUMNS, *_NEEDED, "seed", "difficulty", "steps", "video"} - {"split"}
    or name in {"retrieval_model", *_FRACTIONS}
)
"""What scoring reads of a file, as far as it is there."""

_ALIASES = {"variant": "system"}  # its name in the paper's released tables


@dataclass(frozen=True)
class Source:
    """One file of rows.

    Attributes:
        path: The file: `.jsonl`, `.parquet` or `.csv`.
        folder: The folder of its run; None for a file that was given by itself.
        header: What `run.json` says about the run; empty without.
    """

    path: Path
    folder: Path | None
    header: Mapping[str, Any]

    def place(self, line: int) -> str:
        """Return a place in the file in words."""
        return f"{self.path}, {'row' if self.path.suffix.lower() == '.parquet' else 'line'} {line}"


@dataclass(frozen=True)
class Part:
    """The rows of one file.

    Attributes:
        columns: Of each column that is read and is there, under our name: the place of each row's
            value among the distinct ones, `(N,) int64`, and these, None for an empty cell.
        count: How many rows.
        line: From the number of a row, from 0, to its line; in parquet to its row, from 1.
        malformed: Line and reason of what is no row.
    """

    columns: Mapping[str, tuple[Codes, Sequence[Any]]]
    count: int
    line: Callable[[int], int]
    malformed: Sequence[tuple[int, str]] = ()


def find_sources(paths: Sequence[Path]) -> list[Source]:
    """Find the file of rows that each path stands for: of a run's folder it is the record.

    Raises:
        MissingFileError: There is no such file, or a folder holds no record.
        FormatError: A run has another format version.
        InvalidOptionError: A file is given twice.
    """
    sources = [_source(path) for path in paths]
    files = [source.path.resolve() for source in sources]
    for place, source in enumerate(sources):
        if files[place] in files[:place]:
            raise InvalidOptionError(f"{source.path} is given twice", "Give each file once.")
    return sources


def _source(path: Path) -> Source:
    if path.is_dir():
        path = path / RUN_RECORD
        if not path.is_file():
            raise MissingFileError(
                f"{path.parent} holds no {RUN_RECORD}", "Give the folder of a run, or a file."
            )
    elif not path.is_file():
        raise MissingFileError(f"there is no file or folder {path}", "Check the path.")
    run = path.parent / RUN_HEADER
    if path.name not in (RUN_RECORD, *RUN_TABLES) or not run.is_file():
        return Source(path, path.parent if path.name == RUN_RECORD else None, {})
    header = read_json(run)
    if header.get("format_version") != FORMAT_VERSION:
        raise FormatError.version(run, header.get("format_version"), FORMAT_VERSION)
    return Source(path, path.parent, header)


def read_part(source: Source, with_system: bool) -> Part:
    """Read the columns of a file that scoring asks for, as far as they are there.

    Args:
        source: The file.
        with_system: Whether a name is at hand for rows that name no system.

    Raises:
        FormatError: The file cannot be read, lacks columns, has one that reads like another or
            two of one name, or one of a type that does not fit.
    """
    readers = {".jsonl": _read_record, ".parquet": _read_parquet, ".csv": _read_csv}
    reader = readers.get(source.path.suffix.lower())
    if reader is None:
        raise FormatError(
            f"{source.path} is no {' or '.join(readers)} file",
            "Give the folder of a run, or a file of rows.",
        )
    with reading(source.path):
        return reader(source.path, with_system)


def _match(path: Path, names: Sequence[str], with_system: bool) -> dict[str, str]:
    """Return which of our columns is which of the file's."""
    ours = {_ALIASES.get(name, name): name for name in names}
    known = [*_SCHEMA.names, *_ALIASES]
    for name in names:
        near = [] if name in known else get_close_matches(name, known, n=1, cutoff=0.8)
        if near:
            raise FormatError(f"{path} has the column {name!r}", f"Did you mean {near[0]!r}?")
        if names.count(name) > 1:
            raise FormatError(f"{path} has two columns {name!r}", "Rename one of them.")
    ran = "simulator" in ours and not _RUN_ONLY.isdisjoint(ours)
    needed = (*KEY_COLUMNS, *_NEEDED) if ran else _NEEDED
    missing = [name for name in dict.fromkeys(needed) if name not in ours]
    if missing:
        raise FormatError(
            f"{path} lacks the columns {', '.join(missing)}; it has {', '.join(names)}",
            "Expected the rows of a run, or of the released CSVs (docs/score.md).",
        )
    if "system" not in ours and not with_system:
        raise FormatError(
            f"{path} names no system: it has no column 'system'",
            "Say which it is, such as --system retrieval-framesamp-modul (compare: --system-a, "
            "--system-b).",
        )
    return {name: ours[name] for name in COLUMNS if name in ours}


# --- parquet -----------------------------------------------------------------------------------


def _read_parquet(path: Path, with_system: bool) -> Part:
    with pq.ParquetFile(path) as file:
        chosen = _match(path, file.schema_arrow.names, with_system)
        for name, there in chosen.items():
            _check_type(path, name, file.schema_arrow.field(there))
        table = file.read(columns=list(chosen.values()))
    columns = {name: _encoded(table[there]) for name, there in chosen.items()}
    return Part(columns, len(table), lambda row: row + 1)


def _check_type(path: Path, name: str, found: Any) -> None:
    """Refuse a column that holds neither text nor what it should."""
    kind, wanted = found.type, _SCHEMA.field(name).type
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    sound = kind in (pa.string(), pa.large_string(), pa.null())
    expected = "text"
    if not pa.types.is_string(wanted):
        sound |= pa.types.is_integer(kind) or kind in (pa.float32(), pa.float64())
        expected = "numbers"
    if pa.types.is_boolean(wanted):
        sound |= pa.types.is_boolean(kind)
        expected = "true and false"
    if not sound:
        raise FormatError(
            f"{path}: the column {found.name!r} holds {kind}; expected {expected}",
            "Write the file again with plain values in that column.",
        )


def _encoded(column: Any) -> tuple[Codes, list[Any]]:
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if pa.types.is_null(column.type):
        return np.zeros(len(column), np.int64), [None]
    array = column.combine_chunks().dictionary_encode("encode")
    return np.from_dlpack(array.indices).astype(np.int64), array.dictionary.to_pylist()


# --- CSV ---------------------------------------------------------------------------------------


def _read_csv(path: Path, with_system: bool) -> Part:
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # From a line with too few fields, pyarrow would show a traceback of its own.
        raise FormatError.damaged(path, f"byte {error.start} is not UTF-8 text") from None
    names = next(csv.reader(io.StringIO(text, newline="")), [])
    chosen = _match(path, names, with_system) if names else {}
    skipped: dict[int, str] = {}  # number of a record, the header is 1

    def note(row: Any) -> str:
        skipped[row.number] = (
            f"the line has {row.actual_columns} fields; expected {row.expected_columns}"
        )
        return "skip"

    table = pa_csv.read_csv(
        pa.BufferReader(data),
        read_options=pa_csv.ReadOptions(use_threads=False),  # else it says no numbers
        parse_options=pa_csv.ParseOptions(
            ignore_empty_lines=False, newlines_in_values=True, invalid_row_handler=note
        ),
        # Everything is text at first: what a number should be is judged row by row.
        convert_options=pa_csv.ConvertOptions(
            column_types=dict.fromkeys(chosen.values(), pa.string()),
            include_columns=list(chosen.values()),
            strings_can_be_null=True,
            null_values=[""],
        ),
    )

    @cache
    def lines() -> list[int]:  # of all records, from the first after the header
        return _lines(text)

    @cache
    def kept() -> list[int]:  # lines of those that are rows
        return [line for number, line in enumerate(lines(), 2) if number not in skipped]

    return Part(
        {name: _encoded(table[there]) for name, there in chosen.items()},
        len(table),
        lambda row: kept()[row],
        [(lines()[number - 2], reason) for number, reason in skipped.items()],
    )


def _lines(text: str) -> list[int]:
    """Return the line on which each record after the header begins: quoted text may hold lines."""
    ends, reader = [], csv.reader(io.StringIO(text, newline=""))
    with suppress(csv.Error):  # a cell longer than the module reads: what follows is uncertain
        ends += [reader.line_num for _ in reader]
    last = ends[-1] if ends else 1
    return [end + 1 for end in ends] + list(range(last + 2, last + text.count("\n") + 3))


# --- records of runs ---------------------------------------------------------------------------


def _read_record(path: Path, with_system: bool) -> Part:
    """Read a run's record: of a rollout that broke and was run again, the last row counts."""
    rows: list[tuple[int, dict[str, Any]]] = []
    latest: dict[tuple[Any, ...], int] = {}
    malformed = []
    lines = path.read_bytes().split(b"\n")
    for line, data in enumerate(lines, 1):
        try:
            row = json.loads(data)
        except (ValueError, RecursionError):
            row = None
        if not isinstance(row, dict):
            if line < len(lines):  # a crash can leave a part of the last one
                malformed.append((line, "the line is no row of a rollout"))
            continue
        row = {name: _plain(value) for name, value in row.items()}
        key = tuple(row.get(name) for name in KEY_COLUMNS)
        place = latest.get(key)
        if place is not None and rows[place][1].get("status") == Status.ERROR:
            rows[place] = (line, row)
        else:
            latest[key] = len(rows)
            rows.append((line, row))
    if not rows:
        return Part({}, 0, int, malformed)
    names = list(dict.fromkeys(name for _, row in rows for name in row))
    columns = {}
    for name, there in _match(path, names, with_system).items():
        places: dict[Any, int] = {}  # True is 1 to a dict
        found = [row.get(there) for _, row in rows]
        codes = [places.setdefault((type(one), one), len(places)) for one in found]
        columns[name] = np.array(codes, np.int64), [one for _, one in places]
    return Part(columns, len(rows), lambda row: rows[row][0], malformed)


def _plain(value: Any) -> Any:
    return repr(value) if isinstance(value, list | dict) else value
