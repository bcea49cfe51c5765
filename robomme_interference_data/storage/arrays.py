"""Arrays in `.npy` files, as `np.save` writes them: never pickled, and exactly as expected."""

from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError

_DAMAGED = (ValueError, TypeError, OverflowError, SyntaxError, TokenError)
"""What numpy raises for a damaged header, which it reads as a Python literal of at most 10,000
characters."""


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
    try:
        array = np.lib.format.open_memmap(path, mode="r")  # type: ignore[no-untyped-call]
    except (*_DAMAGED, MemoryError, RecursionError) as error:
        raise FormatError.damaged(path, f"no array: {error}; expected {expected}") from None
    fits = array.ndim == len(shape) and all(
        wanted in (-1, side) for wanted, side in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype != dtype or not array.flags.c_contiguous:
        what = f"holds {array.dtype} of shape {array.shape}; expected {expected} in C order"
        raise FormatError.damaged(path, what)
    if array.offset + array.nbytes != path.stat().st_size:
        raise FormatError.damaged(path, f"longer than an array of shape {array.shape}")
    return array  # type: ignore[no-any-return]


def read_array(path: Path, dtype: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Read an array into memory; see `map_array`."""
    return np.array(map_array(path, dtype, shape))
