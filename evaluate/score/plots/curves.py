"""Curves of success over conditions, and the axes and labels that figures share."""

import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from robomme_interference_data.schema.conditions import NO_HISTORY, parse_condition
from robomme_interference_data.viz.figure import INK, connect_right, right_of, tidy

from .data import CHANCE, FEW, PUBLISHED, Data
from .styles import SeriesStyle


def shifts(systems: Sequence[str]) -> dict[str, float]:
    """Return each system's shift on the x axis: where there are intervals, they do not overlap."""
    step = 0.09 if len(systems) <= FEW else 0.0
    return {name: (place - (len(systems) - 1) / 2) * step for place, name in enumerate(systems)}


def mark(artists: Any, system: str) -> None:
    """Say of what is drawn which system it is of: pages set one apart by it."""
    for artist in artists:
        artist.set_gid(f"system:{system.removesuffix(PUBLISHED)}")


def curve(
    axes: Any, data: Data, system: str, part: str, shift: float, *, bars: bool = True
) -> dict[str, float]:
    """Draw a system's rates over the conditions, in a part of the episodes or (empty) in all.

    Points of incomplete cells are hollow. no-history is joined by a thin line: it is the rate
    without memory, not a smaller k. Returns the system's last rate in percent, if there is any.
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
    """Draw, and return in percent, what guessing has in a part, where all are questions."""
    if part not in data.chance:
        return {}
    level, style = 100 * data.chance[part], data.styles[CHANCE]
    axes.axhline(level, color=style.colour, linestyle=style.line, linewidth=style.width, zorder=0)
    return {CHANCE: level}


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
        if system != CHANCE:
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
