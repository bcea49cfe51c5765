"""Subgoals: what a policy is to do next, in words, and where in the front image: pure."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from robomme_interference_data.errors import InvalidOptionError

POINT = "<point>"
"""What stands for each of its points in a subgoal's text."""

Pixel = tuple[int, int]
"""A point of an image: row and column, (y, x), from 0."""

_NAMED_AT = re.compile(rf"\s*(?:\bat\s+)?{POINT}")


@dataclass(frozen=True)
class Subgoal:
    """What to do next.

    Attributes:
        text: In words; each thing's place is written `<point>`, as in `pick up the cube at
            <point>`.
        points: Where these places are in the front image, (y, x) in pixels, in order.
    """

    text: str
    points: tuple[Pixel, ...] = ()

    def __post_init__(self) -> None:
        if self.text.count(POINT) != len(self.points) or not self.simple:
            raise InvalidOptionError.expected(
                f"subgoal {self.text!r}: its points",
                list(self.points),
                f"words, and as many points as the text has {POINT}",
            )

    @property
    def simple(self) -> str:
        """The text without places: what released servers take as `simple_subgoal`."""
        return without_points(self.text)

    @property
    def grounded(self) -> str:
        """The text with places as `<y, x>`: what released servers take as `grounded_subgoal`."""
        return write_points(self.text, [f"<{y}, {x}>" for y, x in self.points])


def without_points(text: str) -> str:
    """Return a subgoal's text without places."""
    return _NAMED_AT.sub("", text).strip()


def write_points(text: str, written: Sequence[str]) -> str:
    """Return a subgoal's text with each `<point>` as it is to be written, in order."""
    first, *rest = text.split(POINT)
    return first + "".join(point + words for point, words in zip(written, rest, strict=True))


def read_points(text: str, pattern: "re.Pattern[str]") -> tuple[str, list[dict[str, int]]]:
    """Take numbers out of a text: each match of a pattern becomes `<point>`.

    Returns:
        The text, and of each match the numbers of its named groups, in order.
    """
    text = text.replace(POINT, "")
    numbers = [
        {name: int(value) for name, value in match.groupdict().items() if value is not None}
        for match in pattern.finditer(text)
    ]
    return pattern.sub(POINT, text), numbers


_PIXELS = re.compile(r"<\s*(?P<y>\d{1,4})\s*,\s*(?P<x>\d{1,4})\s*>")


def read_grounded(text: str) -> Subgoal:
    """Read a subgoal that has its places as `<y, x>` in pixels, as RoboMME writes them."""
    words, numbers = read_points(text, _PIXELS)
    return Subgoal(words.strip(), tuple((one["y"], one["x"]) for one in numbers))
