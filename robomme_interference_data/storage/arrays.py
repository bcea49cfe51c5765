"""Arrays in `.npy` files, and SHA-256 over decoded data, which defines bit-exact here.

The digest of a *feature* over a span of frames is the SHA-256 of its values in order, without any
header: images as `(T, H, W, 3) uint8` RGB, vectors as `(T, D) float32` little-endian, C order. The
digest of a *span* is the SHA-256 of the canonical JSON of its feature digests by name, without that
of the actions. Both can be recomputed from decoded arrays with hashlib alone.
"""

import hashlib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION
from robomme_interference_data.errors import FormatError

from .text import canonical_json, check_not_pointer

_FILE = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '([<|][a-z]\d)', 'fortran_order': False, "
    rb"'shape': \((\d{1,12}(?:, \d{1,12})*),?\), \} *\n",
    re.DOTALL,
)
"""The header. numpy parses it as Python, which raises any error or warning if it is damaged."""

EMPTY_SHA256 = hashlib.sha256().hexdigest()
"""The digest of a feature without any values, such as the states of a robot that records none."""

_MAX_HEADER_BYTES = 1024  # `np.save` writes 128 for the arrays of this package


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array as `np.save` does, in C order; unlike it, keep the system's error number."""
    with path.open("wb") as file:
        array = np.asarray(array, order="C")
        np.lib.format.write_array_header_1_0(  # type: ignore[no-untyped-call]
            file,
            np.lib.format.header_data_from_array_1_0(array),  # type: ignore[no-untyped-call]
        )
        file.write(array.data)


def read_array(path: Path, dtype: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Read an array that `write_array` wrote.

    Type and shape must be the given ones (-1 for any length), and fit the file's size, before
    anything is allocated. `np.load` would also open archives.
    """
    expected = f"{np.dtype(dtype)} of shape {shape}"
    check_not_pointer(path)
    with path.open("rb") as file:
        header = _FILE.match(start := file.read(_MAX_HEADER_BYTES))
    if header is None or int.from_bytes(start[8:10], "little") != header.end() - 10:
        raise FormatError.damaged(path, f"not an array: {start[:99]!r}; expected {expected}")
    kind, sides = header[1].decode(), tuple(map(int, header[2].split(b", ")))
    fits = len(sides) == len(shape) and all(
        length in (-1, side) for length, side in zip(shape, sides, strict=True)
    )
    if not fits or kind != np.dtype(dtype).str:
        raise FormatError.damaged(path, f"holds {kind} of shape {sides}; expected {expected}")
    size = path.stat().st_size
    if header.end() + math.prod(sides) * np.dtype(dtype).itemsize != size:
        raise FormatError.damaged(path, f"{size} bytes do not fit an array of shape {sides}")
    return np.fromfile(path, dtype, offset=header.end()).reshape(sides)


def combine(digests: Mapping[str, str]) -> str:
    """Return the digest of a span from the digests of its features, by feature name.

    Actions are excluded: a buffer does not hold them, and a dataset may lose them as it grows.
    """
    included = {name: digest for name, digest in digests.items() if name != ACTION}
    return hashlib.sha256(canonical_json(included).encode()).hexdigest()


class FeatureDigests:
    """Running digests of several features."""

    def __init__(self) -> None:
        self._running: dict[str, Any] = {}

    def update(self, feature: str, values: NDArray[Any]) -> None:
        """Add the next value, or several stacked along a first axis, of a feature."""
        # The same bytes on machines of either byte order.
        if values.dtype == np.float32:
            values = values.astype("<f4", copy=False)
        elif values.dtype != np.uint8:
            raise TypeError(f"expected uint8 or float32 values to digest, not {values.dtype}")
        running = self._running.setdefault(feature, hashlib.sha256())
        running.update(np.ascontiguousarray(values).data)

    def current(self) -> dict[str, str]:
        """Return the digests of the values so far, by feature name."""
        return {name: running.copy().hexdigest() for name, running in self._running.items()}


def digest_spans(
    spans: Sequence[tuple[int, int]],
    features: Iterable[tuple[str, Iterable[NDArray[Any]]]],
    first: int = 0,
) -> list[dict[str, str]]:
    """Return the digests by feature of spans `(start, stop)` of an episode, which may overlap.

    Args:
        spans: The spans.
        features: Each feature and its values, one after the other.
        first: The frame of the first value.
    """
    running = [FeatureDigests() for _ in spans]
    for name, values in features:
        for index, value in enumerate(values, first):
            for (start, stop), digests in zip(spans, running, strict=True):
                if start <= index < stop:
                    digests.update(name, value)
    return [digests.current() for digests in running]
