"""Write rows in the layout of the released CSV."""

import csv
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import repeat
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.score.read import RELEASED_COLUMNS, Batch, read_batches
from robomme_interference_data.evaluate.score.rollouts import Rollouts
from robomme_interference_data.files import atomic_path

__all__ = ["export"]


def export(rollouts: Rollouts, folder: Path, system: str | None = None) -> list[Path]:
    """Write the rows that were scored as `<system>-<simulator>_rollouts.csv`, a file each.

    The columns are those of the released retrieval rows, which name no system, simulator or
    revision; a timeout is `ongoing`, as there. The rows keep the order of their files.

    Args:
        rollouts: Rows that were read.
        folder: Where to write.
        system: Name of the system of rows that name none.

    Returns:
        The files.

    Raises:
        InvalidOptionError: There are repeats with several model seeds, which the layout cannot
            tell apart, or bad rows were skipped.
    """
    if len(rollouts.model_seeds) > 1:
        raise InvalidOptionError(
            f"the rows have {len(rollouts.model_seeds)} model seeds, and the released layout has "
            "no column for them",
            "Export the run of each seed by itself.",
        )
    if rollouts.refused:
        raise InvalidOptionError(
            f"{rollouts.refused:,} rows are bad", "Mend them first: only sound rows are exported."
        )
    written: dict[tuple[str, str], Path] = {}
    with ExitStack() as stack:
        writers: dict[tuple[str, str], Any] = {}
        for key, row in _rows(rollouts, system):
            if key not in writers:
                simulator, name = key
                written[key] = folder / f"{name}-{simulator}_rollouts.csv"
                partial = stack.enter_context(atomic_path(written[key]))
                file = stack.enter_context(partial.open("w", newline="", encoding="utf-8"))
                writers[key] = csv.writer(file)  # with CRLF, as released
                writers[key].writerow(RELEASED_COLUMNS)
            writers[key].writerow(row)
    return sorted(written.values())


def _rows(rollouts: Rollouts, system: str | None) -> Iterator[tuple[tuple[str, str], list[Any]]]:
    for source in rollouts.sources:
        for batch in read_batches(source, ("simulator", "system", *RELEASED_COLUMNS)):
            simulators = _values(batch, "simulator", "robomme")
            systems = _values(batch, "system", system)
            columns = [_values(batch, name, None) for name in RELEASED_COLUMNS]
            for *key, row in zip(simulators, systems, zip(*columns, strict=True), strict=False):
                yield (key[0], key[1]), [_text(v) for v in row]


def _values(batch: Batch, name: str, default: Any) -> Any:
    column = batch.columns.get(name)
    return repeat(default, batch.rows) if column is None else column.to_pylist()


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(int(value))
    return "ongoing" if value == "timeout" else "" if value is None else str(value)
