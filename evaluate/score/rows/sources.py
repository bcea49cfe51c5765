"""Find files of rollout rows and read their columns, whatever wrote them; nothing is judged here.

Columns come as codes and distinct values: where pandas is installed, pyarrow would import it,
which takes seconds, to make arrays of its own or to give them away as numpy's.
"""

import codecs
import csv
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.json as pa_json
from numpy.typing import NDArray

from robomme_interference_data.constants import RUN_HEADER, RUN_RECORD, RUN_TABLES
from robomme_interference_data.errors import FormatError, InvalidOptionError, MissingFileError
from robomme_interference_data.evaluate.run.log import (
    MOST_BYTES,
    RunHeader,
    rows_that_count,
    whole_lines,
)
from robomme_interference_data.schema.codec import arrow_schema, read_header
from robomme_interference_data.schema.rollouts import KEY_COLUMNS, Rollout, Status
from robomme_interference_data.storage.files import read_bytes
from robomme_interference_data.storage.parquet import open_parquet, read_table, reading

Codes = NDArray[np.int64]

_SCHEMA = arrow_schema(Rollout)
_NEEDED = ("family", "condition", "episode", "status", "success")
_RUN_ONLY = {"split", "revision", "episode_split", "shift", "model_seed", "protocol_version"}
"""Key columns of a run's rows. The released layout is without them, and without `simulator`,
which exported rows of other simulators have as one column more."""
_ALIASES = {"variant": "system"}  # its name in the paper's released tables

_READ = {*KEY_COLUMNS, *_NEEDED, "seed", "difficulty", "steps", "video"}
_READ |= {"evidence_kept", "chance", "retrieval_model"}
COLUMNS = tuple(n for n in _SCHEMA.names if n in _READ - {"split"} or n.endswith("_fraction"))
"""What scoring reads of a file, as far as it is there."""


@dataclass(frozen=True)
class Part:
    """The N rows of one file.

    Attributes:
        path: The file.
        columns: Of each of `COLUMNS` that is there: the place of each row's value among the
            distinct ones, `(N,) int64`, and these, None for an empty cell.
        count: How many rows.
        line: From the number of a row, from 0, to the line on which it begins; in parquet to its
            number from 1.
        malformed: Line and reason of what is no row.
    """

    path: Path
    columns: Mapping[str, tuple[Codes, Sequence[Any]]]
    count: int
    line: Callable[[int], int]
    malformed: Sequence[tuple[int, str]] = ()


def find_sources(paths: Sequence[Path]) -> dict[Path, RunHeader | None]:
    """Find the file of rows that each path stands for: of a run's folder it is the record.

    Returns:
        File to what `run.json` says about its run, None for a file that is of no run's folder.

    Raises:
        MissingFileError: There is no such file, or a folder holds no record.
        FormatError: A run's header is damaged, or of another format version.
        InvalidOptionError: A file is given twice.
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
    """Return the system that the name of an exported file tells (see `export`), or None."""
    found = re.fullmatch(r"(.+)-[^-]+_rollouts\.csv", path.name)
    return found[1] if found else None


def read_part(path: Path, with_system: bool) -> Part:
    """Read the columns of a file that scoring asks for, as far as they are there.

    Args:
        path: The file: `.jsonl`, `.parquet` or `.csv`.
        with_system: Whether a name is at hand for rows that name no system.

    Raises:
        FormatError: The file cannot be read, lacks columns, or has one that reads like another,
            two of one name, or one of nested values.
    """
    readers = {".parquet": _read_parquet, ".csv": _read_csv, ".jsonl": _read_record}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise FormatError(f"{path} is no {' or '.join(readers)} file", "Give a file of rows.")
    with reading(path):
        return reader(path, with_system)


def _match(path: Path, names: Sequence[str], with_system: bool) -> dict[str, str]:
    """Return which of our columns is which of the file's."""
    ours = {_ALIASES.get(name, name): name for name in names}
    for name in names:
        known = [*_SCHEMA.names, *_ALIASES]
        near = [] if name in known else get_close_matches(name, known, n=1, cutoff=0.8)
        if near:
            raise FormatError(f"{path} has the column {name!r}", f"Did you mean {near[0]!r}?")
        if names.count(name) > 1:
            raise FormatError(f"{path} has two columns {name!r}", "Rename one of them.")
    ran = "simulator" in ours and not _RUN_ONLY.isdisjoint(ours)
    needed = dict.fromkeys((*KEY_COLUMNS, *_NEEDED) if ran else _NEEDED)
    if missing := [name for name in needed if name not in ours]:
        raise FormatError(
            f"{path} lacks the columns {', '.join(missing)}; it has {', '.join(names) or 'none'}",
            "Expected the rows of a run, or of the released CSVs (docs/score.md).",
        )
    if "system" not in ours and not with_system:
        raise FormatError(
            f"{path} names no system: it has no column 'system', nor is it called "
            "SYSTEM-SIMULATOR_rollouts.csv",
            "Say which it is, such as --system retrieval-framesamp-modul (compare: --system-a, "
            "--system-b).",
        )
    return {name: ours[name] for name in COLUMNS if name in ours}


