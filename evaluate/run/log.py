"""The folder of a run: `rollouts.jsonl` with a line for each rollout, and `run.json`.

A line is on disk before the next rollout is counted; only a last line that a crash cut short is
dropped. Of a rollout that broke and ran again, the last row counts; a finished rollout never runs
again. The tables beside it are exported when a run ends.
"""

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from robomme_interference_data.constants import FORMAT_VERSION, RUN_HEADER, RUN_RECORD, RUN_TABLES
from robomme_interference_data.errors import RunError, named, visible
from robomme_interference_data.evaluate.probe.result import Probe
from robomme_interference_data.schema.codec import arrow_schema, to_dict, to_table
from robomme_interference_data.schema.rollouts import FINAL, Status
from robomme_interference_data.storage.csv_text import quoted_table
from robomme_interference_data.storage.files import atomic_path, write_json
from robomme_interference_data.storage.parquet import writing
from robomme_interference_data.storage.staging import file_lock
from robomme_interference_data.storage.text import read_header

from .plan import WorkItem
from .record import Invocation, RunHeader, whole_lines
from .row import Rollout, is_done, read_record, row_line

ERRORS_LOG = "errors.log"


def with_counts(header: RunHeader, rows: Mapping[WorkItem, Rollout], status: str = "") -> RunHeader:
    """Return a header with status and counts for these rows, over all of its plans."""
    items = header.items
    whole = all(item in rows and is_done(rows[item]) for item in items)
    status = status or ("complete" if whole else "incomplete")
    counts = count_statuses(rows.values())
    return replace(header, status=status, planned=len(items), counts=counts)


class RunLog:
    """A run's folder that is open for writing, see `open_log`; `rows` are updated at its end."""

    def __init__(self, folder: Path, header: RunHeader, rows: dict[WorkItem, Rollout]):
        self.folder, self.header, self.rows = folder, header, rows

    def begin(self, start: Invocation, probe: Probe | None = None) -> None:
        """Record an invocation, and what its probe found, if it was probed."""
        plans = self.header.plans
        plans += () if start.plan in plans else (start.plan,)
        header = replace(
            self.header,
            plans=plans,
            invocations=(*self.header.invocations, start),
            probe=probe or self.header.probe,
        )
        self._write_header(with_counts(header, self.rows, "running"))

    def append(self, row: Rollout, trace: str | None = None) -> None:
        """Write a row to the disk, and the traceback of an error."""
        path = self.folder / RUN_RECORD
        try:
            with path.open("ab") as file:
                file.write(row_line(row))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:  # it names no file
            raise OSError(error.errno, error.strerror, str(path)) from error
        if trace:
            log = self.folder / ERRORS_LOG
            with log.open("a", encoding="utf-8", errors="backslashreplace") as file:
                file.write(f"{row.finished_at} {WorkItem.of(row)}, attempt {row.attempt}\n")
                file.write(f"{visible(trace.rstrip())}\n\n")

    def write_all(self, rows: Iterable[Rollout]) -> None:
        """Replace all rows atomically."""
        with atomic_path(self.folder / RUN_RECORD) as partial:
            partial.write_bytes(b"".join(map(row_line, rows)))

    def end(self, header: RunHeader) -> None:
        """Export the tables, in canonical order, and write a header with status and counts."""
        # Read from the disk: Ctrl-C may come between the writing and the counting of a row.
        self.rows = dict(sorted(read_record(self.folder).items()))
        table = to_table(self.rows.values(), arrow_schema(Rollout))
        parquet, text = (self.folder / name for name in RUN_TABLES)
        with writing(parquet) as file:
            pq.write_table(table, file, compression="zstd")
        with writing(text) as file:
            pa_csv.write_csv(quoted_table(table), file)
        self._write_header(with_counts(header, self.rows))

    def _write_header(self, header: RunHeader) -> None:
        write_json(self.folder / RUN_HEADER, to_dict(header))
        self.header = header


@contextmanager
def open_log(
    folder: Path, identity: Mapping[str, Any], buffer_set: str, *, resume: bool = True
) -> Iterator[RunLog]:
    """Open or create the folder of a run, and lock it; an existing run keeps its label.

    A new run has no header before it begins: if its probe finds a leak, another run may follow.
    """
    folder.mkdir(parents=True, exist_ok=True)
    existing = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    if existing == [RUN_RECORD] and not (folder / RUN_RECORD).stat().st_size:
        existing = []  # left by a full disk, or a kill, before the header
    if existing and RUN_HEADER not in existing:
        raise RunError(
            f"{folder} holds other files ({', '.join(existing[:3])}) and no {RUN_HEADER}",
            f"Set {named('out')} to a new folder.",
        )
    busy = RunError(
        f"another process is writing {folder}",
        f"Wait for it to end, or set another {named('out')}.",
    )
    with file_lock(folder / ".lock", busy):
        if not existing:
            (folder / RUN_RECORD).touch()
            yield RunLog(folder, RunHeader(FORMAT_VERSION, dict(identity), buffer_set), {})
            return
        if not resume:
            raise RunError(
                f"{folder} holds a run already",
                f"Set another {named('out')}, or leave out {named('no_resume')}.",
            )
        header, rows = read_run(folder)
        check_same_run(folder, header.identity, identity)
        # Or the next row would continue a line that a crash cut short.
        os.truncate(folder / RUN_RECORD, len(whole_lines(folder / RUN_RECORD)))
        yield RunLog(folder, header, rows)


def read_run(folder: Path) -> tuple[RunHeader, dict[WorkItem, Rollout]]:
    """Read the header of a run, with status and counts for its rows, and the rows."""
    for name in (RUN_HEADER, RUN_RECORD):
        if not (folder / name).is_file():
            raise RunError(
                f"{folder} holds no run: {name} is missing", "Give a complete folder of a run."
            )
    header, rows = read_header(folder / RUN_HEADER, RunHeader), read_record(folder)
    return with_counts(header, rows), rows


def unfinished(folder: Path, items: Iterable[WorkItem]) -> list[WorkItem]:
    """Return the work items without a finished row in a folder, which may hold no run.

    It is read without the lock, which `open_log` takes only once servers have identified the run.
    So this decides what to start, and the rows that `open_log` reads what to run.
    """
    rows = read_record(folder)
    return [item for item in items if item not in rows or not is_done(rows[item])]


def check_same_run(folder: Path, existing: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Check that a folder holds the expected run, by their identities."""
    old, new = _flat(existing), _flat(expected)
    differences = [
        f"{name} is {old.get(name, 'unknown')} there, {new.get(name, 'unknown')} here"
        for name in sorted({*old, *new})
        if old.get(name) != new.get(name)
    ]
    if differences:
        raise RunError(
            f"{folder} holds another run: {'; '.join(differences)}",
            f"Set another {named('out')}, or the settings of the existing run (see {RUN_HEADER}).",
        )


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return values as text, under names such as `policy_metadata.sha256`."""
    flat: dict[str, str] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = repr(value)
    return flat


def count_statuses(rows: Iterable[Rollout]) -> dict[str, int]:
    """Count rows by status."""
    counts = Counter(row.status for row in rows)
    return {
        str(status): counts[status]
        for status in FINAL
        if counts[status] or status is not Status.MEASURED  # of offline runs alone
    }
