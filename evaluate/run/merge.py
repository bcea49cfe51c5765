"""Merge the shards of a run into one folder, and report what is missing or duplicated."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import RunError
from robomme_interference_data.evaluate.probe.result import joined_probe
from robomme_interference_data.schema.rollouts import TIMING_COLUMNS
from robomme_interference_data.storage.files import LocalFiles

from .log import ERRORS_LOG, check_same_run, open_log, read_run
from .plan import WorkItem
from .record import RunHeader
from .row import Rollout, is_done


@dataclass(frozen=True)
class Merged:
    """The result of merging; all in canonical order.

    Attributes:
        rows: Rows of the merged run, with errors.
        planned: Number of rollouts that the shards together plan.
        missing: Planned rollouts without a row.
        broken: Rollouts whose row is an error.
        duplicates: Rollouts that more than one shard finished; the first shard's row is kept.
        conflicts: Duplicates with different results.
    """

    folder: Path
    rows: tuple[Rollout, ...]
    planned: int
    missing: tuple[WorkItem, ...]
    broken: tuple[WorkItem, ...]
    duplicates: tuple[WorkItem, ...]
    conflicts: tuple[WorkItem, ...]


def merge_runs(shards: Sequence[str | Path], out: str | Path) -> Merged:
    """Merge runs of the same settings into one, which can be scored and resumed like any other.

    A finished row takes precedence over an error. Videos and `errors.log` are copied. Rows get the
    buffer set's label of the first run; its revision is the same in all runs.

    Raises:
        RunError: A folder holds no run, or another one than the first; `out` is not empty.
        FormatError: Files of a run are damaged, or are links that lead out of its folder.
    """
    folders, target = [Path(folder) for folder in shards], Path(out)
    runs = [read_run(folder) for folder in folders]
    first = runs[0][0]
    for folder, (header, _) in zip(folders, runs, strict=True):
        check_same_run(folder, header.identity, first.identity)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise RunError(f"{target} already exists", "Give a new folder.")
    merged: dict[WorkItem, tuple[Rollout, Path]] = {}
    conflicts: dict[WorkItem, bool] = {}  # of each duplicate
    for folder, (_, rows) in zip(folders, runs, strict=True):
        for item, stored in rows.items():
            row = replace(stored, buffer_set=first.buffer_set)
            earlier = merged[item][0] if item in merged else None
            # An error gives way to a finished row; of two finished ones the first stays.
            if earlier is None or (is_done(row) and not is_done(earlier)):
                merged[item] = row, folder
            elif is_done(row):
                conflicts[item] = conflicts.get(item, False) or _result(row) != _result(earlier)
    joined = _joined_header(
        [(folder.name, header) for folder, (header, _) in zip(folders, runs, strict=True)]
    )
    videos = [(folder, row.video) for row, folder in merged.values() if row.video]
    # `path` refuses links that lead out of the folder.
    copied = {name: LocalFiles(at).path(name) for at, name in videos if (at / name).exists()}
    logs = [LocalFiles(at).path(ERRORS_LOG) for at in folders if (at / ERRORS_LOG).exists()]
    with open_log(target, first.identity, first.buffer_set) as log:
        log.write_all(row for row, _ in merged.values())
        for name, path in copied.items():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target / name)
        if logs:
            (target / ERRORS_LOG).write_bytes(b"".join(path.read_bytes() for path in logs))
        log.end(joined)
    items = joined.items
    return Merged(
        target,
        tuple(log.rows.values()),
        len(items),
        missing=tuple(item for item in items if item not in merged),
        broken=tuple(item for item in sorted(merged) if not is_done(merged[item][0])),
        duplicates=tuple(sorted(conflicts)),
        conflicts=tuple(sorted(item for item, differs in conflicts.items() if differs)),
    )


def _joined_header(shards: Sequence[tuple[str, RunHeader]]) -> RunHeader:
    """Return the header of the merged run, given the names and headers of its shards."""
    headers = [header for _, header in shards]
    # The merged run is not sharded: it lacks, and can run, what was not given to merge.
    plans = [replace(plan, shard="1/1") for header in headers for plan in header.plans]
    return replace(
        headers[0],
        plans=tuple(plan for place, plan in enumerate(plans) if plan not in plans[:place]),
        invocations=tuple(start for header in headers for start in header.invocations),
        merged=tuple(name for name, _ in shards),
        probe=joined_probe([(name, header.probe) for name, header in shards]),
    )


def _result(row: Rollout) -> Rollout:
    """Return a row without what may differ between two runs of the same rollout."""
    untimed: dict[str, Any] = dict.fromkeys(TIMING_COLUMNS)
    return replace(row, attempt=1, repeated_because=None, video=None, **untimed)
