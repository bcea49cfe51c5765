"""The messages of the policy servers: msgpack, with NumPy arrays as openpi sends them.

An array is a map with four keys of bytes: `__ndarray__` true, `data` its bytes in C order,
`dtype` such as `<f4`, and `shape`. A NumPy scalar is one with `__npgeneric__` true, `data` the
number, and `dtype`. Everything else is plain msgpack.
"""

import math
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import WireError

__all__ = ["pack", "unpack"]

_SCALARS: dict[str, Any] = {"b": bool, "i": int, "u": int, "f": (int, float)}
_KINDS = "".join(_SCALARS) + "SU"  # the last two, texts of fixed length, in arrays only
_NOTHING_ELSE = (
    "Messages hold maps, lists, texts, bytes, numbers and arrays of these, nothing else."
)


def pack(message: Any) -> bytes:
    """Return a message as bytes.

    Args:
        message: Maps, lists, texts, bytes, numbers, None, and NumPy arrays and scalars of
            booleans, integers, floats of at most 8 bytes, or texts.

    Raises:
        WireError: It holds something else, such as an array of objects.
    """
    try:
        return msgpack.packb(message, default=_pack_numpy)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(error, WireError):
            raise
        raise WireError(f"a message cannot be sent: {error}", _NOTHING_ELSE) from error


def unpack(data: bytes) -> Any:
    """Read a message; the inverse of `pack`, with lists for tuples.

    Arrays are read-only views of `data`.

    Raises:
        WireError: The bytes are not one whole message, or an array in it is not what it says.
    """
    try:
        return msgpack.unpackb(data, object_hook=_unpack_numpy, ext_hook=_refuse_extension)
    except (TypeError, ValueError, OverflowError, msgpack.UnpackException) as error:
        if isinstance(error, WireError):
            raise
        reason = str(error) or type(error).__name__
        raise WireError(f"{len(data)} bytes are not a message: {reason}") from error


def _pack_numpy(value: Any) -> dict[bytes, Any]:
    if not isinstance(value, np.ndarray | np.generic):
        kind = type(value).__name__
        raise WireError(f"a message cannot hold a {kind}: {value!r:.80}", _NOTHING_ELSE)
    _check_dtype(value.dtype)
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    # A view of the bytes: images are not copied before msgpack does.
    flat = np.ascontiguousarray(value).reshape(-1).view(np.uint8).data
    return {
        b"__ndarray__": True,
        b"data": flat,
        b"dtype": value.dtype.str,
        b"shape": value.shape,
    }


def _unpack_numpy(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" in value:
        return _array(value.get(b"data"), _dtype(value), value.get(b"shape"))
    if b"__npgeneric__" in value:
        return _scalar(value.get(b"data"), _dtype(value))
    return value


def _dtype(value: dict[Any, Any]) -> np.dtype[Any]:
    text = value.get(b"dtype")
    if not isinstance(text, str):
        raise WireError(f"an array has the dtype {text!r}; expected a text such as '<f4'")
    try:
        dtype = np.dtype(text)
    except (TypeError, ValueError, SyntaxError) as error:
        raise WireError(f"an array has the unknown dtype {text!r}") from error
    _check_dtype(dtype)
    return dtype


def _check_dtype(dtype: np.dtype[Any]) -> None:
    if dtype.kind not in _KINDS or dtype.shape or (dtype.kind == "f" and dtype.itemsize > 8):
        raise WireError(f"a message cannot hold NumPy data of dtype {dtype}", _NOTHING_ELSE)


def _array(data: Any, dtype: np.dtype[Any], shape: Any) -> NDArray[Any]:
    if not isinstance(data, bytes):
        raise WireError(f"an array has data of type {type(data).__name__}; expected bytes")
    if not isinstance(shape, list) or not all(type(n) is int and n >= 0 for n in shape):
        raise WireError(f"an array has the shape {shape!r}; expected a list of lengths")
    expected = math.prod(shape) * dtype.itemsize
    if len(data) != expected:
        raise WireError(
            f"an array of shape {tuple(shape)} and dtype {dtype} has {len(data)} bytes; "
            f"expected {expected}"
        )
    return np.ndarray(tuple(shape), dtype, buffer=data)


def _scalar(data: Any, dtype: np.dtype[Any]) -> Any:
    expected = _SCALARS.get(dtype.kind, ())
    if not isinstance(data, expected) or (type(data) is bool and dtype.kind != "b"):
        raise WireError(f"a NumPy number of dtype {dtype} has the value {data!r}")
    return dtype.type(data)


def _refuse_extension(code: int, data: bytes) -> Any:
    raise WireError(f"a message holds msgpack's extension type {code}", _NOTHING_ELSE)
