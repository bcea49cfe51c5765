"""Columns of a batch as whole numbers, with the first reason against each bad row."""

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.evaluate.score.batches import Batch

__all__ = ["Codes", "Rows", "distinct", "flags", "whole_number"]

Codes = NDArray[np.int64]


class Rows:
    """The columns of a batch as codes, and the first reason against each bad row."""

    def __init__(self, batch: Batch):
        self.batch = batch
        self.reasons: dict[int, str] = {}

    def code(self, name: str, parse: Callable[[Any], int], default: Any = None) -> Codes:
        """Return the code of each row's value, −1 where `parse` refuses it.

        `parse` is asked once for each distinct value, None for an empty cell. `default` stands
        for a missing column.
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
        if reasons:
            refused = np.zeros(len(values), bool)
            refused[list(reasons)] = True
            self.refuse(refused.take(index), lambda row: reasons[int(index[row])])
        return codes.take(index)

    def number(
        self, name: str, most: int, absent: int | None = None, empty: int | None = None
    ) -> Codes:
        """Return whole numbers from 0 to `most`, −1 where there is something else.

        Args:
            name: The column.
            most: The greatest number that may be, itself included.
            absent: What stands for a missing column; None for −1.
            empty: What stands for an empty cell; with None that row is bad.
        """
        column = self.batch.columns.get(name)
        if column is None:
            return np.full(self.batch.rows, -1 if absent is None else absent, np.int64)
        if pa.types.is_integer(column.type) and not column.null_count:
            found = _numbers(column, -1)
            if not len(found) or (found.min() >= 0 and found.max() <= most):
                return found

        def parse(value: Any) -> int:
            missing = value is None or (isinstance(value, float) and math.isnan(value))
            if missing and empty is not None:
                return empty
            number = whole_number(value)
            if number is None or number > most:
                raise ValueError(
                    f"{name} {_shown(value)}; expected a whole number from 0"
                    + (f" to {most}" if most < 2**31 else "")
                )
            return number

        return self.code(name, parse)

    def refuse(self, bad: NDArray[np.bool_], reason: Callable[[int], str]) -> None:
        """Note why rows are bad, unless something else is known against them."""
        for row in np.flatnonzero(bad).tolist():
            if row not in self.reasons:
                self.reasons[row] = reason(row)

    def shown(self, name: str, row: int) -> str:
        """Return a value as messages show it."""
        return _shown(self.batch.columns[name][row].as_py())


def distinct(values: Codes) -> tuple[Codes, Codes]:
    """Return the distinct values, ascending, and the place of each value among them.

    As `np.unique` with `return_inverse`, but quick where equal values stand together.
    """
    begins = np.flatnonzero(np.diff(values, prepend=values[:1] - 1))
    found, place = np.unique(values[begins], return_inverse=True)
    return found, np.repeat(place, np.diff(begins, append=len(values)))


def flags(array: Any) -> NDArray[np.bool_]:
    """Return an Arrow array of booleans, without null, as numpy's, `(N,) bool`."""
    return _numbers(array.cast(pa.uint8()), 0).astype(bool)


def whole_number(value: Any) -> int | None:
    """Return a number of a column as an integer, None where it is no whole number from 0.

    Programs save whole numbers beside missing ones as floats, so `630000.0` is one.
    """
    if isinstance(value, str):
        match = _WHOLE.fullmatch(value)
        return int(match[1]) if match else None
    if isinstance(value, bool) or value is None or value < 0 or value % 1 != 0:
        return None  # also NaN and infinity, whose remainder is NaN
    return int(value)


_WHOLE = re.compile(r"([0-9]{1,20})(?:\.0+)?")


def _shown(value: Any) -> str:
    return "(empty)" if value is None else repr(value)


def _numbers(array: Any, null: int) -> Codes:
    """Return an Arrow array of integers as numpy's, with a number for null.

    From the buffer itself: `to_numpy` and `fill_null` import pandas wherever that is installed,
    which takes seconds, and loses a Ctrl-C that comes meanwhile.
    """
    if not len(array):
        return np.zeros(0, np.int64)
    data = np.frombuffer(array.buffers()[1], array.type.to_pandas_dtype())
    data = data[array.offset : array.offset + len(array)]
    if array.null_count:
        data = np.where(flags(array.is_null()), null, data)
    return data.astype(np.int64, copy=False)
