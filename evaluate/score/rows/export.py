"""Write rows in the layout of the released CSV."""

import csv
from dataclasses import replace
from pathlib import Path

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.storage.files import atomic_path

from .checked import RELEASED_SIMULATOR, Rows

RELEASED_COLUMNS = (
    *("family", "condition", "episode", "seed", "difficulty", "status", "success", "steps"),
    *("retrieval_model", "retrieval_selected_lesson_fraction"),
    *("retrieval_selected_filler_fraction", "retrieval_selected_query_fraction"),
)
"""The columns of the released retrieval rows, in their order. They name no system."""


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
    seeds = len(rows.names("model_seed"))
    other = int((rows.places("episode_split", ["test"]) < 0).sum())
    wrong = [f"{seeds} model seeds"] * (seeds > 1)
    wrong += [f"{other:,} rows of train or val episodes"] * (other > 0)
    wrong += [f"{rows.refused:,} bad rows"] * (rows.refused > 0)
    if wrong:
        raise InvalidOptionError(
            f"rows to export: {', '.join(wrong)}; expected sound rows of test episodes and of one "
            "model seed",
            "The released layout has no column for more: export such rows only.",
        )
    told = {Status.TIMEOUT: Status.ONGOING}
    values = {
        "status": [told.get(one, one) for one in rows.values["status"]],
        "success": [one if one is None else int(one) for one in rows.values["success"]],
    }
    written = []
    for simulator, part in replace(rows, values=rows.values | values).by("simulator").items():
        names = [*RELEASED_COLUMNS, *["simulator"] * (simulator != RELEASED_SIMULATOR)]
        for system, own in part.by("system").items():
            written.append(folder / f"{system}-{simulator}_rollouts.csv")
            with (
                atomic_path(written[-1]) as partial,
                partial.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file,
            ):
                writer = csv.writer(file)  # with CRLF, as released
                writer.writerow(names)
                writer.writerows(zip(*map(own.list, names), strict=True))
    return sorted(written)
