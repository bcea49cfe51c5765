"""How systems look in figures: told apart without colour, too, and in print."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.evaluate.systems import SYSTEMS, known_system
from robomme_interference_data.viz.figure import GREY, INK, Hue

# One for what the memory is made of.
_COLOURS = {
    "none": GREY,
    "frames": Hue.BLUE,
    "tokens": Hue.SKY,
    "hidden state": Hue.GREEN,
    "text": Hue.ORANGE,
    "text with points": Hue.VERMILION,
    "text with points and key frames": Hue.PINK,
    "all frames": Hue.GREEN,
    "last frames": Hue.ORANGE,
}
_OWN = (Hue.PINK, Hue.GREEN, Hue.ORANGE, Hue.SKY, Hue.VERMILION, Hue.BLUE)
# Marker and line: one for how it enters the policy.
_SHAPES = {
    "modulator": ("o", "-"),
    "context": ("s", "--"),
    "expert": ("^", ":"),
    "subgoals": ("D", "-."),
}
_LINES = ("-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)))


@dataclass(frozen=True)
class SeriesStyle:
    """How a system is drawn: `#rrggbb`, matplotlib's marker and line style, width in points."""

    label: str
    colour: str
    marker: str
    line: Any
    width: float = 1.6

    @property
    def point(self) -> dict[str, Any]:
        """How matplotlib draws its points; an outline is all there is of a dash."""
        size, edge = {"*": (8, 1), "_": (10, 2)}.get(self.marker, (4.5, 1))
        style = {"marker": self.marker, "color": self.colour}
        return style | {"markersize": size, "markeredgewidth": edge}


# Of those that share no shape with the paper's, each has its own pair of marker and line.
_FREE = [(marker, line) for line in _LINES for marker in "vPX<>dph8"]
_TABLE = {
    system.name: SeriesStyle(
        system.display,
        _COLOURS[system.representation],
        *(_SHAPES.get(system.integration or "") or _FREE.pop(0)),
    )
    for system in SYSTEMS.values()
    if not system.retrieval
}


def styles_of(names: Sequence[str]) -> dict[str, SeriesStyle]:
    """Return the styles of systems; those of the table look the same in every figure.

    A system with retrieval is a dark star; several are stars in the colours of what they are
    without it. Systems that are not in the table differ from each other and from the rest by
    marker or line, up to two dozen; beyond that colours tell them apart.
    """
    styles: dict[str, SeriesStyle] = {}
    known = {name: system for name in names if (system := known_system(name)) is not None}
    retrieving = [name for name, system in known.items() if system.retrieval]
    own = [name for name in names if name not in known]
    for name in names:
        if name in own:
            round_, shape = divmod(own.index(name), len(_FREE))
            styles[name] = SeriesStyle(name, _OWN[(shape + round_) % len(_OWN)], *_FREE[shape])
        elif name in retrieving:
            system, number = known[name], retrieving.index(name)
            colour = _COLOURS[system.representation] if len(retrieving) > 1 else INK
            styles[name] = SeriesStyle(
                system.display, colour, "*", _LINES[number % len(_LINES)], 2.2
            )
        else:
            styles[name] = _TABLE[name]
    return styles
