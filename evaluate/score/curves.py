"""How systems look in figures, and the curves, axes and legends that figures share.

Systems are told apart without colour, too, and in print.
"""

import math
from collections.abc import Container, Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Self

from robomme_interference_data.conditions import (
    NO_HISTORY,
    Condition,
    Kind,
    in_order,
    parse_condition,
)
from robomme_interference_data.drawing import GREY, INK, Hue, tidy
from robomme_interference_data.evaluate.score.cells import Cell
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import SYSTEMS, base_of

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
class Look:
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
    system.name: Look(
        system.display,
        _COLOURS[system.representation],
        *(_SHAPES.get(system.integration or "") or _FREE.pop(0)),
    )
    for system in SYSTEMS.values()
    if not system.retrieval
}


def looks_of(names: Sequence[str]) -> dict[str, Look]:
    """Return the looks of systems; those of the table look the same in every figure.

    A system with retrieval is a black star; several are stars in the colours of what they are
    without it. Systems that are not in the table differ from each other and from the rest by
    marker or line, up to two dozen; beyond that colours tell them apart.
    """
    looks: dict[str, Look] = {}
    retrieving = [name for name in names if name in SYSTEMS and SYSTEMS[name].retrieval]
    own = [name for name in names if name not in SYSTEMS]
    for name in names:
        if name in own:
            round_, shape = divmod(own.index(name), len(_FREE))
            looks[name] = Look(name, _OWN[(shape + round_) % len(_OWN)], *_FREE[shape])
        elif name in retrieving:
            system, number = SYSTEMS[name], retrieving.index(name)
            colour = _COLOURS[system.representation] if len(retrieving) > 1 else "#000000"
            looks[name] = Look(system.display, colour, "*", _LINES[number % len(_LINES)], 2.2)
        else:
            looks[name] = _TABLE[name]
    return looks


class Data:
    """What the figures of one simulator show.

    Attributes:
        simulator: Its name.
        cells: System, condition and part to what is drawn: cells with rows, and published rates,
            whose systems are named `<system>, published`.
        systems: Those that have rows.
        absent: Published ones without rows here, behind a retrieval step that has: drawn in full.
        beside: Published ones of systems with rows: dashes beside their points.
        looks: Of all of them.
        conditions: Of all of them, in the order of tables.
        least: The fewest sessions that one of them counts.
        contrasts: The comparisons of the systems that have rows.
    """

    def __init__(self, score: Score, simulator: str):
        self.simulator = simulator
        found = [one for one in score.cells if one.simulator == simulator and one.n]
        self.systems = list(dict.fromkeys(one.system for one in found))
        self.contrasts = [one for one in score.contrasts if one.simulator == simulator]
        bases = [b for s in self.systems if (b := base_of(s)) and b not in self.systems]
        self.looks = looks_of([*self.systems, *bases])
        self.cells: dict[tuple[str, str, str], Cell] = {
            (one.system, one.condition, one.part): one for one in found
        }
        self.absent, self.beside = list[str](), list[str]()
        for one in score.published:
            if one.simulator == simulator and one.system in self.looks:
                name = f"{one.system}, published"
                names = self.absent if one.system in bases else self.beside
                names += [name] if name not in names else []
                look, line = self.looks[one.system], (0, (4, 2)) if one.system in bases else "none"
                self.looks[name] = Look(f"{look.label}, published", look.colour, "_", line, 1.2)
                self.cells[name, one.condition, ""] = one
        conditions = {condition for _, condition, _ in self.cells}
        self.conditions: Sequence[Condition] = in_order(conditions) if conditions else ()
        self.least = min((one.k for one in self.conditions if one.kind.counted), default=0)

    @property
    def kinds(self) -> list[Kind]:
        """The kinds of its conditions, in the order of tables."""
        return list(dict.fromkeys(one.kind for one in self.conditions))

    def of(self, kinds: Container[Kind]) -> Self:
        """Return what there is of some kinds of conditions, with the same places on the x axis."""
        found = copy(self)
        found.conditions = [one for one in self.conditions if one.kind in kinds]
        names = {one.name for one in found.conditions}
        found.cells = {key: cell for key, cell in self.cells.items() if key[1] in names}
        found.systems = [one for one in self.systems if any(one == key[0] for key in found.cells)]
        return found

    def x(self, condition: str) -> float:
        """Return the place on the x axis: log2(k + 1), right of conditions that do not count."""
        one, plain = parse_condition(condition), [c for c in self.conditions if not c.kind.counted]
        if not one.kind.counted:
            return 0.3 + 1.3 * plain.index(one)
        return 0.3 + 1.3 * len(plain) + math.log2((one.k + 1) / (self.least + 1))

    def parts(self, names: Sequence[str]) -> list[str]:
        """Return those of some parts that any cell is of."""
        return [name for name in names if any(part == name for _, _, part in self.cells)]

    def shown(self, systems: Sequence[str]) -> list[str]:
        """Return the conditions that any cell of some systems is of."""
        found = {condition for system, condition, _ in self.cells if system in systems}
        return [one.name for one in self.conditions if one.name in found]


def dodged(systems: Sequence[str]) -> Iterator[tuple[str, float]]:
    """Yield systems, each with its shift on the x axis, so that intervals do not overlap."""
    for place, system in enumerate(systems):
        yield system, (place - (len(systems) - 1) / 2) * min(0.09, 0.5 / len(systems))


