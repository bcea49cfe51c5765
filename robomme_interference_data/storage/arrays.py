"""Arrays in `.npy` files, as `np.save` writes them: never pickled, and exactly as expected."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError

_FILE = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '([<|][a-z]\d)', 'fortran_order': False, "
    rb"'shape': \((\d{1,12}(?:, \d{1,12})*),?\), \} *\n",
    re.DOTALL,
)
"""What a file begins with. numpy reads a header as Python, and of damaged ones ends in all kinds of
errors and warnings."""

_HEADER_BYTES = 1024
"""Bytes in which the header ends, at most: `np.save` writes 128 for what this package stores."""


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array as `np.save` does, in C order.

    From `np.save` itself, a full disk is an error without a number.
    """
    with path.open("wb") as file:
        array = np.asarray(array, order="C")
        np.lib.format.write_array_header_1_0(  # type: ignore[no-untyped-call]
            file,
            np.lib.format.header_data_from_array_1_0(array),  # type: ignore[no-untyped-call]
        )
        file.write(array.data)


def map_array(path: Path, dtype: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return an array that `write_array` wrote as a read-only memory map.

    Nothing is allocated before type, shape and the file's size agree. Not by `np.load`, which also
    opens archives.

    Args:
        path: The file.
        dtype: Type that it must have.
        shape: Shape that it must have; -1 for a side of any length.
    """
    expected = f"{np.dtype(dtype)} of shape {shape}"
    with path.open("rb") as file:
        header = _FILE.match(start := file.read(_HEADER_BYTES))
    if header is None or int.from_bytes(start[8:10], "little") != header.end() - 10:
        raise FormatError.damaged(path, f"no array: {start[:99]!r}; expected {expected}")
    kind, sides = header[1].decode(), tuple(map(int, header[2].split(b", ")))
    fits = len(sides) == len(shape) and all(
        wanted in (-1, side) for wanted, side in zip(shape, sides, strict=True)
    )
    if not fits or kind != np.dtype(dtype).str:
        raise FormatError.damaged(path, f"holds {kind} of shape {sides}; expected {expected}")
    size, whole = math.prod(sides) * np.dtype(dtype).itemsize, path.stat().st_size
    if header.end() + size != whole:
        raise FormatError.damaged(path, f"{whole} bytes, of an array of shape {sides}")
    return np.memmap(path, dtype, "r", header.end(), sides)


def read_array(path: Path, dtype: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Read an array into memory; see `map_array`."""
    return np.array(map_array(path, dtype, shape))
