"""Files that are damaged bit by bit."""

import random
from collections.abc import Iterator
from pathlib import Path


def flipped_bits(path: Path, count: int) -> Iterator[None]:
    """Flip one bit of a file after the other, spread over it; in the end all is as before."""
    data, bits = path.read_bytes(), random.Random(path.name)
    try:
        for number in range(count):
            place = number * (len(data) - 1) // max(1, count - 1)
            flipped = bytearray(data)
            flipped[place] ^= 1 << bits.randrange(8)
            path.write_bytes(flipped)
            yield
    finally:
        path.write_bytes(data)
