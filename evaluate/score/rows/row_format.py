"""What a format of files with outcomes declares, and what reading such a file gives."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import pyarrow as pa

from robomme_interference_data.constants import MAX_ROW_BYTES
from robomme_interference_data.errors import FormatError
from robomme_interference_data.storage.text import parse_json, read_bytes

_MAX_ROWS = 1 << 20
"""Rows in a file, at most: the paper's grid has 25,200."""


@dataclass(frozen=True)
class FileColumns:
    """The columns of one file, and what is known of all of its rows.

    Attributes:
        columns: The values of the columns that the file has, by their names in `Row`.
        lines: The line, or number, of each row.
        malformed: Why other lines are not rows.
        system: The system that the name of the file states.
        scenes: Only of evaluations by other programs: what they say of their scenes.
    """

    columns: Mapping[str, Sequence[Any]]
    lines: Sequence[int]
    malformed: Mapping[int, str] = field(default_factory=dict)
    system: str | None = None
    scenes: "Scenes | None" = None


ReadFiles = Mapping[Path, FileColumns]
"""Files with their columns."""


@dataclass(frozen=True)
class Scenes:
    """What the results of another program say of their scenes.

    They name no buffer set. An episode is the same scene for two systems if they agree in
    `evaluation` and ran with the same seeds.

    Attributes:
        program: The program that wrote the results.
        evaluation: What decides the scenes beside number and seed of an episode.
    """

    program: str
    evaluation: str


class RowFile:
    """A file that holds outcomes, before its format is known."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.suffix = path.suffix.lower()

    @cached_property
    def json(self) -> dict[str, Any]:
        """The object of a JSON file; empty for files of other kinds.

        Raises:
            FormatError: It is not valid JSON.
        """
        if self.suffix != ".json":
            return {}
        return parse_json(read_bytes(self.path, MAX_ROW_BYTES), self.path)


@dataclass(frozen=True)
class RowFormat:
    """A format of files with outcomes; `files.FORMATS` lists all of them.

    Attributes:
        description: The format in a few words, for the error that lists all formats.
        module: The file of this folder whose function `read` reads it, imported when a file has the
            format.
        matches: Whether a file has this format. No file has two.
    """

    description: str
    module: str
    matches: Callable[[RowFile], bool]

    def read(self, file: RowFile, names: Sequence[str]) -> FileColumns:
        """Read those of the named columns that a file has."""
        read: Callable[[RowFile, Sequence[str]], FileColumns]
        read = import_module(f"{__package__}.{self.module}").read
        return read(file, names)


def check_count(rows: int) -> None:
    """Raise a `ValueError` for more rows than a file may have."""
    if rows > _MAX_ROWS:
        raise ValueError(f"more than {_MAX_ROWS:,} rows; expected at most that many")


def plain_name(text: str) -> str:
    """Return a name by another program as name of a simulator or family: `pick up` as `pick_up`."""
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", text)
    return name if name[:1].isalpha() else f"task_{name}"


def plain_columns(path: Path, table: pa.Table) -> dict[str, list[Any]]:
    """Return the values of a table without nested columns."""
    for column in table.columns:
        kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
        if pa.types.is_nested(kind):
            raise FormatError.damaged(path, f"a column holds {kind}; expected text and numbers")
    return {name: table[name].to_pylist() for name in table.column_names}
