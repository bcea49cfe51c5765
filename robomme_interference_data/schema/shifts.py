"""Shifts: how the live scene may differ from the lesson's."""

import re
from dataclasses import dataclass

from robomme_interference_data.errors import InvalidOptionError

KINDS = ("light", "camera", "clutter", "colors")
"""Changes of: color and brightness of the lamps; camera poses; unused objects nearby; colors of
the table and of objects that no goal names by color."""

STRENGTHS = (1, 2, 3)
"""From weak to strong."""

NO_SHIFT = "none"
"""No shift: the live scene looks like the lesson's."""

SHIFT_HELP = (
    "none, or how the live scene differs from the lesson's (tabletop): light, camera, clutter or "
    "colors, and a strength from 1 to 3, such as light:2."
)
"""Help of the option of every command."""

_SHIFT = re.compile(f"({'|'.join(KINDS)}):([{''.join(map(str, STRENGTHS))}])")


@dataclass(frozen=True)
class Shift:
    """A change of the live scene after the lesson, such as `light:2`; made by `parse_shift`.

    Attributes:
        kind: One of `KINDS`.
        strength: One of `STRENGTHS`.
    """

    kind: str
    strength: int

    def __str__(self) -> str:
        return f"{self.kind}:{self.strength}"


SHIFTS = tuple(Shift(kind, strength) for kind in KINDS for strength in STRENGTHS)
"""All shifts, in the order of a dataset's frames."""


def parse_shift(text: str) -> Shift | None:
    """Read a shift; None for `none`."""
    if text == NO_SHIFT:
        return None
    match = _SHIFT.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise InvalidOptionError.expected(
            "shift",
            text,
            f"{NO_SHIFT}, or {', '.join(KINDS)} with a strength from {STRENGTHS[0]} to "
            f"{STRENGTHS[-1]}, such as light:2",
        )
    return Shift(match[1], int(match[2]))
