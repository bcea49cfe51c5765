"""How shifts are written, and what is none."""

from typing import Any

import pytest

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.shifts import SHIFTS, Shift, parse_shift


def test_shifts_are_written_as_they_are_read() -> None:
    assert parse_shift("light:2") == Shift("light", 2)
    assert parse_shift("none") is None
    assert list(map(str, SHIFTS)) == [
        *("light:1", "light:2", "light:3", "camera:1", "camera:2", "camera:3"),
        *("clutter:1", "clutter:2", "clutter:3"),
    ]
    assert tuple(parse_shift(str(shift)) for shift in SHIFTS) == SHIFTS


@pytest.mark.parametrize(
    "text", ["", "light", "light:0", "light:4", "Light:2", "fog:1", "light:2 ", None]
)
def test_invalid_shifts(text: Any) -> None:
    with pytest.raises(InvalidOptionError, match="strength from 1 to 3, such as light:2"):
        parse_shift(text)
