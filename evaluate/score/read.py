"""Open files of rollout rows and stream them, whatever wrote them; nothing is judged here."""

import codecs
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from robomme_interference_data.errors import FormatError, InvalidOptionError, MissingFileError
from robomme_interference_data.evaluate.log import (
    CSV_NAME,
    LOG_NAME,
    LOG_VERSION,
    PARQUET_NAME,
    RUN_NAME,
    check_tables,
)
from robomme_interference_data.evaluate.rows import KEY_COLUMNS, ROLLOUT_SCHEMA
from robomme_interference_data.files import read_json
from robomme_interference_data.parquet import reading

__all__ = ["COLUMNS", "RELEASED_COLUMNS", "Batch", "Source", "find_sources", "read_batches"]

RELEASED_COLUMNS = (
    "family",
    "condition",
    "episode",
    "seed",
    "difficulty",
    "status",
    "success",
    "steps",
    "retrieval_model",
    "retrieval_selected_lesson_fraction",
    "retrieval_selected_filler_fraction",
    "retrieval_selected_query_fraction",
)
"""The columns of the released retrieval rows, in their order. They name no system."""

COLUMNS = (
    *KEY_COLUMNS,
    *("seed", "difficulty", "status", "success", "steps", "video"),
)
"""What scoring reads of a file, as far as it is there."""

_NEEDED = ("family", "condition", "episode", "status", "success")
_ALIASES = {"variant": "system"}  # its name in the paper's released tables
_BLOCK = 16 * 2**20  # bytes of CSV at a time
_LOOKED_AT = 2**16  # bytes of CSV, to tell whether it is text
_BATCH = 2**18  # rows of parquet at a time


@dataclass(frozen=True)
class Source:
    """One file of rows.

    Attributes:
        path: The file, `.parquet` or `.csv`.
        folder: The folder of its run; None for a file that was given by itself.
        record: What `run.json` says about the run; empty without.
        columns: Name that scoring uses to name in the file.
        released: Whether the file has the layout of the released CSVs: no simulator, split,
            revision or model seed. Such rows are RoboMME's.
    """

    path: Path
    folder: Path | None
    record: Mapping[str, Any]
    columns: Mapping[str, str]
    released: bool


@dataclass
class Batch:
    """Consecutive rows of one file.

    Attributes:
        columns: Name to values, dictionary-encoded text or plain numbers, all equally long.
        rows: How many rows.
        first: Line of the first row if all lines before are rows; 1 is the header of a CSV, or
            the first row of a parquet file.
        malformed: Line and reason of the lines found since the last batch that are no rows.
        skipped: All such lines so far, in order.
    """

    columns: dict[str, Any]
    rows: int
    first: int
    malformed: Sequence[tuple[int, str]] = ()
    skipped: Sequence[tuple[int, str]] = ()

    def line(self, row: int) -> int:
        """Return the line on which a row stands; the row of a parquet file, from 1."""
        line = self.first + row
        for skipped, _ in self.skipped:
            line += skipped <= line
        return line


def find_sources(paths: Sequence[Path], with_system: bool = False) -> list[Source]:
    """Find the file of rows that each path stands for, and check its columns.

    Args:
        paths: Folders of runs (`rollouts.parquet`, else `rollouts.csv`) or files.
        with_system: Whether a name is at hand for rows that name no system.

    Raises:
        MissingFileError: There is no such file, or a folder holds no rows.
        FormatError: A file cannot be read, or lacks columns.
        InvalidOptionError: A file is given twice.
    """
    sources = [_source(path, with_system) for path in paths]
    files = [source.path.resolve() for source in sources]
    for place, source in enumerate(sources):
        if files[place] in files[:place]:
            raise InvalidOptionError(f"{source.path} is given twice", "Give each file once.")
    return sources


def _source(path: Path, with_system: bool) -> Source:
    folder, record = None, {}
    if path.is_dir():
        folder = path
        found = [path / name for name in (PARQUET_NAME, CSV_NAME) if (path / name).is_file()]
        if not found:
            begun = (folder / LOG_NAME).exists()
            raise MissingFileError(
                f"{path} holds neither {PARQUET_NAME} nor {CSV_NAME}",
                "The run has not ended: go on with it, with the same robomme-interference evaluate "
                "command."
                if begun
                else "Give the folder of a run, or a file of rows.",
            )
        path = found[0]
        check_tables(folder)
    elif not path.is_file():
        raise MissingFileError(f"there is no file or folder {path}", "Check the path.")
    if (path.parent / RUN_NAME).is_file() and path.name in (PARQUET_NAME, CSV_NAME):
        folder, record = path.parent, _record(path.parent / RUN_NAME)
    names = _column_names(path)
    released = "simulator" not in names
    return Source(path, folder, record, _match(path, names, released, with_system), released)


def _record(path: Path) -> dict[str, Any]:
    record = read_json(path)
    version = record.get("format_version", LOG_VERSION)
    if version != LOG_VERSION:
        raise FormatError(
            f"{path} has format version {version!r}; this package reads {LOG_VERSION}",
            "Install the version of robomme-interference-data that wrote it.",
        )
    return record


