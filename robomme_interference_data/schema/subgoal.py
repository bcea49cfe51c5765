"""Subgoals: what a policy should do next, in words, and where in the front image."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from robomme_interference_data.errors import InvalidOptionError

POINT = "<point>"
"""Placeholder for a point in a subgoal's text."""

Pixel = tuple[int, int]
"""A point of an image: row and column, (y, x), from 0."""

# `at` goes with its point: `pick up the cube at <point>` becomes `pick up the cube`.
_NAMED_AT = re.compile(rf"\s*(?:\bat\s+)?{POINT}")


@dataclass(frozen=True)
class Subgoal:
    """What a policy should do next.

    Attributes:
        text: In words, with a `<point>` for each point, as in `pick up the cube at <point>`.
        points: The points in the front image, (y, x) in pixels, in order.
    """

    text: str
    points: tuple[Pixel, ...] = ()

    def __post_init__(self) -> None:
        if self.text.count(POINT) != len(self.points) or not self.simple:
            raise InvalidOptionError.expected(
                f"subgoal {self.text!r}: its points",
                list(self.points),
                f"some words, and a point for each {POINT}",
            )

    @property
    def simple(self) -> str:
        """The text without points: `simple_subgoal` of released servers."""
        return without_points(self.text)

    @property
    def grounded(self) -> str:
        """The text with points as `<y, x>`: `grounded_subgoal` of released servers."""
        return write_points(self.text, [f"<{y}, {x}>" for y, x in self.points])


def without_points(text: str) -> str:
    """Return a subgoal's text without points."""
    return _NAMED_AT.sub("", text).strip()


def write_points(text: str, written: Sequence[str]) -> str:
    """Return a subgoal's text with each `<point>` replaced, in order."""
    first, *rest = text.split(POINT)
    return first + "".join(point + words for point, words in zip(written, rest, strict=True))


def read_points(text: str, pattern: "re.Pattern[str]") -> tuple[str, list[dict[str, int]]]:
    """Replace each match by `<point>`; return the text and the numbers of each match's groups."""
    # A model may write the placeholder itself.
    text = text.replace(POINT, "")
    numbers = [
        {name: int(value) for name, value in match.groupdict().items() if value is not None}
        for match in pattern.finditer(text)
    ]
    return pattern.sub(POINT, text), numbers


_PIXELS = re.compile(r"<\s*(?P<y>\d{1,4})\s*,\s*(?P<x>\d{1,4})\s*>")


def read_grounded(text: str) -> Subgoal:
    """Parse a subgoal with points as `<y, x>` in pixels, as RoboMME writes them."""
    words, numbers = read_points(text, _PIXELS)
    return Subgoal(words.strip(), tuple((point["y"], point["x"]) for point in numbers))
