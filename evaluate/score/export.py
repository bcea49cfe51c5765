"""Write rows in the layout of the released CSV."""

import csv
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.score.rows import RELEASED_SIMULATOR, Rows
from robomme_interference_data.files import atomic_path
from robomme_interference_data.records import Status

__all__ = ["RELEASED_COLUMNS", "export"]

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

_SUCCESS = {True: 1, False: 0, None: None}


def export(rows: Rows, folder: Path) -> list[Path]:
    """Write rows as `<system>-<simulator>_rollouts.csv`, a file each.

    The columns are those of the released retrieval rows, which name no system, split or revision;
    rows of another simulator than RoboMME have its name in one more, the last. A timeout is
    `ongoing`, as there. The rows keep the order of their files, and are the same bytes whatever
    files they come from.

    Args:
        rows: Rows that were read.
        folder: Where to write.

    Returns:
        The files.

    Raises:
        InvalidOptionError: The layout cannot tell the rows apart: there are repeats with several
            model seeds, or episodes that are not `test`. Or bad rows were left out.
    """
    _check(rows)
    columns = [rows.list(name) for name in ("simulator", "system", *RELEASED_COLUMNS)]
    written: dict[tuple[str, str], Path] = {}
    with ExitStack() as stack:
        writers: dict[tuple[str, str], Any] = {}
        for simulator, system, *values in zip(*columns, strict=True):
            key = (simulator, system)
            more = [] if simulator == RELEASED_SIMULATOR else [simulator]
            if key not in writers:
                written[key] = folder / f"{system}-{simulator}_rollouts.csv"
                partial = stack.enter_context(atomic_path(written[key]))
                file = stack.enter_context(partial.open("w", newline="", encoding="utf-8"))
                writers[key] = csv.writer(file)  # with CRLF, as released
                writers[key].writerow((*RELEASED_COLUMNS, *(["simulator"] if more else [])))
            row = dict(zip(RELEASED_COLUMNS, values, strict=True))
            row["success"] = _SUCCESS[row["success"]]
            row["status"] = "ongoing" if row["status"] == Status.TIMEOUT else row["status"]
            writers[key].writerow((*row.values(), *more))
    return sorted(written.values())


def _check(rows: Rows) -> None:
    if len(seeds := rows.names("model_seed")) > 1:
        raise InvalidOptionError(
            f"the rows have {len(seeds)} model seeds, and the released layout has no column for "
            "them",
            "Export the run of each seed by itself.",
        )
    if other := sum(split != "test" for split in rows.list("episode_split")):
        raise InvalidOptionError(
            f"{other:,} rows are of train or val episodes, and the released layout has no column "
            "for that",
            "Export rows of test episodes only.",
        )
    if rows.refused:
        raise InvalidOptionError(
            f"{rows.refused:,} rows are bad", "Mend them first: only sound rows are exported."
        )
