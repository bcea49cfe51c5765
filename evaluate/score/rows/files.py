"""Read the columns of files with outcomes of rollouts; `reading` checks the values."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robomme_interference_data.constants import RUN_HEADER, RUN_RECORD, RUN_TABLES
from robomme_interference_data.errors import (
    FormatError,
    InvalidOptionError,
    MissingFileError,
    counted,
    named,
)
from robomme_interference_data.evaluate.systems import name_system
from robomme_interference_data.storage.files import reading
from robomme_interference_data.storage.text import read_header

from .row_format import FileColumns, ReadFiles, RowFile, RowFormat
from .values import MAX_NUMBER

if TYPE_CHECKING:
    from robomme_interference_data.evaluate.run.record import RunHeader

FORMATS = (
    RowFormat(
        "the folder of a run, or its rollouts.jsonl",
        "run_record",
        lambda file: file.suffix == ".jsonl",
    ),
    RowFormat("rows of a run as .parquet", "parquet_file", lambda file: file.suffix == ".parquet"),
    RowFormat(
        "rows of a run, or released rows of the paper, as .csv",
        "csv_file",
        lambda file: file.suffix == ".csv",
    ),
    RowFormat(
        "results of vla-eval (*_aggregate.json)",
        "vla_eval",
        lambda file: "tasks" in file.json and "per_task" not in file.json,
    ),
    RowFormat(
        "eval_info.json of lerobot-eval",
        "lerobot_eval",
        # By its name too: of other versions of lerobot, the error names the key that is missing.
        lambda file: (
            (file.path.name == "eval_info.json" or "per_task" in file.json)
            and "tasks" not in file.json
        ),
    ),
)
"""Every format that can be read."""


_CORRECT = "Correct it, or write it again: it may have been edited, or cut short."


def find_sources(paths: Sequence[Path]) -> "dict[Path, RunHeader | None]":
    """Return the file of rows of each path, with the header of the run that it belongs to.

    In a run's folder the file is the record.
    """
    sources: dict[Path, RunHeader | None] = {}
    for path_or_folder in paths:
        path = path_or_folder
        if path.is_dir():
            path = path / RUN_RECORD
            if not path.is_file():
                raise MissingFileError(
                    f"{path_or_folder} is not the folder of a run: it has no {RUN_RECORD}",
                    f"Give {_known()}.",
                )
        if not path.is_file():
            raise MissingFileError(f"there is no file {path}", f"Give {_known()}.")
        if any(path.samefile(source) for source in sources):
            raise InvalidOptionError(f"{path} is given twice", "Give each file once.")
        header = path.parent / RUN_HEADER
        of_run = path.name in (RUN_RECORD, *RUN_TABLES) and header.is_file()
        sources[path] = _read_run_header(header) if of_run else None
    return sources


def _read_run_header(path: Path) -> "RunHeader":
    # Files of rows alone do without runs.
    from robomme_interference_data.evaluate.run.record import RunHeader

    return read_header(path, RunHeader)


def read_file(path: Path, names: Sequence[str]) -> FileColumns:
    """Read those of the named columns that a file has.

    Raises:
        FormatError: The file has none of the known formats, or is damaged.
    """
    file = RowFile(path)
    with reading(path, _CORRECT):
        for row_format in FORMATS:
            if row_format.matches(file):
                return row_format.read(file, names)
    raise FormatError(f"{path} has no known format", f"Give {_known()}.")


def _known() -> str:
    *others, last = [row_format.description for row_format in FORMATS]
    return f"{'; '.join(others)}; or {last}"


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
