"""Find files of rollout rows and read their columns, whatever wrote them; nothing is judged here.

Columns come as codes and distinct values: where pandas is installed, pyarrow would import it,
which takes seconds, to make arrays of its own or to give them away as numpy's.
"""

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robomme_interference_data.constants import (
    FORMAT_VERSION,
    RUN_HEADER,
    RUN_RECORD,
    RUN_TABLES,
)
from robomme_interference_data.errors import FormatError, InvalidOptionError, MissingFileError
from robomme_interference_data.files import read_json
from robomme_interference_data.parquet import open_parquet, reading
from robomme_interference_data.records import KEY_COLUMNS, Rollout, Status
from robomme_interference_data.rows import arrow_schema

__all__ = ["COLUMNS", "Codes", "Part", "find_sources", "read_part"]

Codes = NDArray[np.int64]

_KNOWN = arrow_schema(Rollout).names
_NEEDED = ("family", "condition", "episode", "status", "success")
_RUN_ONLY = {"split", "revision", "episode_split", "model_seed", "protocol_version"}
"""Key columns of a run's rows. The released layout is without them, and without `simulator`,
which exported rows of other simulators have as one column more."""
_ALIASES = {"variant": "system"}  # its name in the paper's released tables

_READ = {*KEY_COLUMNS, *_NEEDED, "seed", "difficulty", "steps", "video", "retrieval_model"}
COLUMNS = tuple(n for n in _KNOWN if n in _READ - {"split"} or n.endswith("_fraction"))
"""What scoring reads of a file, as far as it is there."""


@dataclass(frozen=True)
class Part:
    """The N rows of one file.

    Attributes:
        path: The file.
        columns: Of each of `COLUMNS` that is there: the place of each row's value among the
            distinct ones, `(N,) int64`, and these, None for an empty cell.
        lines: Where each row begins; in parquet its number, from 1.
        malformed: Number from 0, and reason, of what is no row.
    """

    path: Path
    columns: Mapping[str, tuple[Codes, Sequence[Any]]]
    lines: Sequence[int]
    malformed: Mapping[int, str] = field(default_factory=dict)


def find_sources(paths: Sequence[Path]) -> dict[Path, Mapping[str, Any] | None]:
    """Find the file of rows that each path stands for: of a run's folder it is the record.

    Returns:
        File to what `run.json` says about its run, None for a file that is of no run's folder.

    Raises:
        MissingFileError: There is no such file, or a folder holds no record.
        FormatError: A run has another format version.
        InvalidOptionError: A file is given twice.
    """
    found: dict[Path, Mapping[str, Any] | None] = {}
    for given in paths:
        path = given / RUN_RECORD if given.is_dir() else given
        if not path.is_file():
            raise MissingFileError(
                f"there is no file {path}",
                "Give folders of runs, or .csv, .parquet or .jsonl files.",
            )
        if any(path.samefile(other) for other in found):
            raise InvalidOptionError(f"{path} is given twice", "Give each file once.")
        run, found[path] = path.parent / RUN_HEADER, None
        if path.name in (RUN_RECORD, *RUN_TABLES) and run.is_file():
            header = found[path] = read_json(run)
            if header.get("format_version") != FORMAT_VERSION:
                raise FormatError.version(run, header.get("format_version"), FORMAT_VERSION)
    return found


def read_part(path: Path, with_system: bool) -> Part:
    """Read the columns of a file that scoring asks for, as far as they are there.

    Args:
        path: The file: `.jsonl`, `.parquet` or `.csv`.
        with_system: Whether a name is at hand for rows that name no system.

    Raises:
        FormatError: The file cannot be read, lacks columns, or has one that reads like another,
            two of one name, or one of nested values.
    """
    suffix = path.suffix.lower()
    with reading(path):
        if suffix == ".parquet":
            return _read_parquet(path, with_system)
        if suffix == ".csv":
            return _read_lines(path, _csv_rows(path), with_system)
        if suffix == ".jsonl":
            return _read_lines(path, _record_rows(path), with_system)
    raise FormatError(f"{path} is no .csv, .parquet or .jsonl file", "Give a file of rows.")


