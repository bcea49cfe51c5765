"""Stream the rows of CSV and parquet files in batches of bounded size."""

import codecs
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
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
        first: Line of the first row if all lines before are rows; 1 is the header of a CSV, or
            the first row of a parquet file.
        malformed: Line and reason of the lines found since the last batch that are no rows.
        skipped: All such lines so far, in order.
    """

    columns: dict[str, Any]
    rows: int
    first: int
    malformed: Sequence[tuple[int, str]] = ()
    skipped: Sequence[tuple[int, str]] = ()

    def line(self, row: int) -> int:
        """Return the line on which a row stands; the row of a parquet file, from 1."""
        line = self.first + row
        for skipped, _ in self.skipped:
            line += skipped <= line
        return line


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
    first, seen = 2, 0
    with _open_csv(path, list(columns.values()), skipped) as reader:
        for batch in reader:
            found = {name: batch.column(there) for name, there in columns.items()}
            # pyarrow reads ahead: some of them may stand after these rows.
            yield Batch(found, len(batch), first, skipped[seen:], skipped)
            first += len(batch)
            seen = len(skipped)
    if skipped[seen:]:
        yield Batch({}, 0, first, skipped[seen:], skipped)


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
        parse_options=pa_csv.ParseOptions(ignore_empty_lines=False, invalid_row_handler=note),
        convert_options=pa_csv.ConvertOptions(
            column_types=dict.fromkeys(columns or [], text),
            include_columns=columns or [],
            strings_can_be_null=True,
            quoted_strings_can_be_null=True,
            null_values=[""],
        ),
    )
