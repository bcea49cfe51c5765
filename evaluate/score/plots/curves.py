"""What figures show of a score, and the curves, axes and labels that they share."""

import math
from collections.abc import Container, Mapping, Sequence
from copy import copy
from itertools import groupby
from typing import Any, Self

from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.cells import Cell
from robomme_interference_data.evaluate.score.tables.paper import by_family
from robomme_interference_data.evaluate.systems import base_of
from robomme_interference_data.schema.conditions import (
    NO_HISTORY,
    Condition,
    Kind,
    in_order,
    parse_condition,
)
from robomme_interference_data.stats.significance import ALPHA
from robomme_interference_data.viz.figure import INK, connect_right, right_of, tidy

from .styles import SeriesStyle, styles_of

_PUBLISHED = ", published"
_CHANCE = "(chance)"  # among systems: no name of one has brackets

FEW = 4
"""Up to so many systems, curves have intervals."""


class Data:
    """What the figures of one simulator show.

    Attributes:
        simulator: Its name.
        cells: System, condition and part to what is drawn: cells with rows, and published rates,
            whose systems are named `<system>, published`.
        systems: Those that have rows.
        absent: Published ones without rows here, behind a retrieval step that has: drawn in full.
        beside: Published ones of systems with rows: dashes beside their points.
        styles: Of all of them, and of the chance level.
        conditions: Of all of them, in the order of tables.
        least: The fewest sessions that one of them counts.
        contrasts: The comparisons of the systems that have rows.
        flips: Share of outcomes that differ between repeats; None without repeats.
        apart: Condition and two systems that can be told apart under it.
        access: The rows of the table `access`, without the simulator.
        chance: Part of the episodes, or empty for all, to the share that guessing has: of those
            that are all questions, as most episodes have it.
    """

    def __init__(self, score: Score, simulator: str):
        self.simulator = simulator
        found = [one for one in score.cells if one.simulator == simulator and one.n]
        self.systems = list(dict.fromkeys(one.system for one in found))
        self.contrasts = [one for one in score.contrasts if one.simulator == simulator]
        repeats = [row[3:5] for row in score.tables["noise"].rows if row[0] == simulator]
        pairs, flips = map(sum, zip(*repeats, strict=True)) if repeats else (0, 0)
        self.flips = flips / pairs if pairs else None
        self.apart = {
            (one["condition"], frozenset((one["system"], one["against_system"])))
            for one in (score.tables["matrix"].records() if "matrix" in score.tables else ())
            if one["simulator"] == simulator and one["p_holm"] < ALPHA
        }
        access = score.tables.get("access")
        self.access = [row[1:] for row in access.rows if row[0] == simulator] if access else []
        asked = sorted((one for one in found if one.chance >= 0), key=lambda one: one.n)
        self.chance = {one.part: one.chance for one in asked}
        bases = [b for s in self.systems if (b := base_of(s)) and b not in self.systems]
        self.styles = styles_of([*self.systems, *bases])
        self.styles[_CHANCE] = SeriesStyle("chance", INK, "", ":", 0.9)
        self.cells: dict[tuple[str, str, str], Cell] = {
            (one.system, one.condition, one.part): one for one in found
        }
        self.absent, self.beside = list[str](), list[str]()
        for one in (*score.published, *(by_family() if score.published else ())):
            if one.simulator == simulator and one.system in self.styles:
                name = f"{one.system}{_PUBLISHED}"
                names = self.absent if one.system in bases else self.beside
                names += [name] if name not in names else []
                style, line = (
                    self.styles[one.system],
                    (0, (4, 2)) if one.system in bases else "none",
                )
                label = f"{style.label}, published"
                self.styles[name] = SeriesStyle(label, style.colour, "_", line, 1.2)
                self.cells[name, one.condition, one.part] = one
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
        """Return those of some parts that any cell with rows is of."""
        own = {part for system, _, part in self.cells if system in self.systems}
        return [name for name in names if name in own]

    def has_parts(self, system: str) -> bool:
        """Whether any cell of a system is of a part of the episodes."""
        return any(name == system and part for name, _, part in self.cells)

    def shown(self, systems: Sequence[str]) -> list[str]:
        """Return the conditions that any cell of some systems is of."""
        found = {condition for system, condition, _ in self.cells if system in systems}
        return [one.name for one in self.conditions if one.name in found]


def shifts(systems: Sequence[str]) -> dict[str, float]:
    """Return each system's shift on the x axis: where there are intervals, they do not overlap."""
    step = 0.09 if len(systems) <= FEW else 0.0
    return {name: (place - (len(systems) - 1) / 2) * step for place, name in enumerate(systems)}


def mark(artists: Any, system: str) -> None:
    """Say of what is drawn which system it is of: pages set one apart by it."""
    for artist in artists:
        artist.set_gid(f"system:{system.removesuffix(_PUBLISHED)}")


