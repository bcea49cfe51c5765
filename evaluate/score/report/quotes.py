"""Sentences whose numbers are quoted from tables, so that a sentence and a table never differ."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from string import Formatter
from typing import Any

from robomme_interference_data.viz.tables import Table

SIZE = "size"
"""The format of a quote without sign and unit, as in `{low:size} points below`."""

_SIGNS = "+−"


@dataclass(frozen=True)
class Quote:
    """A number in a sentence, and where it stands in a table.

    Attributes:
        table: Name of the table.
        rows: Places of its rows.
        column: The column of the one row; empty for the number of rows.
        text: The number as the sentence prints it.
    """

    table: str
    rows: tuple[int, ...]
    column: str
    text: str


@dataclass(frozen=True)
class Sentence:
    """A sentence, or a part of one, and the numbers in it, in their order."""

    text: str
    quotes: tuple[Quote, ...] = ()

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True)
class TableRow:
    """A row of a table."""

    table: Table
    place: int

    def __getitem__(self, column: str) -> Any:
        """Return a value, NaN as None."""
        value = self.table.rows[self.place][[*self.table.columns].index(column)]
        return None if isinstance(value, float) and math.isnan(value) else value

    def quote(self, column: str, form: str = "") -> Quote:
        """Return a number as the table shows it; with the form `SIZE`, without sign and unit."""
        texts = self.table.cells(self.table.rows[self.place])
        # A sentence states in words what † stands for.
        text = texts[[*self.table.columns].index(column)].removesuffix("†")
        if form == SIZE:
            text = text.lstrip(_SIGNS).removesuffix("%")
        return Quote(self.table.name, (self.place,), column, text)


def rows_of(table: Table | None, **equal: Any) -> list[TableRow]:
    """Return the rows of a table that have given values; none without the table."""
    if table is None:
        return []
    rows = [TableRow(table, place) for place in range(len(table.rows))]
    return [row for row in rows if all(row[name] == value for name, value in equal.items())]


def number_of(rows: Sequence[TableRow]) -> Quote:
    """Return the number of some rows of one table, of which there is at least one."""
    return Quote(rows[0].table.name, tuple(row.place for row in rows), "", f"{len(rows):,}")


def say(template: str, row: TableRow | None = None, /, **words: str | Quote | Sentence) -> Sentence:
    """Fill a template with words, quotes and parts of sentences.

    A field that is none of the `words` is a column of the row, as in `{rate} of {n} episodes`: a
    number is quoted, text is shown.
    """
    text, quotes = "", list[Quote]()
    for before, name, form, _ in Formatter().parse(template):
        text += before
        if name is None:
            continue
        if name in words:
            word = words[name]
        elif row is not None and row.table.columns[name] == "text":
            word = row[name]
        elif row is not None:
            word = row.quote(name, form or "")
        else:
            raise KeyError(name)
        if isinstance(word, Quote):
            quotes.append(word)
        elif isinstance(word, Sentence):
            quotes += word.quotes
        text += word.text if isinstance(word, Quote) else str(word)
    return Sentence(text, tuple(quotes))


def joined(parts: Sequence[Sentence], separator: str, last: str = "") -> Sentence:
    """Return parts of a sentence as one; `last` is another separator before the last part."""
    text = ""
    for number, part in enumerate(parts):
        if number:
            text += last if last and number == len(parts) - 1 else separator
        text += part.text
    return Sentence(text, tuple(quote for part in parts for quote in part.quotes))
