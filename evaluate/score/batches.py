"""Stream the rows of CSV and parquet files in batches of bounded size."""

import codecs
import csv
import io
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq

from robomme_interference_data.errors import FormatError

__all__ = ["Batch", "csv_batches", "csv_schema", "parquet_batches"]

_BLOCK = 16 * 2**20  # bytes of CSV at a time
_BATCH = 2**18  # rows of parquet at a time


@dataclass
class Batch:
    """Consecutive rows of one file.

    Attributes:
        columns: Name to values, dictionary-encoded text or plain numbers, all equally long.
        rows: How many rows.
        first: Number of the first row if all before it are rows; 1 is the header of a CSV, or
            the first row of a parquet file.
        malformed: Line and reason of what was found since the last batch and is no row.
        skipped: Number and reason of all such so far, in order.
        line_of: From such a number to the line of the file.
    """

    columns: dict[str, Any]
    rows: int
    first: int
    malformed: Sequence[tuple[int, str]] = ()
    skipped: Sequence[tuple[int, str]] = ()
    line_of: Callable[[int], int] = int

    def line(self, row: int) -> int:
        """Return the line on which a row begins; the row of a parquet file, from 1."""
        number = self.first + row
        for skipped, _ in self.skipped:
            number += skipped <= number
        return self.line_of(number)


class _Lines:
    """Where the rows of a CSV begin, read only if somebody asks: quoted text may hold lines."""

    def __init__(self, path: Path):
        self._path = path

    def __call__(self, number: int) -> int:
        """Return the line on which a row begins; the header is row 1."""
        place = bisect_left(self._longer, (number, 0)) - 1
        return number + (self._longer[place][1] if place >= 0 else 0)

    @cached_property
    def _longer(self) -> list[tuple[int, int]]:
        """Rows of several lines, each with the lines that it and those before have too many."""
        with self._path.open("rb") as file:
            if not any(b'"' in block for block in iter(partial(file.read, _BLOCK), b"")):
                return []
        longer: list[tuple[int, int]] = []
        with (
            self._path.open(encoding="utf-8", errors="replace", newline="") as text,
            suppress(csv.Error),
        ):
            # A cell longer than the csv module reads ends it: later lines are then uncertain.
            reader = csv.reader(text)
            for number, _ in enumerate(reader, 1):
                if reader.line_num - number > (longer[-1][1] if longer else 0):
                    longer.append((number, reader.line_num - number))
        return longer


def parquet_batches(path: Path, columns: Mapping[str, str]) -> Iterator[Batch]:
    """Yield the rows of a parquet file; `columns` has our names, each to the file's."""
    schema = pq.read_schema(path)
    texts = [name for name in columns.values() if pa.types.is_string(schema.field(name).type)]
    first = 1
    with pq.ParquetFile(path, read_dictionary=texts) as file:
        for batch in file.iter_batches(_BATCH, columns=list(columns.values())):
            found = {name: batch.column(there) for name, there in columns.items()}
            yield Batch(found, len(batch), first)
            first += len(batch)


def csv_schema(path: Path) -> Any:
    """Return the columns of a CSV, as Arrow guesses them."""
    with _open_csv(path, None, []) as reader:
        return reader.schema


def csv_batches(path: Path, columns: Mapping[str, str]) -> Iterator[Batch]:
    """Yield the rows of a CSV, all as text; `columns` has our names, each to the file's."""
    skipped: list[tuple[int, str]] = []
    first, seen, line_of = 2, 0, _Lines(path)

    def malformed() -> list[tuple[int, str]]:
        return [(line_of(number), reason) for number, reason in skipped[seen:]]

    with _open_csv(path, list(columns.values()), skipped) as reader:
        for batch in reader:
            found = {name: batch.column(there) for name, there in columns.items()}
            # pyarrow reads ahead: some of them may stand after these rows.
            yield Batch(found, len(batch), first, malformed(), skipped, line_of)
            first += len(batch)
            seen = len(skipped)
    if skipped[seen:]:
        yield Batch({}, 0, first, malformed())


class _Text(io.RawIOBase):
    """Reads a file, and refuses what is no text: pyarrow would show a traceback of its own."""

    def __init__(self, path: Path):
        self._path = path
        self._file = path.open("rb")
        self._decoder = codecs.getincrementaldecoder("utf-8")()
        self._begun = 0  # bytes before those that the decoder still holds

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size)
        held = len(self._decoder.getstate()[0])
        try:
            self._decoder.decode(data, final=not data)
        except UnicodeDecodeError as error:
            raise FormatError(
                f"{self._path} cannot be read: byte {self._begun + error.start} is not UTF-8 text",
                "Expected a CSV or parquet file of rollout rows (docs/score.md).",
            ) from None
        self._begun += held + len(data) - len(self._decoder.getstate()[0])
        return data

    def close(self) -> None:
        self._file.close()
        super().close()


def _open_csv(path: Path, columns: list[str] | None, skipped: list[tuple[int, str]]) -> Any:
    def note(row: Any) -> str:
        expected, actual = row.expected_columns, row.actual_columns
        skipped.append((row.number, f"the line has {actual} fields; expected {expected}"))
        return "skip"

    # Everything is text at first: what a number should be is judged row by row. Threads would
    # not say on which line a broken one stands.
    text = pa.dictionary(pa.int32(), pa.string())
    return pa_csv.open_csv(
        _Text(path),
        read_options=pa_csv.ReadOptions(use_threads=False, block_size=_BLOCK),
        parse_options=pa_csv.ParseOptions(
            ignore_empty_lines=False, newlines_in_values=True, invalid_row_handler=note
        ),
        convert_options=pa_csv.ConvertOptions(
            column_types=dict.fromkeys(columns or [], text),
            include_columns=columns or [],
            strings_can_be_null=True,
            quoted_strings_can_be_null=True,
            null_values=[""],
        ),
    )