def curve(
    axes: Any, data: Data, system: str, part: str, shift: float, *, bars: bool = True
) -> dict[str, float]:
    """Draw a system's rates over the conditions, in a part of the episodes or (empty) in all.

    Points of incomplete cells are hollow. no-history is joined by a thin line: it is the rate
    without memory, not a smaller k.

    Returns:
        The system's last rate in percent; nothing without any rate.
    """
    style = data.styles[system]
    found = [c for one in data.conditions if (c := data.cells.get((system, one.name, part)))]
    if not found:
        return {}
    points = [
        (data.x(c.condition) + shift, 100 * c.rate, *(100 * bound for bound in c.interval))
        for c in found
    ]
    drawn = []
    for kind, places in groupby(
        range(len(found)), lambda place: parse_condition(found[place].condition).kind
    ):
        xs, ys = zip(*(points[place][:2] for place in places), strict=True)
        if kind.counted:
            line = {"linestyle": style.line, "linewidth": style.width}
            drawn += axes.plot(xs, ys, color=style.colour, **line)
    if found[0].condition == NO_HISTORY and style.line != "none":
        if len(points) > 1:
            xs, ys = zip(*(point[:2] for point in points[:2]), strict=True)
            drawn += axes.plot(xs, ys, ":", color=style.colour, linewidth=0.7)
        elif len(data.conditions) > 1:  # without memory: the floor
            floor = {"linewidth": 0.8, "linestyle": "--", "zorder": 0}
            drawn.append(axes.axhline(points[0][1], color=style.colour, **floor))
    whole = [cell.complete for cell in found]
    drawn += points_with_bars(axes, points, style, {"linestyle": "none"}, whole, bars=bars)
    mark(drawn, system)
    return {system: points[-1][1]}


def points_with_bars(
    axes: Any,
    points: Sequence[Sequence[float]],
    style: SeriesStyle,
    line: Mapping[str, Any],
    whole: Sequence[bool] | None = None,
    *,
    bars: bool = True,
) -> list[Any]:
    """Draw points, `(x, value, low, high)` each, with their bars; hollow where not `whole`."""
    drawn = []
    if bars:
        xs, _, low, high = zip(*points, strict=True)
        drawn.append(axes.vlines(xs, low, high, color=style.colour, linewidth=0.9, alpha=0.7))
    full = whole or [True] * len(points)
    for wanted, face in ((True, style.colour), (False, "white")):
        chosen = [point[:2] for point, one in zip(points, full, strict=True) if one is wanted]
        if chosen:
            # Not clipped: whole at 0 and at 100%.
            shape = style.point | {"markerfacecolor": face, **line}
            drawn += axes.plot(*zip(*chosen, strict=True), **shape, clip_on=False, zorder=3)
    return drawn


def chance_level(axes: Any, data: Data, part: str) -> dict[str, float]:
    """Draw the share that guessing has in a part of the episodes, where they are questions.

    Returns:
        That share in percent, to be named as systems are; nothing where nothing was asked.
    """
    if part not in data.chance:
        return {}
    level, style = 100 * data.chance[part], data.styles[_CHANCE]
    axes.axhline(level, color=style.colour, linestyle=style.line, linewidth=style.width, zorder=0)
    return {_CHANCE: level}


# --- axes and labels ---------------------------------------------------------------------------


def panel_grid(figure: Any, count: int, wide: int, *, sharex: bool = True) -> list[Any]:
    """Return so many panels, `wide` in a row; the lowest of each column has labels below."""
    grid = figure.subplots(-(-count // wide), wide, sharex=sharex, sharey=True, squeeze=False)
    for number, axes in enumerate(grid.flat):
        if number >= count:
            axes.set_axis_off()
        elif sharex:
            axes.tick_params(labelbottom=number + wide >= count)
    return list(grid.flat[:count])


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


def legend(figure: Any, note: str) -> None:
    """Write a note at the foot of a figure, if there is any."""
    if note:
        place = {"loc": "outside lower center", "frameon": False}
        figure.legend([], [], title=note, title_fontsize=7.5, **place)


def label_ends(
    axes: Any,
    ends: Mapping[str, float],
    styles: Mapping[str, SeriesStyle],
    height: float,
    size: float,
    of: str | None = None,
) -> None:
    """Name the systems at the right ends of their lines, moved apart as far as need be.

    Each stands behind the system's marker, in ink: not all colours can be read as letters. The
    axes have their final limits, and are about `height` inches high; letters are `size` points.
    Where the lines are not systems, but all `of` one, they are marked as that one's.
    """
    letters: dict[str, Any] = {"color": INK, "size": size, "va": "center"}
    top = axes.get_ylim()[1]
    ordered = sorted(ends.items(), key=lambda end: end[1])
    gap = min(top * 1.2 * size / 72 / height, top / max(1, len(ordered) - 1))
    heights = spread([value for _, value in ordered], gap, 0, top)
    for (system, value), label in zip(ordered, heights, strict=True):
        style = styles[system]
        place, words = (right_of(axes, inches * size) for inches in (0.029, 0.041))
        drawn = [
            connect_right(axes, value, label, 0.02 * size, color=style.colour, linewidth=0.5),
            *axes.plot(1, label, **style.point, clip_on=False, transform=place),
            axes.text(1, label, style.label, transform=words, **letters),
        ]
        if system != _CHANCE:
            mark(drawn, of or system)


def spread(
    values: Sequence[float], gap: float, low: float = -math.inf, high: float = math.inf
) -> list[float]:
    """Return ascending values moved as little as need be to lie at least `gap` apart.

    Those that are too close form a stack around their mean; stacks that meet become one. All lie
    from `low` to `high`, where there is room for that.
    """
    stacks: list[tuple[float, int]] = []  # mean and size
    for value in values:
        mean, size = value, 1
        while stacks and mean - stacks[-1][0] < gap * (size + stacks[-1][1]) / 2:
            before, count = stacks.pop()
            mean, size = (mean * size + before * count) / (size + count), size + count
        stacks.append((mean, size))
    found = [mean + gap * (i - (size - 1) / 2) for mean, size in stacks for i in range(size)]
    last = len(found) - 1
    return [min(max(v, low + gap * i), high - gap * (last - i)) for i, v in enumerate(found)]