def _encoded(path: Path, column: Any) -> tuple[Codes, Sequence[Any]]:
    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    if pa.types.is_nested(kind):
        raise FormatError.damaged(path, f"a column holds {kind}; expected text and numbers")
    kind = pa.string() if pa.types.is_null(kind) else kind
    coded = column.cast(kind).combine_chunks().dictionary_encode("encode")
    return np.from_dlpack(coded.indices).astype(np.int64), coded.dictionary.to_pylist()


def _read_parquet(path: Path, with_system: bool) -> Part:
    with open_parquet(path) as file:
        chosen = _match(path, file.schema_arrow.names, with_system)
        table = read_table(file, path, list(chosen.values()))
    columns = {name: _encoded(path, table[there]) for name, there in chosen.items()}
    return Part(path, columns, len(table), lambda row: row + 1)


def _read_csv(path: Path, with_system: bool) -> Part:
    data = read_bytes(path, MOST_BYTES).removeprefix(codecs.BOM_UTF8)
    # Decoded here: of a byte that is no text pyarrow would show a traceback of its own.
    text = data.decode()
    csv.field_size_limit(len(data) + 1)
    names = next(csv.reader(io.StringIO(text, newline="")), [])
    chosen = _match(path, names, with_system)
    ragged: dict[int, str] = {}  # by number of the record; the header is 1

    def note(row: Any) -> str:
        told = f"the line has {row.actual_columns} fields; expected {row.expected_columns}"
        ragged[row.number] = told
        return "skip"

    table = pa_csv.read_csv(
        pa.BufferReader(data),
        read_options=pa_csv.ReadOptions(use_threads=False),  # else it tells no numbers
        parse_options=pa_csv.ParseOptions(
            ignore_empty_lines=False, newlines_in_values=True, invalid_row_handler=note
        ),
        # All as text: what a number should be is judged row by row.
        convert_options=pa_csv.ConvertOptions(
            column_types=dict.fromkeys(chosen.values(), pa.string()),
            include_columns=list(chosen.values()),
            strings_can_be_null=True,
            null_values=[""],
        ),
    )

    @cache
    def lines() -> list[int]:  # on which records begin: quoted text may hold line breaks
        reader = csv.reader(io.StringIO(text, newline=""))
        return [1, *(reader.line_num + 1 for _ in reader)]

    @cache
    def kept() -> list[int]:
        return [line for record, line in enumerate(lines(), 1) if record not in ragged][1:]

    columns = {name: _encoded(path, table[there]) for name, there in chosen.items()}
    malformed = [(lines()[record - 1], told) for record, told in ragged.items()]
    return Part(path, columns, len(table), lambda row: kept()[row], malformed)


def _read_record(path: Path, with_system: bool) -> Part:
    """Read the record of a run: of each rollout the row that counts, see `log`."""
    whole = whole_lines(path)
    if not whole:
        return Part(path, {}, 0, int)
    schema = pa.schema([_SCHEMA.field(name) for name in (*COLUMNS, "split")])
    options = pa_json.ParseOptions(schema, unexpected_field_behavior="ignore")
    table = pa_json.read_json(pa.BufferReader(whole), parse_options=options)
    codes = {name: _encoded(path, table[name]) for name in schema.names}
    sizes = [max(1, len(codes[name][1])) for name in KEY_COLUMNS]
    key = np.ravel_multi_index([codes[name][0] for name in KEY_COLUMNS], sizes)
    status, names = codes["status"]
    broke = status == (names.index(Status.ERROR) if Status.ERROR in names else -1)
    rows = rows_that_count(key, broke)
    columns = {name: (codes[name][0][rows], codes[name][1]) for name in COLUMNS}
    return Part(path, columns, len(rows), lambda row: int(rows[row]) + 1)
