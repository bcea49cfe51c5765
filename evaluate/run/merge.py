"""Join the shards of a run: one folder, and what is missing or duplicated in it."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from robomme_interference_data.errors import RunFolderError
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.rollouts import TIMING_COLUMNS, Rollout
from robomme_interference_data.storage.files import LocalFiles

from .log import ERRORS_LOG, check_same_run, is_done, open_log, read_run
from .plan import WorkItem

_OWN = frozenset({*TIMING_COLUMNS, "attempt", "video"})
"""Columns in which two runs of the same rollout may differ."""


@dataclass(frozen=True)
class Merged:
    """What joining came to; all in canonical order.

    Attributes:
        rows: Rows of the joined run, errors among them.
        planned: Rollouts that the shards together were to run.
        missing: Planned rollouts without a row.
        broken: Rollouts whose row is an error.
        duplicates: Rollouts that more than one shard finished; the first shard's row is kept.
        conflicts: Those of them that did not end alike.
    """

    folder: Path
    rows: tuple[Rollout, ...]
    planned: int
    missing: tuple[WorkItem, ...]
    broken: tuple[WorkItem, ...]
    duplicates: tuple[WorkItem, ...]
    conflicts: tuple[WorkItem, ...]


def merge_runs(shards: Sequence[str | Path], out: str | Path) -> Merged:
    """Join runs of the same settings into one, which scores, and goes on, like any other.

    A finished row stands before an error. Videos and `errors.log` come along. The buffer set's label
    in rows is the first run's; by its revision it is the same buffer set in all.

    Raises:
        RunFolderError: A folder holds no run, or another one than the first; `out` is taken.
        FormatError: Files of a run are damaged, or links that lead out of its folder.
    """
    folders, target = [Path(folder) for folder in shards], Path(out)
    runs = [read_run(folder) for folder in folders]
    first = runs[0][0]
    for folder, (header, _) in zip(folders, runs, strict=True):
        check_same_run(folder, header.identity, first.identity)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise RunFolderError(f"{target} is there already", "Give a new folder.")
    found: dict[WorkItem, tuple[Rollout, Path]] = {}
    duplicates: dict[WorkItem, bool] = {}
    for folder, (_, rows) in zip(folders, runs, strict=True):
        for item, own in rows.items():
            row = replace(own, buffer_set=first.buffer_set)
            before = found.get(item)
            if before is None or (is_done(row) and not is_done(before[0])):
                found[item] = row, folder
            elif is_done(row):
                duplicates[item] = duplicates.get(item, False) or _outcome(row) != _outcome(
                    before[0]
                )
    headers = [header for header, _ in runs]
    plans = [replace(plan, shard="1/1") for header in headers for plan in header.plans]
    joined = replace(
        first,
        plans=tuple(plan for place, plan in enumerate(plans) if plan not in plans[:place]),
        starts=tuple(start for header in headers for start in header.starts),
        merged=tuple(folder.name for folder in folders),
    )
    videos = [(folder, row.video) for row, folder in found.values() if row.video]
    # Nothing that a link stands for comes along.
    taken = {name: LocalFiles(at).path(name) for at, name in videos if (at / name).exists()}
    logs = [LocalFiles(at).path(ERRORS_LOG) for at in folders if (at / ERRORS_LOG).exists()]
    with open_log(target, first.identity, first.buffer_set) as log:
        log.write_all(row for row, _ in found.values())
        for name, path in taken.items():
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
        tuple(item for item in items if item not in found),
        tuple(item for item in sorted(found) if not is_done(found[item][0])),
        tuple(sorted(duplicates)),
        tuple(sorted(item for item, differs in duplicates.items() if differs)),
    )


def _outcome(row: Rollout) -> dict[str, object]:
    return {name: value for name, value in to_dict(row).items() if name not in _OWN}
