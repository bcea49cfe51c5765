"""Write rows in the layout of the released CSV."""

import csv
import math
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import repeat
from pathlib import Path
from typing import Any

from robomme_interference_data.constants import SPLITS
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.score.batches import Batch
from robomme_interference_data.evaluate.score.check import field
from robomme_interference_data.evaluate.score.columns import whole_number
from robomme_interference_data.evaluate.score.read import (
    RELEASED_COLUMNS,
    RELEASED_SIMULATOR,
    read_batches,
)
from robomme_interference_data.evaluate.score.rollouts import Rollouts
from robomme_interference_data.files import atomic_path

__all__ = ["export"]

_FRACTIONS = [name for name in RELEASED_COLUMNS if name.endswith("_fraction")]


def export(rollouts: Rollouts, folder: Path, system: str | None = None) -> list[Path]:
    """Write the rows that were scored as `<system>-<simulator>_rollouts.csv`, a file each.

    The columns are those of the released retrieval rows, which name no system, split or revision;
    rows of another simulator than RoboMME have its name in one more, the last. A timeout is
    `ongoing`, as there. The rows keep the order of their files, and are the same bytes whether
    they come from CSV or parquet.

    Args:
        rollouts: Rows that were read.
        folder: Where to write.
        system: Name of the system of rows that name none.

    Returns:
        The files.

    Raises:
        InvalidOptionError: The layout cannot tell the rows apart: there are repeats with several
            model seeds, or episodes that are not `test`. Or bad rows were skipped.
    """
    _check(rollouts)
    written: dict[tuple[str, str], Path] = {}
    with ExitStack() as stack:
        writers: dict[tuple[str, str], Any] = {}
        for key, row in _rows(rollouts, system):
            simulator, name = key
            more = () if simulator == RELEASED_SIMULATOR else (simulator,)
            if key not in writers:
                written[key] = folder / f"{name}-{simulator}_rollouts.csv"
                partial = stack.enter_context(atomic_path(written[key]))
                file = stack.enter_context(partial.open("w", newline="", encoding="utf-8"))
                writers[key] = csv.writer(file)  # with CRLF, as released
                writers[key].writerow((*RELEASED_COLUMNS, *(["simulator"] if more else [])))
            writers[key].writerow((*row, *more))
    return sorted(written.values())


def _check(rollouts: Rollouts) -> None:
    if len(rollouts.model_seeds) > 1:
        raise InvalidOptionError(
            f"the rows have {len(rollouts.model_seeds)} model seeds, and the released layout has "
            "no column for them",
            "Export the run of each seed by itself.",
        )
    other = int((field(rollouts.packed, "episode_split") != SPLITS.index("test")).sum())
    if other:
        raise InvalidOptionError(
            f"{other:,} rows are of train or val episodes, and the released layout has no column "
            "for that",
            "Export rows of test episodes only.",
        )
    if rollouts.refused:
        raise InvalidOptionError(
            f"{rollouts.refused:,} rows are bad", "Mend them first: only sound rows are exported."
        )


def _rows(rollouts: Rollouts, system: str | None) -> Iterator[tuple[tuple[str, str], list[str]]]:
    for source in rollouts.sources:
        for batch in read_batches(source, ("simulator", "system", *RELEASED_COLUMNS)):
            simulators = _values(batch, "simulator", RELEASED_SIMULATOR)
            systems = _values(batch, "system", system)
            columns = [_values(batch, name, None) for name in RELEASED_COLUMNS]
            for *key, row in zip(simulators, systems, zip(*columns, strict=True), strict=False):
                yield (key[0], key[1]), _released(dict(zip(RELEASED_COLUMNS, row, strict=True)))


def _values(batch: Batch, name: str, default: Any) -> Any:
    column = batch.columns.get(name)
    return repeat(default, batch.rows) if column is None else column.to_pylist()


def _released(row: dict[str, Any]) -> list[str]:
    """Return a checked row as the released files write it, however its file did."""
    row["success"] = {"success": "1", "error": ""}.get(row["status"], "0")
    row["status"] = "ongoing" if row["status"] == "timeout" else row["status"]
    for name in ("episode", "seed", "steps"):
        row[name] = whole_number(row[name])
    for name in _FRACTIONS:
        row[name] = _fraction(row[name])
    return ["" if value is None else str(value) for value in row.values()]


def _fraction(value: Any) -> Any:
    """Return a number as Python writes it, None for NaN; what is no number stays as it is."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return value
    return None if math.isnan(number) else number
