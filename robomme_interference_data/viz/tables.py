"""Tables as data, and as text for terminals, CSV, Markdown, LaTeX and HTML."""

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from textwrap import wrap
from typing import Any, Literal

import pyarrow as pa

from robomme_interference_data.schema.codec import arrow_schema
from robomme_interference_data.storage.csv_text import quoted

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
        """Return the table as CSV, without text that a spreadsheet would run as a formula."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.columns)
        for row in self.rows:
            pairs = zip(row, self.columns.values(), strict=True)
            writer.writerow([_cell(value, format_) for value, format_ in pairs])
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
        from .terminal import Column, terminal_text  # scores and pages print nothing

        sides, heads, rows = self._layout("left", "right")
        columns = [
            Column(head, side, wraps=format_ == "text", is_key=format_ in ("text", "count"))
            for head, side, format_ in zip(heads, sides, self.columns.values(), strict=True)
        ]
        return terminal_text(self.title, columns, rows, self.note, width)


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


def _cell(value: Any, format_: Format) -> str:
    text = _plain(value, format_)
    return quoted(text) if isinstance(value, str) else text


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
