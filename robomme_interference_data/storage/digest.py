"""SHA-256 over decoded data: what bit-exact means here, and how it is written down.

The digest of a *feature* over a span of frames is the SHA-256 of its values in order, without any
header: images as `(T, H, W, 3) uint8` RGB, vectors as `(T, D) float32` little-endian, C order. The
digest of a *span* is the SHA-256 of the canonical JSON of its feature digests by name, without that
of the actions. So any hashlib can recompute both from decoded arrays.
"""

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION

from .files import canonical_json


def combine(digests: Mapping[str, str]) -> str:
    """Return the digest of a span from the digests of its features, by feature name.

    Actions are left out: a buffer does not show them, and a dataset that grows may lose them.
    """
    shown = {name: digest for name, digest in digests.items() if name != ACTION}
    return hashlib.sha256(canonical_json(shown).encode()).hexdigest()


class FeatureDigests:
    """Digests of several features, computed while frames pass by."""

    def __init__(self) -> None:
        self._running: dict[str, Any] = {}

    def update(self, feature: str, values: NDArray[Any]) -> None:
        """Add the next value, or several stacked along a first axis, of a feature."""
        if values.dtype == np.float32:
            values = values.astype("<f4", copy=False)
        elif values.dtype != np.uint8:
            raise TypeError(f"digests are over uint8 or float32 values, not {values.dtype}")
        running = self._running.setdefault(feature, hashlib.sha256())
        running.update(np.ascontiguousarray(values).data)

    def current(self) -> dict[str, str]:
        """Return the digests of all that came so far, by feature name; more may follow."""
        return {name: running.copy().hexdigest() for name, running in self._running.items()}


class SpanDigester:
    """Digests of spans of an episode, computed while its frames pass by.

    Args:
        spans: First frame, and the one after the last; they may overlap.
    """

    def __init__(self, spans: Iterable[tuple[int, int]]):
        self._spans = [(start, stop, FeatureDigests()) for start, stop in spans]

    def update(self, feature: str, index: int, value: NDArray[Any]) -> None:
        """Add a feature's value at a frame; each feature's come in order."""
        for start, stop, running in self._spans:
            if start <= index < stop:
                running.update(feature, value)

    def digests(self) -> list[dict[str, str]]:
        """Return the digests of each span, by feature."""
        return [running.current() for _, _, running in self._spans]
