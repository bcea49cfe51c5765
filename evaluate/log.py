"""The folder of a run: rows appended as rollouts end, and the tables that others read.

`rollouts.jsonl` is the record: one line a rollout, on the disk before the next one is counted. A
line that a crash cut short is dropped, and only that one. `rollouts.parquet` and `rollouts.csv`
are made from it, whole or not at all; `run.json` says what ran. Where the record is missing, the
table in `rollouts.parquet` stands for it.
"""

import csv
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from robomme_interference_data.errors import FormatError, RunFolderError
from robomme_interference_data.evaluate.config import check_same_run
from robomme_interference_data.evaluate.rows import ROLLOUT_SCHEMA, Rollout
from robomme_interference_data.files import atomic_path, canonical_json, read_json, write_json
from robomme_interference_data.locks import hold
from robomme_interference_data.simulators.base import Status

__all__ = [
    "CSV_NAME",
    "ERRORS_NAME",
    "LOG_NAME",
    "LOG_VERSION",
    "PARQUET_NAME",
    "RUN_NAME",
    "RunLog",
    "check_tables",
    "open_log",
    "read_header",
    "read_log",
    "summary",
]

LOG_NAME = "rollouts.jsonl"
PARQUET_NAME = "rollouts.parquet"
CSV_NAME = "rollouts.csv"
RUN_NAME = "run.json"
ERRORS_NAME = "errors.log"

LOG_VERSION = 1
"""Version of these files; a reader refuses one that it does not know."""

_PLAN = frozenset({"families", "episodes", "conditions", "shard"})
_ANOTHER = "It was changed or damaged. Give another --out; rollouts.csv still has the rows."


class RunLog:
    """The rows of a run; made by `open_log`.

    Attributes:
        folder: The run's folder.
        header: What `run.json` holds.
        rows: The last row of each key.
    """

    def __init__(self, folder: Path, header: dict[str, Any], rows: dict[tuple[Any, ...], Rollout]):
        self.folder = folder
        self.header = header
        self.rows = rows

    @property
    def finished(self) -> set[tuple[Any, ...]]:
        """Keys of the rollouts that need not be run again: all but errors."""
        return {key for key, row in self.rows.items() if row.status != Status.ERROR}

    def append(self, row: Rollout, traceback: str | None = None) -> None:
        """Write a row; when this returns, it is on the disk.

        Raises:
            FormatError: There is a finished row of this key already.
            OSError: The file cannot be written; it is named.
        """
        before = self.rows.get(row.key)
        if before is not None and before.status != Status.ERROR:
            raise FormatError(f"{self.folder} has a row of {row.key} already")
        line = (canonical_json(row.as_dict()) + "\n").encode()
        path = self.folder / LOG_NAME
        try:
            with path.open("ab") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:  # from writing, it names no file
            raise OSError(error.errno, error.strerror, str(path)) from error
        self.rows[row.key] = row
        if traceback:
            with (self.folder / ERRORS_NAME).open("a", encoding="utf-8") as file:
                file.write(f"{row.finished_at} {row.family}/{row.episode_split}/{row.episode} ")
                file.write(f"{row.condition}, attempt {row.attempt}\n{traceback.rstrip()}\n\n")

    def reread(self) -> None:
        """Take the rows as they are on the disk."""
        self.rows = read_log(self.folder)

    def replace(self, rows: Iterable[Rollout]) -> None:
        """Write all rows anew, whole or not at all."""
        self.rows = {row.key: row for row in rows}
        with atomic_path(self.folder / LOG_NAME) as partial:
            lines = [canonical_json(row.as_dict()) + "\n" for row in self.rows.values()]
            partial.write_text("".join(lines), encoding="utf-8")

    def write_tables(self, order: Mapping[tuple[Any, ...], int]) -> None:
        """Write `rollouts.parquet` and `rollouts.csv`.

        Args:
            order: Place of each planned key; rows of earlier plans come after, in their order.
        """
        place = {key: number for number, key in enumerate(self.rows)}
        last = len(order)
        keys = sorted(self.rows, key=lambda key: (order.get(key, last), place[key]))
        rows = [self.rows[key].as_dict() for key in keys]
        table = pa.Table.from_pylist(rows, schema=ROLLOUT_SCHEMA)
        with atomic_path(self.folder / PARQUET_NAME) as partial:
            pq.write_table(table, partial, compression="zstd")
        with (
            atomic_path(self.folder / CSV_NAME) as partial,
            partial.open("w", newline="", encoding="utf-8") as file,
        ):
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(ROLLOUT_SCHEMA.names)
            writer.writerows([_text(value) for value in row.values()] for row in rows)

    def write_header(self, **changes: Any) -> None:
        """Change `run.json`."""
        self.header |= changes
        write_json(self.folder / RUN_NAME, self.header)