def _match(path: Path, names: Sequence[str], with_system: bool) -> dict[str, str]:
    """Return which of our columns is which of the file's."""
    ours = {_ALIASES.get(name, name): name for name in names}
    for name in names:
        known = [*_KNOWN, *_ALIASES]
        near = [] if name in known else get_close_matches(name, known, n=1, cutoff=0.8)
        if near:
            raise FormatError(f"{path} has the column {name!r}", f"Did you mean {near[0]!r}?")
        if names.count(name) > 1:
            raise FormatError(f"{path} has two columns {name!r}", "Rename one of them.")
    ran = "simulator" in ours and not _RUN_ONLY.isdisjoint(ours)
    needed = dict.fromkeys((*KEY_COLUMNS, *_NEEDED) if ran else _NEEDED)
    if missing := [name for name in needed if name not in ours]:
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


def _read_parquet(path: Path, with_system: bool) -> Part:
    columns = {}
    with open_parquet(path) as file:
        for name, there in _match(path, file.schema_arrow.names, with_system).items():
            column = file.read(columns=[there])[there]
            kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
            if pa.types.is_nested(kind):
                raise FormatError.damaged(path, f"the column {there!r} holds {kind}, no values")
            kind = pa.string() if pa.types.is_null(kind) else kind
            array = column.cast(kind).combine_chunks().dictionary_encode("encode")
            codes = np.from_dlpack(array.indices).astype(np.int64)
            columns[name] = codes, array.dictionary.to_pylist()
        return Part(path, columns, range(1, file.metadata.num_rows + 1))


def _read_lines(path: Path, rows: Iterator[tuple[int, Sequence[Any]]], with_system: bool) -> Part:
    """Encode rows that come with the lines on which they begin; the first one names the columns."""
    names = [str(name) for name in next(rows, (0, []))[1]]
    chosen = {names.index(there): n for n, there in _match(path, names, with_system).items()}
    codes: dict[int, list[int]] = {at: [] for at in chosen}
    values: dict[int, dict[Any, int]] = {at: {} for at in chosen}
    lines: list[int] = []
    malformed: dict[int, str] = {}
    for line, found in rows:
        row = found
        if len(row) != len(names):
            reason = f"the line has {len(row)} fields; expected {len(names)}"
            malformed[len(lines)] = reason if row else "the line holds no row"
            row = [None] * len(names)
        lines.append(line)
        for at, known in values.items():
            codes[at].append(known.setdefault(row[at] or None, len(known)))
    columns = {n: (np.array(codes[at], np.int64), list(values[at])) for at, n in chosen.items()}
    return Part(path, columns, lines, malformed)


def _csv_rows(path: Path) -> Iterator[tuple[int, Sequence[Any]]]:
    reader = csv.reader(io.StringIO(path.read_bytes().decode("utf-8-sig"), newline=""))
    line = 1
    try:
        for row in reader:
            yield line, row
            line = reader.line_num + 1  # quoted text may hold line breaks
    except csv.Error as error:
        raise FormatError.damaged(path, f"line {line}: {error}") from None


def _record_rows(path: Path) -> Iterator[tuple[int, Sequence[Any]]]:
    """Yield the rows of a run's record, as text: of one that broke and ran again, the last."""
    names = (*COLUMNS, "split")
    rows: list[tuple[int, Sequence[Any]]] = []
    broken: dict[tuple[Any, ...], int] = {}
    lines = path.read_bytes().split(b"\n")
    for line, data in enumerate(lines, 1):
        try:
            value = json.loads(data)
        except (ValueError, RecursionError):
            value = None
        if isinstance(value, dict):
            row = {name: _text(value.get(name)) for name in names}
            key = tuple(row[name] for name in KEY_COLUMNS)
            if key in broken:
                rows[broken.pop(key)] = (0, ())
            if row["status"] == Status.ERROR:
                broken[key] = len(rows)
            rows.append((line, tuple(row.values())))
        elif line < len(lines):  # a crash can leave a part of the last one
            rows.append((line, ()))
    yield 0, names
    yield from (row for row in rows if row[0])


def _text(value: Any) -> str | None:
    return value if value is None or isinstance(value, str) else str(value).lower()
