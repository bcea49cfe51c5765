"""The layout of a table in a terminal of some width; its borders are those of `rich`."""

import io
import re
import shutil
from collections.abc import Iterable, Sequence
from functools import partial
from textwrap import fill
from typing import Any, NamedTuple

from robomme_interference_data.errors import visible


class Column(NamedTuple):
    """A column as it is shown.

    Attributes:
        head: Its head.
        side: `left` or `right`, where its cells are aligned.
        wraps: Whether its cells are texts, which may wrap.
        is_key: Whether its cells can tell rows apart: names and numbers, no measured values.
    """

    head: str
    side: str
    wraps: bool
    is_key: bool


_Rows = Sequence[Sequence[str]]

_BOLD = re.compile(r"\*\*(.+?)\*\*")

_COUNT_OF = re.compile(r"(?<=\d) of (?=\d)")
"""Inside a count such as `6 of 12`, which is read as one number."""

_SOLID_SPACE = "\ue000"
"""Stands for a space where no line may end: rich breaks lines at no-break spaces, too."""

_NO_BREAK = f"{_SOLID_SPACE}of{_SOLID_SPACE}"

_GAP = 2
"""Spaces between columns."""

# Addresses and commands are copied.
_fill = partial(fill, break_on_hyphens=False, break_long_words=False)

_MAX_WORD = 26
"""Longer words may be broken to make a table fit."""


def terminal_text(
    title: str, columns: Sequence[Column], rows: _Rows, note: str, width: int | None
) -> str:
    """Return a table as lines; see `Table.text`.

    Args:
        title: Above it.
        columns: Its columns.
        rows: Its cells; text between `**` is bold.
        note: Below it.
        width: Letters in a line; None for the terminal's, at least 80.
    """
    width = width or max(80, shutil.get_terminal_size().columns)
    # Plain text has no bold letters: a star marks them.
    rows = [[_COUNT_OF.sub(_NO_BREAK, _BOLD.sub(r"\1*", cell)) for cell in row] for row in rows]
    widths = _widths(columns, rows, width)
    parts = [_fill(title, width)]
    for block in _blocks(columns, rows, widths, width):
        shown = [(columns[place], widths[place]) for place in block]
        parts.append(_aligned(shown, [[row[place] for place in block] for row in rows]))
    parts.append(_fill(note, width))
    return visible("\n\n".join(filter(None, parts)).replace(_SOLID_SPACE, " "))


def _widths(columns: Sequence[Column], rows: _Rows, width: int) -> list[int]:
    """Return the width of each column: texts give way, so that more columns fit."""
    cells_of = list(zip((column.head for column in columns), *rows, strict=True))
    widths = [max(map(len, cells)) for cells in cells_of]
    least = [
        min(_MAX_WORD, _longest_word(cells))
        if column.wraps
        else max(_longest_word(cells[:1]), *map(len, cells[1:]), 0)
        for column, cells in zip(columns, cells_of, strict=True)
    ]
    while sum(widths) + _GAP * (len(widths) - 1) > width and widths != least:
        wrappable = (place for place, size in enumerate(widths) if size > least[place])
        # The widest gives way first, a letter at a time.
        widths[max(wrappable, key=widths.__getitem__)] -= 1
    return widths


def _longest_word(cells: Iterable[str]) -> int:
    return max((len(word) for cell in cells for word in cell.split()), default=0)


def _blocks(
    columns: Sequence[Column], rows: _Rows, widths: Sequence[int], width: int
) -> list[list[int]]:
    """Return the columns of each block of the table; keys stand first in every block."""
    keys = _keys(columns, rows)
    while len(keys) > 1 and sum(widths[key] + _GAP for key in keys) + max(widths) > width:
        keys.pop()  # they must leave room for any other column
    blocks: list[list[int]] = [[]]
    for place, size in enumerate(widths):
        if place in blocks[-1]:
            continue  # a key of a block that began before it
        used = sum(widths[shown] + _GAP for shown in blocks[-1])
        if used + size > width and not {*blocks[-1]} <= {*keys}:
            blocks.append([*keys])
        if place not in blocks[-1]:
            blocks[-1].append(place)
    return blocks


def _keys(columns: Sequence[Column], rows: _Rows) -> list[int]:
    """Return the columns that tell rows apart: the first keys that do."""
    keys: list[int] = []
    apart = 1
    for place, column in enumerate(columns):
        if not column.is_key or apart == len(rows):
            break
        distinct = len({tuple(row[key] for key in (*keys, place)) for row in rows})
        if distinct > apart:
            keys.append(place)
            apart = distinct
    return keys or [0]


def _aligned(columns: Sequence[tuple[Column, int]], rows: _Rows) -> str:
    """Return the lines of columns, each with its width."""
    from rich import box
    from rich.console import Console
    from rich.table import Table as RichTable
    from rich.text import Text

    table = RichTable(
        box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, _GAP - 1, 0, 0)
    )
    for column, width in columns:
        side: Any = column.side
        table.add_column(Text(column.head), justify=side, width=width, overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    # Wide enough for all columns, which have their widths already.
    total = sum(width + _GAP for _, width in columns)
    console = Console(file=io.StringIO(), width=total, color_system=None)
    with console.capture() as capture:
        console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())
