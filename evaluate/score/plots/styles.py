"""Colors, markers and lines of systems: distinguishable without color and in print, too."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.evaluate.systems import SYSTEMS, display_name
from robomme_interference_data.viz.figure import GRAY, INK, Hue

# By what the memory holds.
_COLORS = {
    "none": GRAY,
    "frames": Hue.BLUE,
    "tokens": Hue.SKY,
    "hidden state": Hue.GREEN,
    "text": Hue.ORANGE,
    "text with points": Hue.VERMILION,
    "text with points and key frames": Hue.PINK,
    "all frames": Hue.GREEN,
    "last frames": Hue.ORANGE,
}
_UNKNOWN = (Hue.PINK, Hue.GREEN, Hue.ORANGE, Hue.SKY, Hue.VERMILION, Hue.BLUE)
# Marker and line: by how the memory enters the policy.
_SHAPES = {
    "modulator": ("o", "-"),
    "context": ("s", "--"),
    "expert": ("^", ":"),
    "subgoals": ("D", "-."),
}
_RETRIEVAL_MARKERS = "*PXdp8"
_LINES = ("-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)))


@dataclass(frozen=True)
class SeriesStyle:
    """How a system is drawn: `#rrggbb`, marker, line style, width in points."""

    label: str
    color: str
    marker: str
    line: Any
    width: float = 1.6

    @property
    def stroke(self) -> dict[str, Any]:
        """Matplotlib's options for its line."""
        return {"color": self.color, "linestyle": self.line, "linewidth": self.width}

    @property
    def point(self) -> dict[str, Any]:
        """Matplotlib's options for its points."""
        size, edge = {"*": (8, 1), "_": (10, 2)}.get(self.marker, (4.5, 1))
        style = {"marker": self.marker, "color": self.color}
        return style | {"markersize": size, "markeredgewidth": edge}


# Systems without one of the paper's shapes each get their own pair of marker and line.
_FREE = [(marker, line) for line in _LINES for marker in "vPX<>dph8"]
_TABLE = {
    system.name: SeriesStyle(
        system.display,
        _COLORS[system.representation],
        *(_SHAPES.get(system.integration or "") or _FREE.pop(0)),
    )
    for system in SYSTEMS.values()
    if system.facts.retrieval is None
}


def styles_of(names: Sequence[str], retrieving: Sequence[str] = ()) -> dict[str, SeriesStyle]:
    """Return the styles of systems; those of the table look the same in every figure.

    One system with retrieval is a dark star; several, named by `retrieving`, differ in color and
    marker. Up to two dozen systems that are not in the table differ by marker or line, more by
    color.
    """
    styles: dict[str, SeriesStyle] = {}
    unknown = [name for name in names if name not in (*_TABLE, *retrieving)]
    for name in names:
        if name in unknown:
            round_, shape = divmod(unknown.index(name), len(_FREE))
            color = _UNKNOWN[(shape + round_) % len(_UNKNOWN)]
            styles[name] = SeriesStyle(name, color, *_FREE[shape])
        elif name in retrieving:
            number = retrieving.index(name)
            marker, line = _RETRIEVAL_MARKERS[number % 6], _LINES[number % len(_LINES)]
            color = (INK, *_UNKNOWN)[number % (len(_UNKNOWN) + 1)]
            styles[name] = SeriesStyle(display_name(name), color, marker, line, 2.2)
        else:
            styles[name] = _TABLE[name]
    return styles
