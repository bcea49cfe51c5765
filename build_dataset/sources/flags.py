"""Truth values as recordings have them: booleans, 0 and 1 in any type, and text. Pure rules."""

from collections.abc import Iterable
from typing import Any

import numpy as np

_WORDS = {"true": True, "false": False, "1": True, "0": False}


def parse_flag(value: Any) -> bool:
    """Return a value as true or false.

    Raises:
        ValueError: It is neither, such as `maybe`, 2, NaN or nothing.
    """
    if isinstance(value, np.ndarray | np.generic) and value.size == 1:
        value = value.reshape(()).item()
    if isinstance(value, bytes):
        value = value.decode(errors="replace")
    known = None
    if isinstance(value, str):
        known = _WORDS.get(value.strip().lower())
    elif isinstance(value, bool | int | float) and value in (0, 1):
        known = value == 1
    if known is None:
        raise ValueError(f"{value!r}; expected true or false, or 1 or 0")
    return known


def parse_flags(values: Iterable[Any]) -> list[bool]:
    """Return a value for each frame as true or false.

    Raises:
        ValueError: One is neither; the message names its frame.
    """
    flags = []
    for frame, value in enumerate(values):
        try:
            flags.append(parse_flag(value))
        except ValueError as error:
            raise ValueError(f"{error} (frame {frame})") from None
    return flags
