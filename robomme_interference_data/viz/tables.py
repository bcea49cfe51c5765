"""Tables as data, and as text for terminals, CSV, Markdown, LaTeX and HTML."""

import csv
import io
import math
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from textwrap import fill, wrap
from typing import Any, Literal

import pyarrow as pa

from robomme_interference_data.errors import visible
from robomme_interference_data.schema.codec import arrow_schema

Format = Literal["text", "count", "rate", "points", "ratio", "number", "p", "flag"]
"""How the values of a column are shown. `rate` and `points` are fractions: CSV has six decimals of
them, everything else percent and percentage points."""

Columns = dict[str, Format]
"""Name of a column to its format, in the order of the table."""


@dataclass(frozen=True)
class Table:
    """Rows under columns; None and NaN are empty cells.

    Attributes:
        name: Name of its files.
        title: Its subject, in a line.
        columns: Name of each column to its format, in order.
        rows: The values of each row, in the order of the columns.
        note: How to read it, in a sentence or two.
    """

    name: str
    title: str
    columns: Mapping[str, Format]
    rows: Sequence[Sequence[Any]]
    note: str = ""

    def without_empty(self, name: str) -> "Table":
        """Return the table without a column that has no value, nor text, in any row."""
        place = [*self.columns].index(name)
        if any(row[place] not in (None, "") for row in self.rows):
            return self
        kept = {column: form for column, form in self.columns.items() if column != name}
        rows = [(*row[:place], *row[place + 1 :]) for row in self.rows]
        return replace(self, columns=kept, rows=rows)

    def records(self) -> list[dict[str, Any]]:
        """Return the rows by column name, NaN as None, for JSON."""
        return [dict(zip(self.columns, map(_known, row), strict=True)) for row in self.rows]

    def csv(self) -> str:
        """Return the table as CSV."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.columns)
        for row in self.rows:
            pairs = zip(row, self.columns.values(), strict=True)
            writer.writerow([_plain(value, format_) for value, format_ in pairs])
        return out.getvalue()

    def _layout(self, left: str, right: str) -> tuple[list[str], list[str], list[list[str]]]:
        """Return the mark of each column's side, the heads, and the rows as text."""
        sides = [left if form in ("text", "flag") else right for form in self.columns.values()]
        heads = [name.replace("_", " ") for name in self.columns]
        return sides, heads, [self.cells(row) for row in self.rows]

    def cells(self, row: Sequence[Any]) -> list[str]:
        """Return a row as text; p-values of a row that is not complete are marked with †."""
        values = dict(zip(self.columns, row, strict=True))
        early = not values.get("complete", True)
        texts = []
        for name, format_ in self.columns.items():
            text = _shown(values[name], format_)
            texts.append(f"{text}†" if early and text and format_ == "p" else text)
        return texts

    def markdown(self) -> str:
        """Return the table as Markdown, under its title."""
        return "\n\n".join(filter(None, (f"# {self.title}", self.grid(), self.note))) + "\n"

    def grid(self) -> str:
        """Return the table as Markdown, without title and note."""
        rule, heads, rows = self._layout("---", "---:")
        # A bar would end the cell.
        cells = ([cell.replace("|", "\\|") for cell in row] for row in rows)
        return "\n".join(f"| {' | '.join(line)} |" for line in [heads, rule, *cells])

    def latex(self) -> str:
        """Return the table as LaTeX for booktabs; title and note are comments."""
        sides, heads, rows = self._layout("l", "r")
        head, *lines = (" & ".join(map(_tex, line)) for line in [heads, *rows])
        body = "".join(f"{line} \\\\\n" for line in lines)
        note = "".join(f"% {line}\n" for line in wrap(self.note, 96))
        return (
            f"% {self.title}\n\\begin{{tabular}}{{{''.join(sides)}}}\n\\toprule\n{head} \\\\\n"
            f"\\midrule\n{body}\\bottomrule\n\\end{{tabular}}\n{note}"
        )

    def html(self) -> str:
        """Return the table as HTML, under its title."""
        sides, heads, rows = self._layout("left", "right")

        def line(tag: str, cells: Sequence[str]) -> str:
            parts = (
                f'<{tag} style="text-align: {side}">{escape(cell)}</{tag}>'
                for side, cell in zip(sides, cells, strict=True)
            )
            return f"<tr>{''.join(parts)}</tr>"

        body = "".join(line("td", row) for row in rows)
        table = f"<table><thead>{line('th', heads)}</thead><tbody>{body}</tbody></table>"
        return f"<p>{escape(self.title)}</p>{table}<p>{escape(self.note)}</p>"

    def text(self, width: int | None = None) -> str:
        """Return the table for a terminal: title, aligned columns, note.

        Cells wrap, and columns continue below, to fit the width: by default the terminal's, at
        least 80. The columns that tell rows apart are repeated there. Bold cells end in `*`.
        """
        width = width or max(80, shutil.get_terminal_size().columns)
        sides, heads, rows = self._layout("left", "right")
        # Plain text has no bold letters: a star marks them.
        rows = [[_COUNT_OF.sub(_NO_BREAK, _BOLD.sub(r"\1*", cell)) for cell in row] for row in rows]
        widths = self._widths(heads, rows, width)
        parts = [_fill(self.title, width)]
        for block in self._blocks(rows, widths, width):
            columns = [(heads[place], sides[place], widths[place]) for place in block]
            parts.append(_aligned(columns, [[row[place] for place in block] for row in rows]))
        parts.append(_fill(self.note, width))
        return visible("\n\n".join(filter(None, parts)).replace(_SOLID_SPACE, " "))

    def _widths(self, heads: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> list[int]:
        """Return the width of each column: texts give way, so that more columns fit."""
        columns = list(zip(heads, *rows, strict=True))
        widths = [max(map(len, cells)) for cells in columns]
        least = [
            min(_MAX_WORD, _longest_word(cells))
            if format_ == "text"
            else max(_longest_word(cells[:1]), *map(len, cells[1:]), 0)
            for cells, format_ in zip(columns, self.columns.values(), strict=True)
        ]
        while sum(widths) + _GAP * (len(widths) - 1) > width and widths != least:
            wrappable = (place for place, size in enumerate(widths) if size > least[place])
            # The widest gives way first, a letter at a time.
            widths[max(wrappable, key=widths.__getitem__)] -= 1
        return widths

    def _blocks(
        self, rows: Sequence[Sequence[str]], widths: Sequence[int], width: int
    ) -> list[list[int]]:
        """Return the columns of each block of the table; keys stand first in every block."""
        keys = self._keys(rows)
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

    def _keys(self, rows: Sequence[Sequence[str]]) -> list[int]:
        """Return the columns that tell rows apart: the first ones of names and numbers that do."""
        keys: list[int] = []
        apart = 1
        for place, format_ in enumerate(self.columns.values()):
            if format_ not in ("text", "count") or apart == len(rows):
                break
            found = len({tuple(row[key] for key in (*keys, place)) for row in rows})
            if found > apart:
                keys.append(place)
                apart = found
        return keys or [0]


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


def _longest_word(cells: Iterable[str]) -> int:
    return max((len(word) for cell in cells for word in cell.split()), default=0)


def _aligned(columns: Sequence[tuple[str, Any, int]], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as lines, given the head, side and width of each column."""
    from rich import box
    from rich.console import Console
    from rich.table import Table as RichTable
    from rich.text import Text

    table = RichTable(
        box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, _GAP - 1, 0, 0)
    )
    for head, side, width in columns:
        table.add_column(Text(head), justify=side, width=width, overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    # Wide enough for all columns, which have their widths already.
    total = sum(width + _GAP for _, _, width in columns)
    console = Console(file=io.StringIO(), width=total, color_system=None)
    with console.capture() as capture:
        console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())


def record_columns(record: type) -> Columns:
    """Return the columns of a record: those of its Arrow schema, numbers as ratios."""
    formats: dict[Any, Format] = {pa.int64(): "count", pa.float64(): "ratio", pa.bool_(): "flag"}
    return {field.name: formats.get(field.type, "text") for field in arrow_schema(record)}


def tables_text(tables: Sequence[Table]) -> str:
    """Return tables for a terminal, with each note only below the last table that has it."""
    notes = [table.note for table in tables]
    shown = [
        replace(table, note="") if table.note in notes[number + 1 :] else table
        for number, table in enumerate(tables)
    ]
    return "\n\n".join(table.text() for table in shown)


_TEX = {letter: f"\\{letter}" for letter in "&%$#_{}"}
_TEX |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_TEX |= {"−": "$-$", "–": "--", "<": "$<$", ">": "$>$", "×": r"$\times$", "π": r"$\pi$"}
_TEX |= {"†": r"\textdagger{}", "±": r"$\pm$", "₂": "$_2$"}


def _tex(text: str) -> str:
    """Return a cell as LaTeX; text between `**` is bold."""
    parts = ["".join(_TEX.get(letter, letter) for letter in part) for part in text.split("**")]
    return "".join(f"\\textbf{{{p}}}" if n % 2 else p for n, p in enumerate(parts))


def percent(value: float) -> str:
    """Return a fraction as percent, `44.9%`."""
    return f"{100 * value:.1f}%"


def points(value: float) -> str:
    """Return a difference of fractions in percentage points, `+27.1` or `−3.0`."""
    text = f"{100 * value:+.1f}"
    return "0.0" if text in ("+0.0", "-0.0") else text.replace("-", "−")


def error_change(value: float) -> str:
    """Return a difference of action errors, `+0.0123` or `−0.0040`."""
    text = f"{value:+.4f}"
    return "0.0000" if text in ("+0.0000", "-0.0000") else text.replace("-", "−")


def p_text(value: float) -> str:
    """Return a p-value as `0.031` or `< 0.001`."""
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


def _plain(value: Any, format_: Format) -> str:
    value = _known(value)
    if value is None:
        return ""
    if format_ == "flag":
        return "yes" if value else "no"
    if format_ in ("rate", "points", "ratio", "number"):
        text = f"{value:.6f}"
        return "0.000000" if text == "-0.000000" else text
    return f"{value:.6g}" if format_ == "p" else str(value)


def _shown(value: Any, format_: Format) -> str:
    value = _known(value)
    if value is None:
        return ""
    shapes: dict[str, Callable[[Any], str]] = {
        "rate": percent,
        "points": points,
        "ratio": lambda v: f"{round(v, 2) + 0.0:.2f}".replace("-", "−"),
        "number": lambda v: f"{round(v, 4) + 0.0:.4f}".replace("-", "−"),
        "p": p_text,
        "count": lambda v: f"{v:,}",
    }
    return shapes.get(format_, lambda v: _plain(v, format_))(value)
