"""Find files with outcomes of rollouts and read their columns; `reading` checks the values."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from robomme_interference_data.constants import RUN_HEADER, RUN_RECORD, RUN_TABLES
from robomme_interference_data.errors import FormatError, InvalidOptionError, MissingFileError
from robomme_interference_data.storage.files import read_header, reading

from .csv_file import CSV
from .lerobot_eval import LEROBOT_EVAL
from .parquet_file import PARQUET
from .row_format import FileColumns, RowFile
from .run_record import RUN_RECORD_FORMAT
from .vla_eval import VLA_EVAL

if TYPE_CHECKING:
    from robomme_interference_data.evaluate.run.record import RunHeader

FORMATS = (RUN_RECORD_FORMAT, PARQUET, CSV, VLA_EVAL, LEROBOT_EVAL)
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
