"""What files do not state of their rows and the user does: system and model seed."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import FormatError, InvalidOptionError, counted, named
from robomme_interference_data.evaluate.systems import name_system

from .row_format import FileColumns, ReadFiles
from .values import MAX_NUMBER


def with_stated(
    files: ReadFiles,
    systems: Sequence[str],
    model_seeds: Sequence[int],
    system_option: str = "system",
) -> dict[Path, FileColumns]:
    """Return the files, with system and model seed of those that do not state theirs.

    Args:
        files: The files.
        systems: A name for all files that name no system, or one for each of them in order.
        model_seeds: Likewise the seeds of files without a column for the model seed.
        system_option: The setting that errors name for `systems`.

    Raises:
        FormatError: A system is unknown.
        InvalidIdError: The name of a system is invalid.
        InvalidOptionError: A seed is out of range, or the number of values is not that of the files
            that need one.
    """
    for seed in model_seeds:
        if not 0 <= seed <= MAX_NUMBER:
            raise InvalidOptionError.expected(
                "model_seed", seed, f"a whole number from 0 to {MAX_NUMBER}"
            )
    completed = dict(files)
    for path, contents in files.items():
        if contents.system is not None:
            completed[path] = _with(contents, "system", name_system(contents.system).name)
    for path, system in _values("system", completed, systems, system_option).items():
        completed[path] = _with(completed[path], "system", name_system(system).name)
    for path, seed in _values("model_seed", completed, model_seeds, "model_seed").items():
        completed[path] = _with(completed[path], "model_seed", seed)
    unknown = [path for path, contents in completed.items() if "system" not in contents.columns]
    if unknown:
        hint = f"Name it, such as {named(system_option, 'my-memory')}."
        if len(unknown) > 1:
            hint += f" {len(unknown)} files name none: give the option once for each, in order."
        raise FormatError(f"{unknown[0]} names no system", hint)
    return completed


def _with(contents: FileColumns, column: str, value: Any) -> FileColumns:
    """Return a file with the same value in each row, unless it has the column."""
    return replace(contents, columns={column: [value] * len(contents.lines), **contents.columns})


def _values(column: str, files: ReadFiles, stated: Sequence[Any], option: str) -> dict[Path, Any]:
    """Return the stated value for each file without a column."""
    lacking = [path for path, contents in files.items() if column not in contents.columns]
    if not stated:
        return {}
    what = column.replace("_", " ")
    if not lacking:
        held = {str(value) for contents in files.values() for value in contents.columns[column]}
        if held.issuperset(map(str, stated)):
            return {}  # the files say the same
        raise InvalidOptionError(
            f"{named(option)} {', '.join(map(str, stated))}: each file states its own {what}",
            f"Leave {named(option)} out: it is for files that state no {what}.",
            option=option,
        )
    if len(stated) == 1:
        return dict.fromkeys(lacking, stated[0])
    if len(stated) != len(lacking):
        raise InvalidOptionError(
            f"{counted(len(stated), 'value')} of {named(option)} for "
            f"{counted(len(lacking), 'file')} that state no {what}: "
            f"{', '.join(map(str, lacking))}",
            "Give one for all of them, or one for each in their order.",
            option=option,
        )
    return dict(zip(lacking, stated, strict=True))
