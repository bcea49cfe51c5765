"""Draws that follow from a key, the same on every machine."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real

import numpy as np

from robomme_interference_data.errors import InvalidOptionError


@dataclass(frozen=True)
class Weights:
    """Names with the probabilities with which they are drawn."""

    names: tuple[str, ...]
    cumulative: tuple[float, ...]

    @classmethod
    def parse(cls, option: str, given: Mapping[str, float] | Sequence[str] | str) -> "Weights":
        """Read weights by name, or names with equal weights."""
        if isinstance(given, str):
            given = (given,)
        weights = dict(given) if isinstance(given, Mapping) else dict.fromkeys(given, 1.0)
        numbers = [weight for weight in weights.values() if isinstance(weight, Real)]
        if len(numbers) < len(weights) or not all(0 < weight < math.inf for weight in numbers):
            expected = "a positive weight for each name, such as {'k0': 1, 'k7': 2}"
            raise InvalidOptionError.expected(option, given, expected)
        if not weights:
            raise InvalidOptionError.expected(option, given, "at least one name")
        sums = np.cumsum(numbers) / sum(numbers)
        return cls(tuple(weights), tuple(sums.tolist()))

    def draw(self, *key: int | str) -> str:
        """Return the name that a key draws, the same on every machine."""
        if len(self.names) == 1:
            return self.names[0]
        # 53 bits, as many as a float holds exactly: evenly from 0 to below 1.
        lot = (number_from(*key) >> 11) / 2**53
        numbers = (n for n, stop in enumerate(self.cumulative) if lot < stop)
        # Rounding may leave the last sum just below 1.
        return self.names[next(numbers, len(self.names) - 1)]


def number_from(*key: int | str) -> int:
    """Return an integer of 64 bits that follows from a key, evenly distributed."""
    # Python's own `hash` of a text differs between processes.
    text = "\n".join(map(str, key))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest())