def curve(
    axes: Any, data: Data, system: str, part: str, shift: float, *, bars: bool = True
) -> list[tuple[float, Look]]:
    """Draw a system's rates over the conditions, in a part of the episodes or (empty) in all.

    Points of incomplete cells are hollow. no-history is joined by a thin line: it is the rate
    without memory, not a smaller k.

    Returns:
        The last rate in percent, and the system's look; nothing without any rate.
    """
    look = data.looks[system]
    found = [c for one in data.conditions if (c := data.cells.get((system, one.name, part)))]
    if not found:
        return []
    points = [(c.condition, data.x(c.condition) + shift, 100 * c.rate) for c in found]
    for kind, group in groupby(points, lambda point: parse_condition(point[0]).kind):
        _, xs, ys = zip(*group, strict=True)
        if kind.counted:
            axes.plot(xs, ys, linestyle=look.line, color=look.colour, linewidth=look.width)
    if points[0][0] == NO_HISTORY and look.line != "none":
        if len(points) > 1:
            _, xs, ys = zip(*points[:2], strict=True)
            axes.plot(xs, ys, ":", color=look.colour, linewidth=0.7)
        elif len(data.conditions) > 1:  # without memory: the floor
            axes.axhline(points[0][2], color=look.colour, linewidth=0.8, linestyle="--", zorder=0)
    for (_, x, y), cell in zip(points, found, strict=True):
        if bars:
            bounds = [100 * bound for bound in cell.interval]
            axes.plot((x, x), bounds, color=look.colour, linewidth=0.9, alpha=0.7)
        face = look.colour if cell.complete else "white"
        # Not clipped: whole at 0 and at 100%.
        axes.plot(x, y, **look.point, markerfacecolor=face, clip_on=False, zorder=3)
    return [(points[-1][2], look)]


# --- axes, labels and legends ------------------------------------------------------------------


def set_axes(axes: Any, data: Data, systems: Sequence[str], ylabel: str) -> None:
    """Name the conditions of some systems, start at zero, and take away what carries nothing.

    Conditions of counted kinds are named by their k alone: those of one kind are joined.
    """
    tidy(axes)
    conditions = data.shown(systems)
    # Of kinds beside each other equal k have one place: it is named once.
    places = dict(sorted((data.x(one), short(one).rpartition("-")[2]) for one in conditions))
    axes.set_xticks(list(places), list(places.values()))
    axes.set_xlim(min(places) - 0.4, max(places) + 0.4)
    axes.set_ylim(0, min(max(axes.get_ylim()[1], 10), 103))
    if ylabel:
        axes.set_ylabel(ylabel, size=8, color=INK)


def short(condition: str) -> str:
    """Return a condition as axes name it."""
    return "none" if condition == NO_HISTORY else condition


def explained(data: Data, systems: Sequence[str], parts: Sequence[str], *notes: str) -> str:
    """Return in words what the points of some cells mean, as far as it needs to be said."""
    drawn = [(s, c) for (s, _, part), c in data.cells.items() if s in systems and part in parts]
    hollow = any(not one.complete for _, one in drawn)
    dashes = any(system in (*data.absent, *data.beside) for system, _ in drawn)
    said = ["hollow: cell not complete"] * hollow + ["dashes: published rates"] * dashes
    return "; ".join([*said, *filter(None, notes)])


def legend(figure: Any, looks: Sequence[Look], note: str = "") -> None:
    """Write a legend at the foot of a figure, under a note."""
    from matplotlib.lines import Line2D

    if looks or note:
        widest = 0.7 + 0.066 * max((len(look.label) for look in looks), default=0)
        figure.legend(
            [Line2D([], [], linestyle=k.line, linewidth=k.width, **k.point) for k in looks],
            [look.label for look in looks],
            title=note or None,
            title_fontsize=7.5,
            loc="outside lower center",
            ncols=max(1, min(len(looks), int(figure.get_figwidth() / widest))),
            fontsize=8,
            frameon=False,
            handlelength=3.2,  # long enough for a line's dashes to be seen
        )


def label_ends(axes: Any, ends: Sequence[tuple[float, Look]], gap: float) -> None:
    """Write labels at the right ends of lines, moved apart to at least `gap` on the y axis.

    Each stands behind the system's marker, in ink: not all colours can be read as letters. The
    axes have their final limits.
    """
    from matplotlib.transforms import ScaledTranslation

    def beside(inches: float) -> Any:  # from the right edge, y in data
        scale = axes.figure.dpi_scale_trans
        return axes.get_yaxis_transform() + ScaledTranslation(inches, 0, scale)

    ordered = sorted(ends, key=lambda end: end[0])
    heights = spread([value for value, _ in ordered], gap)
    for (value, look), height in zip(ordered, heights, strict=True):
        axes.annotate(
            "",
            (1, value),
            (1, height),
            xycoords=beside(0),
            textcoords=beside(0.16),
            arrowprops={"arrowstyle": "-", "color": look.colour, "linewidth": 0.5, "shrinkA": 0},
        )
        axes.plot(1, height, **look.point, clip_on=False, transform=beside(0.23))
        axes.text(1, height, look.label, color=INK, size=8, va="center", transform=beside(0.33))


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
