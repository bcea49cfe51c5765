"""How systems look in figures: told apart without colour, too, and in print."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.evaluate.systems import SYSTEMS, System
from robomme_interference_data.page import GREY, INK

__all__ = ["INCOMPLETE", "PUBLISHED", "Look", "inches", "label_ends", "looks_of", "spread"]

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
# Of those that share no shape with the paper's, each has its own pair of marker and line.
_OWN_SHAPES = [(m, line) for line in ("-", "--", "-.", ":") for m in "vPX<>dph"]


@dataclass(frozen=True)
class Look:
    """How a system is drawn.

    Attributes:
        label: Its name.
        colour: As `#rrggbb`.
        marker: matplotlib's marker.
        line: matplotlib's line style.
        width: Line width in points.
        hollow: Whether points are white inside, as those of incomplete cells are.
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
        return {"*": 8, "_": 10}.get(self.marker, 4.5)

    @property
    def edge(self) -> float:
        """Width of the outline of its points, which is all there is of a dash, in points."""
        return 2 if self.marker == "_" else 1


INCOMPLETE = Look("cell not complete", GREY, "o", "none", hollow=True)
PUBLISHED = Look("published rate", GREY, "_", "none")
"""What legends say of points that are no system's own complete cells."""


def looks_of(names: Sequence[str]) -> dict[str, Look]:
    """Return the looks of systems; those of the table look the same in every figure.

    A system with retrieval is a black star; several are stars in the colours of what they are
    without it. Systems that are not in the table differ from each other and from the rest by
    marker or line, up to two dozen; beyond that colours tell them apart.
    """
    looks = {}
    fixed = (_fixed(system) for system in SYSTEMS.values() if not system.retrieval)
    taken = {(look.marker, look.line) for look in fixed}
    free = [shape for shape in _OWN_SHAPES if shape not in taken]
    retrieving = [name for name in names if name in SYSTEMS and SYSTEMS[name].retrieval]
    own = 0
    for name in names:
        system = SYSTEMS.get(name)
        if system is None:
            colour = _OWN[(own + own // len(free)) % len(_OWN)]
            looks[name] = Look(name, colour, *free[own % len(free)])
            own += 1
        elif system.retrieval:
            alone = len(retrieving) == 1
            colour = "#000000" if alone else _COLOURS[system.representation]
            line = _RETRIEVAL_LINES[retrieving.index(name) % len(_RETRIEVAL_LINES)]
            looks[name] = Look(system.display, colour, "*", line, 2.2)
        else:
            looks[name] = _fixed(system)
    return looks


def _fixed(system: System) -> Look:
    """Return the look of a system of the table, without regard to what else is drawn."""
    marker, line = _SHAPES.get(system.integration or "", ("", ""))
    if not marker:
        others = [name for name, s in SYSTEMS.items() if s.integration is None and not s.retrieval]
        marker, line = _OWN_SHAPES[others.index(system.name)]
    return Look(system.display, _COLOURS[system.representation], marker, line)


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
            markeredgewidth=look.edge,
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
