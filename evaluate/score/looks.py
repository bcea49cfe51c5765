"""How systems look in figures: told apart without colour, too, and in print."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.evaluate.systems import SYSTEMS, display_name

__all__ = ["Look", "label_ends", "looks_of", "spread"]

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
    """

    label: str
    colour: str
    marker: str
    line: Any
    width: float = 1.6


def looks_of(names: Sequence[str]) -> dict[str, Look]:
    """Return the looks of systems; those of the table look the same in every figure."""
    looks = {}
    for place, name in enumerate(names):
        system = SYSTEMS.get(name)
        own = place % len(_OWN)
        if system is not None and system.retrieval:
            looks[name] = Look(display_name(name), "#000000", "*", "-", 2.2)
        elif system is not None:
            marker, line = _SHAPES.get(system.integration or "", (_OWN_SHAPES[own], "-"))
            colour = _COLOURS.get(system.representation, _OWN[own])
            looks[name] = Look(system.display, colour, marker, line)
        else:
            looks[name] = Look(name, _OWN[own], _OWN_SHAPES[own], "-")
    return looks


def label_ends(
    axes: Any, x: float, ends: Sequence[tuple[float, Look]], gap: float, size: float = 8
) -> None:
    """Write labels at the right ends of lines, moved apart to at least `gap` on the y axis."""
    ordered = sorted(ends, key=lambda end: end[0])
    heights = spread([value for value, _ in ordered], gap)
    for (value, look), height in zip(ordered, heights, strict=True):
        axes.annotate(
            look.label,
            (x, value),
            (x + 0.22, height),
            color=look.colour if look.colour != "#56B4E9" else "#2B86B8",  # enough contrast
            size=size,
            va="center",
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": look.colour,
                "linewidth": 0.5,
                "shrinkB": 0,
                "relpos": (0, 0.5),
            },
        )


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
