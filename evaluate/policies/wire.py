"""The messages of the policy servers: msgpack, with NumPy arrays as openpi sends them.

An array is a map with four keys of bytes: `__ndarray__` true, `data` its bytes in C order,
`dtype` such as `<f4`, and `shape`. A NumPy scalar is one with `__npgeneric__` true, `data` the
number, and `dtype`. Everything else is plain msgpack.

Servers with other libraries answer in other dialects, which are read but never sent: the same keys
as text, and the keys `nd`, `type` and `shape` of the package msgpack-numpy.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError

_KINDS = "biufSU"
"""Kinds of NumPy data in messages: booleans, numbers, and texts of fixed length."""

_NOTHING_ELSE = (
    "Messages hold maps, lists, texts, bytes, numbers and arrays of these, nothing else."
)

MAX_ITEMS = 1 << 16
"""Most maps and lists in a message together, and most entries in one of them. Actions are an array,
which is one map; an empty map takes one byte of a message and a hundred in memory."""

_DTYPE_LETTERS = 16
"""Longest text of a dtype, such as `<f4`: NumPy parses a list of types from a longer one."""

_NOT_READ = (KeyError, OverflowError, SyntaxError, TypeError, ValueError, msgpack.UnpackException)
"""What msgpack and NumPy raise for invalid bytes."""


def pack(message: Any) -> bytes:
    """Return a message as bytes.

    It may hold maps, lists, texts, bytes, numbers, None, and NumPy arrays and scalars of booleans,
    integers, floats of at most 8 bytes, or texts.
    """
    try:
        return msgpack.packb(message, default=_pack_numpy)
    except FormatError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"a message cannot be sent: {error}", _NOTHING_ELSE) from error


def check_items(data: bytes, forbidden: Callable[[Any], bool] = lambda items: False) -> None:
    """Check that a message is small once it is read, without keeping what it holds.

    The library bounds the length of each map and list; their number multiplies if they are nested.

    Args:
        data: The message.
        forbidden: Whether a message may not hold this map or list.
    """
    count = 0

    def drop(items: Any) -> None:
        nonlocal count
        count += 1
        if count > MAX_ITEMS:
            raise ValueError(f"over {MAX_ITEMS:,} maps and lists")
        if isinstance(items, dict):
            named = _named(items)
            dtype = named.get("type" if "nd" in named else "dtype")
            if dtype is not None and not (isinstance(dtype, str) and len(dtype) <= _DTYPE_LETTERS):
                raise ValueError(f"a dtype {dtype!r:.80}")
        if forbidden(items):
            raise ValueError(f"it may not hold {items!r:.80}")

    limits = {"max_map_len": MAX_ITEMS, "max_array_len": MAX_ITEMS}
    with _reading(data):
        msgpack.unpackb(data, object_hook=drop, list_hook=drop, ext_hook=_drop_extension, **limits)


def unpack(data: bytes) -> Any:
    """Read a message; the inverse of `pack`, with lists for tuples.

    Arrays are read-only views of `data`.
    """
    check_items(data)
    with _reading(data):
        return msgpack.unpackb(data, object_hook=_unpack_numpy, ext_hook=_refuse_extension)


@contextmanager
def _reading(data: bytes) -> Iterator[None]:
    """Turn what invalid bytes raise into one error."""
    try:
        yield
    except FormatError:
        raise
    except _NOT_READ as error:
        reason = str(error) or type(error).__name__
        raise FormatError(f"{len(data)} bytes are not a message: {reason}") from error


def _pack_numpy(value: Any) -> dict[bytes, Any]:
    if not isinstance(value, np.ndarray | np.generic):
        kind = type(value).__name__
        raise FormatError(f"a message cannot hold a {kind}: {value!r:.80}", _NOTHING_ELSE)
    _checked(value.dtype)
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    # A view of the bytes: images are not copied before msgpack does.
    flat = np.ascontiguousarray(value).reshape(-1).view(np.uint8).data
    about = {b"dtype": value.dtype.str, b"shape": value.shape}
    return {b"__ndarray__": True, b"data": flat, **about}


def _named(items: dict[Any, Any]) -> dict[Any, Any]:
    """Return a map with its keys of bytes as text."""
    return {
        key.decode(errors="replace") if isinstance(key, bytes) else key: value
        for key, value in items.items()
    }


def _unpack_numpy(value: dict[Any, Any]) -> Any:
    named = _named(value)
    if "__ndarray__" in named:
        return _array(named.get("data"), named["dtype"], named.get("shape"))
    if "__npgeneric__" in named:
        return _checked(np.dtype(named["dtype"])).type(named["data"])
    if {"nd", "type", "data"} <= named.keys():  # msgpack-numpy
        if named.get("kind") not in (None, "", b""):  # structured types, and pickled objects
            raise ValueError("an array of msgpack-numpy with a kind of its own")
        # It sends a scalar as an array of one value, without a shape.
        array = _array(named["data"], named["type"], named["shape"] if named["nd"] else [1])
        return array if named["nd"] else array[0]
    return value


def _array(data: Any, dtype: Any, shape: Any) -> NDArray[Any]:
    if not isinstance(data, bytes) or not isinstance(shape, list):
        raise TypeError("an array without bytes and shape")
    array: NDArray[Any] = np.ndarray(tuple(shape), _checked(np.dtype(dtype)), buffer=data)
    if array.nbytes != len(data):
        raise ValueError(f"an array of {array.nbytes} bytes with {len(data)} bytes of data")
    return array


def _checked(dtype: np.dtype[Any]) -> np.dtype[Any]:
    if dtype.kind not in _KINDS or dtype.shape or (dtype.kind == "f" and dtype.itemsize > 8):
        raise FormatError(f"a message cannot hold NumPy data of dtype {dtype}", _NOTHING_ELSE)
    return dtype


def _drop_extension(code: int, data: bytes) -> None:
    """Return nothing for an extension: who reads the message decides about them."""


def _refuse_extension(code: int, data: bytes) -> Any:
    raise FormatError(f"a message holds msgpack's extension type {code}", _NOTHING_ELSE)
