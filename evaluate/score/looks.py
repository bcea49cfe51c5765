"""How systems look in figures: told apart without colour, too, and in print."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.evaluate.systems import SYSTEMS, System, display_name
from robomme_interference_data.page import INK

__all__ = ["Look", "inches", "label_ends", "looks_of", "spread"]

# Okabe and Ito's colours, safe for the colour-blind: one for what the memory is made of.
_COLOURS = {
    "none": "#767676",
    "frames": "#0072B2",
    "tokens": "#56B4E9",
    "hidden state": "#009E73",
    "text": "#E69F00",
    "text with points": "#D55E00",
    "text with points and key frames": "#CC79A7",
    "all frames": "#009E73",
    "last frames": "#E69F00",
}
_OWN = ("#CC79A7", "#009E73", "#E69F00", "#56B4E9", "#D55E00", "#0072B2")
# Marker and line: one for how it enters the policy.
_SHAPES = {
    "modulator": ("o", "-"),
    "context": ("s", "--"),
    "expert": ("^", ":"),
    "subgoals": ("D", "-."),
}
_RETRIEVAL_LINES = ("-", "--", "-.", ":")
_OWN_SHAPES = ("v", "P", "X", "<", ">", "h")


@dataclass(frozen=True)
class Look:
    """How a system is drawn.

    Attributes:
        label: Its name.
        colour: As `#rrggbb`.
        marker: matplotlib's marker.
        line: matplotlib's line style.
        width: Line width in points.
        hollow: Whether points are white inside, as those of published rates are.
    """

    label: str
    colour: str
    marker: str
    line: Any
    width: float = 1.6
    hollow: bool = False

    @property
    def size(self) -> float:
        """Size of its points."""
        return 8 if self.marker == "*" else 4.5


def looks_of(names: Sequence[str]) -> dict[str, Look]:
    """Return the looks of systems; those of the table look the same in every figure.

    A system with retrieval is a black star; several are stars in the colours of what they are
    without it.
    """
    looks = {}
    retrieving = [name for name in names if name in SYSTEMS and SYSTEMS[name].retrieval]
    for place, name in enumerate(names):
        system = SYSTEMS.get(name)
        own = place % len(_OWN)
        if system is not None and system.retrieval:
            alone = len(retrieving) == 1
            colour = "#000000" if alone else _COLOURS.get(system.representation, _OWN[own])
            line = _RETRIEVAL_LINES[retrieving.index(name) % len(_RETRIEVAL_LINES)]
            looks[name] = Look(display_name(name), colour, "*", line, 2.2)
        elif system is not None:
            marker, line = _shape(system, _OWN_SHAPES[own])
            colour = _COLOURS.get(system.representation, _OWN[own])
            looks[name] = Look(system.display, colour, marker, line)
        else:
            looks[name] = Look(name, _OWN[own], _OWN_SHAPES[own], "-")
    return looks


def _shape(system: System, own: str) -> tuple[str, str]:
    if not system.with_history:
        return "v", "--"
    return _SHAPES.get(system.integration or "", (own, "-"))


def inches(text: str) -> float:
    """Return about how wide a text of 8 points is."""
    return 0.066 * len(text)


def label_ends(axes: Any, width: float, ends: Sequence[tuple[float, Look]], gap: float) -> None:
    """Write labels at the right ends of lines, moved apart to at least `gap` on the y axis.

    Each stands behind the system's marker, in ink: not all colours can be read as letters.

    Args:
        axes: The axes, with their final limits.
        width: Their width in inches.
        ends: Where lines end on the y axis, and how they look.
        gap: On the y axis.
    """
    ordered = sorted(ends, key=lambda end: end[0])
    heights = spread([value for value, _ in ordered], gap)
    places = axes.get_yaxis_transform()  # x in widths of the axes, y in data
    for (value, look), height in zip(ordered, heights, strict=True):
        axes.plot(
            (1, 1 + 0.15 / width),
            (value, height),
            color=look.colour,
            linewidth=0.5,
            clip_on=False,
            transform=places,
        )
        axes.plot(
            1 + 0.23 / width,
            height,
            look.marker,
            color=look.colour,
            markerfacecolor="white" if look.hollow else look.colour,
            markersize=look.size,
            clip_on=False,
            transform=places,
        )
        x = 1 + 0.33 / width
        axes.text(x, height, look.label, color=INK, size=8, va="center", transform=places)


def spread(values: Sequence[float], gap: float) -> list[float]:
    """Return ascending values moved as little as need be to lie at least `gap` apart.

    Those that are too close form a stack around their mean; stacks that meet become one.
    """
    stacks: list[tuple[float, int]] = []  # mean and size
    for value in values:
        mean, size = value, 1
        while stacks and mean - stacks[-1][0] < gap * (size + stacks[-1][1]) / 2:
            before, count = stacks.pop()
            mean, size = (mean * size + before * count) / (size + count), size + count
        stacks.append((mean, size))
    return [mean + gap * (i - (size - 1) / 2) for mean, size in stacks for i in range(size)]