def _column_names(path: Path) -> list[str]:
    if path.suffix.lower() == ".parquet":
        with reading(path):
            return list(pq.read_schema(path).names)
    if path.suffix.lower() != ".csv":
        raise FormatError(
            f"{path} is neither .csv nor .parquet", "Rows are read from CSV and parquet files."
        )
    with reading(path), _open_csv(path, None, []) as reader:
        return list(reader.schema.names)


def _match(path: Path, names: list[str], released: bool, with_system: bool) -> dict[str, str]:
    """Return which column of the file is which of ours."""
    ours = {_ALIASES.get(name, name): name for name in names}
    known = [*ROLLOUT_SCHEMA.names, *_ALIASES]
    for name in names:
        near = [] if name in known else get_close_matches(name, known, n=1, cutoff=0.8)
        if len(set(names)) < len(names) or near:
            what = f"the column {name!r}" if near else "two columns of one name"
            hint = f"Did you mean {near[0]!r}?" if near else "Rename one of them."
            raise FormatError(f"{path} has {what}", hint)
    needed = _NEEDED if released else (*KEY_COLUMNS, *_NEEDED)
    missing = [name for name in dict.fromkeys(needed) if name not in ours]
    if missing:
        raise FormatError(
            f"{path} lacks the columns {', '.join(missing)}; it has {', '.join(names)}",
            "Expected the rows of a run (docs/score.md), or of the released CSVs.",
        )
    if "system" not in ours and not with_system:
        raise FormatError(
            f"{path} names no system: it has no column 'system'",
            "Say which it is, such as --system retrieval-framesamp-modul (compare: --system-a, "
            "--system-b).",
        )
    return {name: ours[name] for name in COLUMNS if name in ours}


def read_batches(source: Source, columns: Sequence[str] | None = None) -> Iterator[Batch]:
    """Stream a file's rows in batches of bounded size, under the names that scoring uses.

    Args:
        source: The file.
        columns: Which columns to read, by our names; None for those of `Source.columns`. Those
            that the file lacks are left out.

    Raises:
        FormatError: The file is damaged.
    """
    chosen = source.columns if columns is None else _chosen(source, columns)
    with reading(source.path):
        if source.path.suffix.lower() == ".parquet":
            yield from _parquet_batches(source.path, chosen)
        else:
            yield from _csv_batches(source.path, chosen)


def _chosen(source: Source, columns: Sequence[str]) -> dict[str, str]:
    present = set(_column_names(source.path))
    named = {name: source.columns.get(name, name) for name in columns}
    return {name: there for name, there in named.items() if there in present}


def _parquet_batches(path: Path, columns: Mapping[str, str]) -> Iterator[Batch]:
    schema = pq.read_schema(path)
    texts = [name for name in columns.values() if pa.types.is_string(schema.field(name).type)]
    first = 1
    with pq.ParquetFile(path, read_dictionary=texts) as file:
        for batch in file.iter_batches(_BATCH, columns=list(columns.values())):
            found = {name: batch.column(there) for name, there in columns.items()}
            yield Batch(found, len(batch), first)
            first += len(batch)


def _csv_batches(path: Path, columns: Mapping[str, str]) -> Iterator[Batch]:
    skipped: list[tuple[int, str]] = []
    first, seen = 2, 0
    with _open_csv(path, list(columns.values()), skipped) as reader:
        for batch in reader:
            found = {name: batch.column(there) for name, there in columns.items()}
            # pyarrow reads ahead: some of them may stand after these rows.
            yield Batch(found, len(batch), first, skipped[seen:], skipped)
            first += len(batch)
            seen = len(skipped)
    if skipped[seen:]:
        yield Batch({}, 0, first, skipped[seen:], skipped)


def _check_text(path: Path) -> None:
    """Refuse what is no text at all: pyarrow would show a traceback of its own for it."""
    with path.open("rb") as file:
        start = file.read(_LOOKED_AT)
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError as error:
        raise FormatError(
            f"{path} cannot be read: byte {error.start} is not UTF-8 text",
            "Expected a CSV or parquet file of rollout rows (docs/score.md).",
        ) from None


def _open_csv(path: Path, columns: list[str] | None, skipped: list[tuple[int, str]]) -> Any:
    def note(row: Any) -> str:
        expected, actual = row.expected_columns, row.actual_columns
        skipped.append((row.number, f"the line has {actual} fields; expected {expected}"))
        return "skip"

    # Everything is text at first: what a number should be is judged row by row. Threads would
    # not say on which line a broken one stands.
    text = pa.dictionary(pa.int32(), pa.string())
    _check_text(path)
    return pa_csv.open_csv(
        path,
        read_options=pa_csv.ReadOptions(use_threads=False, block_size=_BLOCK),
        parse_options=pa_csv.ParseOptions(ignore_empty_lines=False, invalid_row_handler=note),
        convert_options=pa_csv.ConvertOptions(
            column_types=dict.fromkeys(columns or [], text),
            include_columns=columns or [],
            strings_can_be_null=True,
            quoted_strings_can_be_null=True,
            null_values=[""],
        ),
    )
