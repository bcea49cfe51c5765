"""Arrays in `.npy` files, as `np.save` writes them: of a few kinds, and never pickled."""

import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError

_START = b"\x93NUMPY\x01\x00"
_LONGEST_HEADER = 1024
"""Bytes of a header, at most: `np.save` writes 118 for what this package stores."""

_HEADER = re.compile(
    rb"\{'descr': '([<|][a-z]\d)', 'fortran_order': False, "
    rb"'shape': \((\d{1,12}(?:, \d{1,12})*),?\), \} *\n"
)


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array as `np.save` does, in C order.

    Raises:
        OSError: As the system says it; from `np.save`, a full disk is an error without a number.
    """
    with path.open("wb") as file:
        array = np.asarray(array, order="C")
        np.lib.format.write_array_header_1_0(  # type: ignore[no-untyped-call]
            file,
            np.lib.format.header_data_from_array_1_0(array),  # type: ignore[no-untyped-call]
        )
        file.write(array.data)


def read_array(path: Path, dtype: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Read an array that `write_array` wrote.

    Nothing is allocated before type, shape and the file's size agree. `np.load` is left aside: it
    also opens archives, and reads a header as Python.

    Args:
        path: The file.
        dtype: Type that it must have.
        shape: Shape that it must have; -1 for a side of any length.

    Raises:
        FormatError: It holds something else.
    """
    expected = f"{np.dtype(dtype)} of shape {shape}"
    with path.open("rb") as file:
        start = file.read(len(_START) + 2)
        length = int.from_bytes(start[len(_START) :], "little")
        if not start.startswith(_START) or length > _LONGEST_HEADER:
            raise FormatError.damaged(path, f"no array; expected {expected}")
        found = _HEADER.fullmatch(header := file.read(length))
        if found is None:
            what = f"its header is {header[:80]!r}; expected {expected}"
            raise FormatError.damaged(path, what)
        kind, sides = found[1].decode(), tuple(map(int, found[2].split(b", ")))
        fits = len(sides) == len(shape) and all(
            wanted in (-1, side) for wanted, side in zip(shape, sides, strict=True)
        )
        if not fits or kind != np.dtype(dtype).str:
            raise FormatError.damaged(path, f"holds {kind} of shape {sides}; expected {expected}")
        count, there = math.prod(sides), os.fstat(file.fileno()).st_size - file.tell()
        if count * np.dtype(dtype).itemsize != there:
            what = f"its header tells shape {sides}, and {there} bytes follow"
            raise FormatError.damaged(path, what)
        return np.fromfile(file, dtype, count).reshape(sides)
