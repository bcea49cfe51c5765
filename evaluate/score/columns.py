"""Columns of a batch as whole numbers, with the first reason against each bad row."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.evaluate.score.read import Batch

__all__ = ["Codes", "Rows", "distinct"]

Codes = NDArray[np.int64]


class Rows:
    """The columns of a batch as codes, and the first reason against each bad row."""

    def __init__(self, batch: Batch):
        self.batch = batch
        self.reasons: dict[int, str] = {}

    def text(self, name: str, parse: Callable[[Any], int], default: Any = None) -> Codes:
        """Return the code of each row's value, −1 where `parse` refuses it.

        `parse` is asked once for each distinct value. `default` stands for a missing column.
        """
        column = self.batch.columns.get(name)
        if column is None:
            values = [default]
            index: Codes = np.zeros(self.batch.rows, np.int64)
        else:
            if not pa.types.is_dictionary(column.type):
                column = column.dictionary_encode()
            values = [*column.dictionary.to_pylist(), None]
            index = _numbers(column.indices, len(values) - 1)
        codes = np.zeros(len(values), np.int64)
        reasons = {}
        for place in np.flatnonzero(np.bincount(index, minlength=len(values))).tolist():
            try:
                codes[place] = parse(values[place])
            except InterferenceError as error:
                codes[place], reasons[place] = -1, f"{error.message}. {error.hint or ''}".strip()
            except ValueError as error:
                codes[place], reasons[place] = -1, str(error)
        found = codes.take(index)
        if reasons:
            self.refuse(found < 0, lambda row: reasons[int(index[row])])
        return found

    def number(self, name: str, most: int, default: int | None = None) -> Codes:
        """Return whole numbers from 0 to `most`, −1 where there is something else.

        With a default that stands for a missing column and for an empty cell.
        """
        column = self.batch.columns.get(name)
        if column is None:
            return np.full(self.batch.rows, -1 if default is None else default, np.int64)
        if pa.types.is_dictionary(column.type):
            numbers = _whole(column.dictionary)
            column = pc.take(numbers, column.indices)
        elif not pa.types.is_int64(column.type):
            column = _whole(column)
        found = _numbers(column, -1)
        if not column.null_count and len(found) and found.min() >= 0 and found.max() <= most:
            return found
        empty = self.batch.columns[name].is_null().to_numpy(zero_copy_only=False)
        found = np.where((found < 0) | (found > most), -1, found)
        refused = found < 0
        if default is not None:
            found = np.where(empty, default, found)
            refused &= ~empty
        self.refuse(
            refused,
            lambda row: (
                f"{name} {self.shown(name, row)}; expected a whole number from 0"
                + (f" to {most}" if most < 2**31 else "")
            ),
        )
        return found

    def refuse(self, bad: NDArray[np.bool_], reason: Callable[[int], str]) -> None:
        """Note why rows are bad, unless something else is known against them."""
        for row in np.flatnonzero(bad).tolist():
            if row not in self.reasons:
                self.reasons[row] = reason(row)

    def shown(self, name: str, row: int) -> str:
        """Return a value as messages show it."""
        value = self.batch.columns[name][row].as_py()
        return "(empty)" if value is None else repr(value)


def distinct(values: Codes) -> tuple[Codes, Codes]:
    """Return the distinct values, ascending, and the place of each value among them.

    As `np.unique` with `return_inverse`, but quick where equal values stand together.
    """
    begins = np.flatnonzero(np.diff(values, prepend=values[:1] - 1))
    found, place = np.unique(values[begins], return_inverse=True)
    return found, np.repeat(place, np.diff(begins, append=len(values)))


def _numbers(array: Any, null: int) -> Codes:
    """Return an Arrow array of whole numbers as numpy's, with a number for null.

    `fill_null` would import pandas wherever that is installed, which takes seconds.
    """
    if not array.null_count:
        return array.to_numpy().astype(np.int64, copy=False)
    empty = array.is_null().to_numpy(zero_copy_only=False)
    data = np.frombuffer(array.buffers()[1], array.type.to_pandas_dtype())
    return np.where(empty, null, data[array.offset : array.offset + len(array)])


def _whole(values: Any) -> Any:
    """Read values as int64, null where one is no whole number."""
    try:
        return values.cast(pa.int64())
    except pa.ArrowInvalid:
        return pa.array([_whole_number(value) for value in values.to_pylist()], pa.int64())


def _whole_number(value: Any) -> int | None:
    try:
        number = int(str(value))
    except ValueError:
        return None
    return number if 0 <= number < 2**62 else None