@contextmanager
def open_log(folder: Path, identity: Mapping[str, Any], resume: bool = True) -> Iterator[RunLog]:
    """Open or make the folder of a run, and hold it.

    Args:
        folder: The folder.
        identity: What makes the run the one that it is.
        resume: Whether a run that is there may be gone on with.

    Raises:
        RunFolderError: The folder holds another run or something else, is being written by
            another process, or may not be resumed.
        FormatError: Its files are damaged or of another format version.
    """
    folder.mkdir(parents=True, exist_ok=True)
    busy = RunFolderError(
        f"another process is writing {folder}", "Wait for it to end, or give another --out."
    )
    strangers = sorted(p.name for p in folder.iterdir() if not p.name.startswith("."))
    if strangers and RUN_NAME not in strangers:
        raise RunFolderError(
            f"{folder} holds other files ({', '.join(strangers[:3])}) and no {RUN_NAME}",
            "Give a new folder to --out.",
        )
    with hold(folder / ".lock", busy):
        path = folder / RUN_NAME
        if not path.exists():
            header: dict[str, Any] = {
                "format_version": LOG_VERSION,
                "identity": dict(identity),
                "plans": [],
            }
            log = RunLog(folder, header, {})
            log.write_header()
        else:
            if not resume:
                raise RunFolderError(
                    f"{folder} holds a run already", "Give another --out, or leave out --no-resume."
                )
            header = read_header(folder)
            check_same_run(folder, header["identity"], identity)
            _drop_torn_line(folder / LOG_NAME)
            log = RunLog(folder, header, read_log(folder))
            if log.rows and not (folder / LOG_NAME).exists():
                log.replace(log.rows.values())
        yield log


def read_log(folder: Path) -> dict[tuple[Any, ...], Rollout]:
    """Read a run's record: the last row of each key, in the order in which keys first came.

    A last line without an end, which a crash can leave, is not read. Without a record the rows
    are those of `rollouts.parquet`.

    Raises:
        FormatError: A line is damaged, has unknown columns, or a finished rollout has two rows; or
            the record is missing, and cannot be had from the table.
    """
    path = folder / LOG_NAME
    rows: dict[tuple[Any, ...], Rollout] = {}
    if not path.exists():
        return _read_table(folder)
    lines = path.read_bytes().split(b"\n")[:-1]
    for number, line in enumerate(lines, 1):
        try:
            row = Rollout(**json.loads(line))
        except (ValueError, TypeError) as error:
            raise FormatError(
                f"{path}, line {number} is not a row of a rollout: {error}",
                "Remove the line to run that rollout again.",
            ) from None
        if row.key in rows and rows[row.key].status != Status.ERROR:
            raise FormatError(f"{path}, line {number}: a second row of {row.key}")
        rows[row.key] = row
    return rows


def _read_table(folder: Path) -> dict[tuple[Any, ...], Rollout]:
    """Read the rows of a folder that has lost its record; none where there is no table either."""
    tables = [name for name in (PARQUET_NAME, CSV_NAME) if (folder / name).exists()]
    if not tables:
        return {}
    try:
        rows = _table_rows(folder)
    except (OSError, ValueError) as error:
        raise FormatError(
            f"{folder} has {' and '.join(tables)}, but no {LOG_NAME}, and its rows cannot be had "
            f"from {PARQUET_NAME}: {error}",
            f"Bring {LOG_NAME} back, or give another --out.",
        ) from None
    keyed = {row.key: row for row in rows}
    if len(keyed) < len(rows):
        raise FormatError(
            f"{folder / PARQUET_NAME} has several rows of one rollout, and {LOG_NAME} is missing",
            f"Bring {LOG_NAME} back, or give another --out.",
        )
    return keyed


def _table_rows(folder: Path) -> list[Rollout]:
    found = pq.read_table(folder / PARQUET_NAME)
    if not found.schema.equals(ROLLOUT_SCHEMA):
        raise ValueError("its columns are not those of rollouts")
    return [Rollout(**row) for row in found.to_pylist()]


def check_tables(folder: Path) -> None:
    """Check that a run's tables hold what its record does; if it was killed, they may not.

    Raises:
        FormatError: They are behind; or the record is damaged.
    """
    if not (folder / LOG_NAME).exists():
        return
    try:
        there = {row.key: row for row in _table_rows(folder)}
    except (OSError, ValueError):
        return  # to be told by whoever reads it
    record = read_log(folder)
    if there != record:
        newer = sum(there.get(key) != row for key, row in record.items())
        raise FormatError(
            f"{newer} of {len(record)} rollouts in {folder / LOG_NAME} are not in the tables "
            "beside it: the run was killed, or still goes on",
            f"Make a folder with all of them: robomme-interference merge {folder} --out "
            f"{folder}-merged",
        )


def read_header(folder: Path) -> dict[str, Any]:
    """Read `run.json`.

    Raises:
        FileNotFoundError: There is none.
        FormatError: It is damaged, or of another format version.
    """
    path = folder / RUN_NAME
    header = read_json(path)
    version = header.get("format_version")
    if version != LOG_VERSION:
        raise FormatError(
            f"{path} has format version {version!r}; this package reads {LOG_VERSION}",
            "Install the version of robomme-interference-data that wrote it.",
        )
    if not isinstance(header.get("identity"), dict):
        raise FormatError(f"{path} lacks the identity of the run", _ANOTHER)
    plans = header.get("plans")
    if not isinstance(plans, list) or not all(
        isinstance(plan, dict) and plan.keys() >= _PLAN for plan in plans
    ):
        raise FormatError(f"{path} lacks the plans of the run, or a part of one", _ANOTHER)
    return header


def _drop_torn_line(path: Path) -> None:
    if not path.exists():
        return
    with path.open("r+b") as file:
        data = file.read()
        whole = data.rfind(b"\n") + 1
        if whole < len(data):
            file.truncate(whole)
            os.fsync(file.fileno())


def _text(value: Any) -> str:
    """Write a value as CSV has it: nothing for None, true and false, numbers in full."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return str(value)


def summary(rows: Iterable[Rollout]) -> dict[str, int]:
    """Count rows by status."""
    counts = {str(status): 0 for status in (Status.SUCCESS, Status.FAIL, Status.TIMEOUT)}
    counts[str(Status.ERROR)] = 0
    for row in rows:
        counts[row.status] += 1
    return counts
