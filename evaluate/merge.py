"""Join the shards of a run: one folder, and what is missing or double in it."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import RunFolderError
from robomme_interference_data.evaluate.config import check_same_run
from robomme_interference_data.evaluate.header import planned, standing
from robomme_interference_data.evaluate.log import ERRORS_NAME, open_log, read_header, read_log
from robomme_interference_data.evaluate.rows import KEY_COLUMNS, TIMING_COLUMNS, Rollout
from robomme_interference_data.simulators.base import Status

__all__ = ["Cell", "Merged", "merge_runs"]

Cell = tuple[str, str, int]
"""Family, condition and episode of a rollout."""

_OWN = frozenset({*TIMING_COLUMNS, "attempt", "video"})
"""Columns in which two runs of the same rollout may differ."""


@dataclass(frozen=True)
class Merged:
    """What joining came to; cells are in the order of the plan.

    Attributes:
        folder: The joined run.
        rows: Its rows, errors among them.
        planned: Rollouts that the shards together were to run.
        missing: Planned rollouts without a row.
        broken: Rollouts whose row is an error.
        double: Rollouts that more than one shard finished; the first shard's row is kept.
        differing: Those of them that did not end alike.
    """

    folder: Path
    rows: tuple[Rollout, ...]
    planned: int
    missing: tuple[Cell, ...]
    broken: tuple[Cell, ...]
    double: tuple[Cell, ...]
    differing: tuple[Cell, ...]


def merge_runs(shards: Sequence[str | Path], out: str | Path) -> Merged:
    """Join runs of the same settings into one, which scores, and goes on, like any other.

    A finished row stands before an error. Videos and `errors.log` come along. The split's label
    in rows is the first run's; by its revision it is the same split in all.

    Args:
        shards: Folders of runs.
        out: Folder of the joined run, new.

    Raises:
        RunFolderError: A folder holds no run, or another one than the first; `out` is taken.
        FormatError: Files of a run are damaged.
    """
    folders = [Path(folder) for folder in shards]
    headers = [_header(folder) for folder in folders]
    for folder, header in zip(folders, headers, strict=True):
        check_same_run(folder, header["identity"], headers[0]["identity"])
    target = Path(out)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise RunFolderError(f"{target} is there already", "Give a new folder to --out.")
    found: dict[tuple[Any, ...], tuple[Rollout, Path]] = {}
    double: dict[tuple[Any, ...], bool] = {}
    label = headers[0].get("split")
    for folder in folders:
        for own in read_log(folder).values():
            row = own if label is None else replace(own, split=label)
            key = row.key
            before = found.get(key)
            if before is None or (before[0].status == Status.ERROR and row.status != Status.ERROR):
                found[key] = (row, folder)
            elif row.status != Status.ERROR:
                double[key] = double.get(key, False) or _outcome(row) != _outcome(before[0])
    plans = _whole_plans(headers)
    items = planned(plans, headers[0]["identity"]["episode_split"])
    asked = [(item.episode.family, item.condition, item.episode.index) for item in items]
    rank = {cell: number for number, cell in enumerate(asked)}
    keys = sorted(found, key=lambda key: (rank.get(_cell(key), len(rank)), _cell(key)))
    rows = tuple(found[key][0] for key in keys)
    broken = tuple(_cell(row.key) for row in rows if row.status == Status.ERROR)
    missing = tuple(cell for cell in asked if cell not in {_cell(key) for key in keys})
    with open_log(target, headers[0]["identity"], resume=False) as log:
        log.header |= {name: headers[0][name] for name in headers[0] if name not in log.header}
        log.header["plans"] = plans
        log.replace(rows)
        for key in keys:
            _bring_video(found[key][0], found[key][1], target)
        _bring_errors(folders, target)
        log.write_tables({key: number for number, key in enumerate(keys)})
        log.write_header(
            **standing(log.header, rows),
            stopped=None,
            invocations=[one for header in headers for one in header.get("invocations", [])],
            command=[line for header in headers for line in header.get("command", [])],
            merged=[folder.name for folder in folders],
        )
    return Merged(
        target,
        rows,
        len(asked),
        missing,
        broken,
        tuple(_cell(key) for key in keys if key in double),
        tuple(_cell(key) for key in keys if double.get(key)),
    )


def _header(folder: Path) -> dict[str, Any]:
    try:
        return read_header(folder)
    except FileNotFoundError:
        raise RunFolderError(
            f"{folder} holds no run", "Give folders that robomme-interference evaluate wrote."
        ) from None


def _whole_plans(headers: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the plans of which the shards are parts, each once."""
    plans: list[dict[str, Any]] = []
    for plan in (plan for header in headers for plan in header["plans"]):
        whole = {**plan, "shard": "1/1"}
        if whole not in plans:
            plans.append(whole)
    return plans


def _cell(key: tuple[Any, ...]) -> Cell:
    named = dict(zip(KEY_COLUMNS, key, strict=True))
    return named["family"], named["condition"], named["episode"]


def _outcome(row: Rollout) -> dict[str, Any]:
    return {name: value for name, value in row.as_dict().items() if name not in _OWN}


def _bring_video(row: Rollout, folder: Path, out: Path) -> None:
    if row.video is None or not (folder / row.video).exists():
        return
    (out / row.video).parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(folder / row.video, out / row.video)


def _bring_errors(folders: Sequence[Path], out: Path) -> None:
    texts = [
        (folder / ERRORS_NAME).read_text(encoding="utf-8")
        for folder in folders
        if (folder / ERRORS_NAME).exists()
    ]
    if texts:
        (out / ERRORS_NAME).write_text("".join(texts), encoding="utf-8")
