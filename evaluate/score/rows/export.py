"""Write rows in the layout of the released CSV."""

import csv
from collections import defaultdict
from operator import attrgetter
from pathlib import Path
from typing import Any

from robomme_interference_data.constants import RECORDINGS
from robomme_interference_data.errors import InvalidOptionError, counted
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.storage.csv_text import quoted
from robomme_interference_data.storage.files import atomic_path

from .reading import CheckedRows
from .values import RELEASED_SIMULATOR, Row

RELEASED_COLUMNS = {
    "family": "family",
    "condition": "condition",
    "episode": "episode",
    "seed": "seed",
    "difficulty": "difficulty",
    "status": "status",
    "success": "success",
    "steps": "steps",
    "retrieval_model": "retrieval",
    "retrieval_selected_lesson_fraction": "retrieval_selected_lesson_fraction",
    "retrieval_selected_filler_fraction": "retrieval_selected_filler_fraction",
    "retrieval_selected_query_fraction": "retrieval_selected_query_fraction",
}
"""The columns of the released retrieval rows, in their order, to those of a run."""


def export(rows: CheckedRows, folder: Path) -> list[Path]:
    """Write rows in the released layout, a file `<system>-<simulator>_rollouts.csv` each.

    The released columns name no system, buffer set or revision; rows of a simulator other than
    RoboMME get its name as one more column. A timeout is written as `ongoing`, and text that a
    spreadsheet would run as a formula with an apostrophe before it, which reading removes.
    """
    seeds = len({(row.training_seed, row.model_seed) for row in rows})
    other_splits = sum(row.split != "test" for row in rows)
    offline = sum(row.simulator == RECORDINGS for row in rows)
    wrong = []
    if seeds > 1:
        wrong.append(f"{seeds} seeds of training or model")
    if other_splits:
        wrong.append(f"{other_splits:,} rows of train or val episodes")
    if offline:
        wrong.append(f"{counted(offline, 'row')} of offline runs")
    if rows.bad_count:
        wrong.append(f"{rows.bad_count:,} bad rows")
    if wrong:
        raise InvalidOptionError(
            f"rows to export: {', '.join(wrong)}; expected valid rows of rollouts of test "
            "episodes and of one model seed",
            "The released layout has no columns for these: export other rows.",
        )
    files = defaultdict[Path, list[Row]](list)
    for row in rows:
        files[folder / f"{row.system}-{row.simulator}_rollouts.csv"].append(row)
    for path, group in files.items():
        columns = dict(RELEASED_COLUMNS)
        if group[0].simulator != RELEASED_SIMULATOR:
            columns["simulator"] = "simulator"
        values = attrgetter(*columns.values())
        with (
            atomic_path(path) as partial,
            partial.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file,
        ):
            writer = csv.writer(file)  # with CRLF, as released
            writer.writerow(columns)
            writer.writerows(map(quoted, values(_released(row))) for row in group)
    return sorted(files)


def _released(row: Row) -> Row:
    status = str(Status.ONGOING) if row.status == Status.TIMEOUT else row.status
    success: Any = None if row.success is None else int(row.success)
    return row._replace(status=status, success=success)
