"""Open files of rollout rows and stream them, whatever wrote them; nothing is judged here."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import pyarrow as pa
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
from robomme_interference_data.evaluate.score.batches import (
    Batch,
    csv_batches,
    csv_schema,
    parquet_batches,
)
from robomme_interference_data.files import read_json
from robomme_interference_data.parquet import reading

__all__ = [
    "COLUMNS",
    "RELEASED_COLUMNS",
    "RELEASED_SIMULATOR",
    "Source",
    "find_sources",
    "read_batches",
]

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

RELEASED_SIMULATOR = "robomme"
"""The simulator of rows that name none."""

_UNRELEASED = {"split", "revision", "episode_split", "model_seed", "protocol_version"}
"""Columns that only rows of a run have. The released layout is without them, and without
`simulator`, which exported rows of other simulators have as one column more."""

_NEEDED = ("family", "condition", "episode", "status", "success")
_NUMBERS = ("episode", "model_seed", "protocol_version", "seed", "steps")
_ALIASES = {"variant": "system"}  # its name in the paper's released tables


@dataclass(frozen=True)
class Source:
    """One file of rows.

    Attributes:
        path: The file, `.parquet` or `.csv`.
        folder: The folder of its run; None for a file that was given by itself.
        record: What `run.json` says about the run; empty without.
        columns: Name that scoring uses to name in the file.
    """

    path: Path
    folder: Path | None
    record: Mapping[str, Any]
    columns: Mapping[str, str]


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
    schema = _schema(path)
    columns = _match(path, schema.names, with_system)
    if path.suffix.lower() == ".parquet":  # a CSV's cells are all text
        _check_types(path, schema, columns)
    return Source(path, folder, record, columns)


def _record(path: Path) -> dict[str, Any]:
    record = read_json(path)
    version = record.get("format_version", LOG_VERSION)
    if version != LOG_VERSION:
        raise FormatError(
            f"{path} has format version {version!r}; this package reads {LOG_VERSION}",
            "Install the version of robomme-interference-data that wrote it.",
        )
    return record


def _schema(path: Path) -> Any:
    if path.suffix.lower() == ".parquet":
        with reading(path):
            return pq.read_schema(path)
    if path.suffix.lower() != ".csv":
        raise FormatError(
            f"{path} is neither .csv nor .parquet", "Rows are read from CSV and parquet files."
        )
    with reading(path):
        return csv_schema(path)


def _match(path: Path, names: list[str], with_system: bool) -> dict[str, str]:
    """Return which column of the file is which of ours."""
    ours = {_ALIASES.get(name, name): name for name in names}
    known = [*ROLLOUT_SCHEMA.names, *_ALIASES]
    for name in names:
        near = [] if name in known else get_close_matches(name, known, n=1, cutoff=0.8)
        if len(set(names)) < len(names) or near:
            what = f"the column {name!r}" if near else "two columns of one name"
            hint = f"Did you mean {near[0]!r}?" if near else "Rename one of them."
            raise FormatError(f"{path} has {what}", hint)
    ran = "simulator" in ours and not _UNRELEASED.isdisjoint(ours)
    needed = (*KEY_COLUMNS, *_NEEDED) if ran else _NEEDED
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


def _check_types(path: Path, schema: Any, columns: Mapping[str, str]) -> None:
    """Refuse columns of a parquet file that hold neither text nor what they should."""
    for name, there in columns.items():
        kind = schema.field(there).type
        kind = kind.value_type if pa.types.is_dictionary(kind) else kind
        sound = kind in (pa.string(), pa.large_string(), pa.null())
        expected = "text"
        if name in (*_NUMBERS, "success"):
            sound |= pa.types.is_integer(kind) or kind in (pa.float32(), pa.float64())
            expected = "numbers"
        if name == "success":
            sound |= pa.types.is_boolean(kind)
            expected = "true and false"
        if not sound:
            raise FormatError(
                f"{path}: the column {there!r} holds {kind}; expected {expected}",
                "Write the file again with plain values in that column.",
            )


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
            yield from parquet_batches(source.path, chosen)
        else:
            yield from csv_batches(source.path, chosen)


def _chosen(source: Source, columns: Sequence[str]) -> dict[str, str]:
    present = set(_schema(source.path).names)
    named = {name: source.columns.get(name, name) for name in columns}
    return {name: there for name, there in named.items() if there in present}
