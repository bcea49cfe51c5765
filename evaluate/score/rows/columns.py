"""Columns of files with a row for each rollout: their names, and what follows from others."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from robomme_interference_data.errors import FormatError
from robomme_interference_data.schema.rollouts import Status, success_of

from .row_format import FileColumns
from .values import TRUTH

_REQUIRED = ("family", "condition", "episode")
_OUTCOME = ("status", "success")
"""At least one of them is required: the other one follows."""

_RELEASED_NAMES = {"variant": "system", "retrieval_model": "retrieval"}
"""Columns of released files to their names here."""


def select(path: Path, header: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Return the column of the file that holds each of the named columns."""
    # Columns without a name, such as pandas' index and a spreadsheet's empty ones, are not read.
    if twice := [name for name in header if name.strip() and header.count(name) > 1]:
        raise FormatError(f"{path} has two columns {twice[0]!r}", "Rename one of them.")
    columns = {_RELEASED_NAMES.get(name, name): name for name in header}
    missing = [name for name in _REQUIRED if name not in columns]
    if not any(name in columns for name in _OUTCOME):
        missing.append(" or ".join(_OUTCOME))
    if missing:
        raise FormatError(
            # Quoted, so that a space in a name is seen.
            f"{path} lacks the columns {', '.join(missing)}; it has "
            f"{', '.join(map(repr, header)) or 'none'}",
            "Expected the rows of a run, or of the released CSVs (docs/reference/score-tables.md).",
        )
    return {name: columns[name] for name in names if name in columns}


def with_outcomes(contents: FileColumns) -> FileColumns:
    """Return the columns of a file with both status and success."""
    columns = contents.columns
    if "success" not in columns:
        known = {str(status): success_of(status) for status in Status}
        outcomes = [known.get(str(status)) for status in columns["status"]]
        return replace(contents, columns={**columns, "success": outcomes})
    if "status" not in columns:
        return _with_status(contents)
    return contents


def _with_status(contents: FileColumns) -> FileColumns:
    """Return the columns with a status; without one, a rollout is a success or a failure."""
    statuses = {True: Status.SUCCESS, False: Status.FAIL}
    outcomes = [TRUTH.get(str(value).lower()) for value in contents.columns["success"]]
    kept = [at for at, outcome in enumerate(outcomes) if outcome is not None]
    malformed = {
        line: f"success {value!r}; expected 1, 0, true or false: the file has no status"
        for line, value, outcome in zip(
            contents.lines, contents.columns["success"], outcomes, strict=True
        )
        if outcome is None
    }
    columns = {name: [values[at] for at in kept] for name, values in contents.columns.items()}
    columns["status"] = [str(statuses[outcome]) for outcome in outcomes if outcome is not None]
    return replace(
        contents,
        columns=columns,
        lines=[contents.lines[at] for at in kept],
        malformed={**contents.malformed, **malformed},
    )
