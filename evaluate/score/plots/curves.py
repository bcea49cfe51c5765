"""Curves of success over conditions, and the axes and labels that figures share."""

import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from textwrap import fill
from typing import Any

from robomme_interference_data.schema.conditions import NO_HISTORY, parse_condition
from robomme_interference_data.viz.figure import INK, connect_right, right_of, tidy

from .data import CHANCE, PUBLISHED, Data
from .styles import SeriesStyle

WIDTH = 10
"""Width of every figure in inches: a page scales all of them alike, so texts keep their sizes."""

TITLE, HEADING, LABEL, SMALL = 10, 9, 8, 7
"""Sizes of letters in points: of a figure, of a panel, of axes, and of cells in them."""

_LETTERS = 15
"""Letters of a note in an inch."""


def shifts(systems: Sequence[str], step: float = 0.09) -> dict[str, float]:
    """Return each system's shift on the x axis, which keeps intervals apart."""
    return {name: (place - (len(systems) - 1) / 2) * step for place, name in enumerate(systems)}


def curve(
    axes: Any, data: Data, system: str, part: str, shift: float, *, bars: bool = True
) -> dict[str, float]:
    """Draw a system's rates over the conditions, in a part of the episodes or (empty) in all.

    no-history is joined by a thin line: it is the rate without memory, not a smaller k. Returns
    the system's last rate in percent, if there is one.
    """
    style = data.styles[system]
    cells = [
        cell
        for condition in data.conditions
        if (cell := data.cells.get((system, condition.name, part)))
    ]
    if not cells:
        return {}
    points = [
        (data.x(c.condition) + shift, 100 * c.rate, *(100 * bound for bound in c.interval))
        for c in cells
    ]
    drawn = []
    for kind, places in groupby(
        range(len(cells)), lambda place: parse_condition(cells[place].condition).kind
    ):
        xs, ys = zip(*(points[place][:2] for place in places), strict=True)
        if kind.counted:
            drawn += axes.plot(xs, ys, **style.stroke)
    if cells[0].condition == NO_HISTORY and style.line != "none":
        if len(points) > 1:
            xs, ys = zip(*(point[:2] for point in points[:2]), strict=True)
            drawn += axes.plot(xs, ys, ":", color=style.color, linewidth=0.7)
        elif len(data.conditions) > 1:  # without memory: the floor
            floor = {"linewidth": 0.8, "linestyle": "--", "zorder": 0}
            drawn.append(axes.axhline(points[0][1], color=style.color, **floor))
    mark(drawn, system)
    draw_points(axes, points, style, system, [cell.complete for cell in cells], bars=bars)
    return {system: points[-1][1]}


def mark(artists: Any, system: str) -> None:
    """Record in the SVG which system artists show, so that the report can highlight it."""
    for artist in artists:
        artist.set_gid(f"system:{system.removesuffix(PUBLISHED)}")


def draw_points(
    axes: Any,
    points: Sequence[Sequence[float]],
    style: SeriesStyle,
    system: str,
    complete: Sequence[bool],
    *,
    bars: bool = True,
    horizontal: bool = False,
) -> None:
    """Draw `(place, value, low, high)` points with intervals, hollow where cells are incomplete.

    Values go up, or to the right if `horizontal`. Intervals with NaN are left out.
    """
    known = [point for point in points if not math.isnan(point[2])]
    drawn = []
    if bars and known:
        places, _, low, high = zip(*known, strict=True)
        lines, width = (axes.hlines, 1.5) if horizontal else (axes.vlines, 0.9)
        drawn.append(lines(places, low, high, color=style.color, linewidth=width, alpha=0.8))
    for is_complete, face in ((True, style.color), (False, "white")):
        shown = [
            (place, value)
            for (place, value, *_), done in zip(points, complete, strict=True)
            if done is is_complete
        ]
        if horizontal:
            shown = [(value, place) for place, value in shown]
        if shown:
            shape = style.point | {"markerfacecolor": face, "linestyle": "none"}
            # Not clipped, so that points at 0 and at 100% are drawn fully.
            drawn += axes.plot(*zip(*shown, strict=True), **shape, clip_on=False, zorder=3)
    mark(drawn, system)


def chance_level(axes: Any, data: Data, part: str) -> dict[str, float]:
    """Draw the success of guessing in a part, and return it in percent, if all are questions."""
    if part not in data.chance:
        return {}
    level = 100 * data.chance[part]
    axes.axhline(level, **data.styles[CHANCE].stroke, zorder=0)
    return {CHANCE: level}


# --- axes and labels ---------------------------------------------------------------------------


def panel_grid(figure: Any, count: int, wide: int, *, sharex: bool = True) -> list[Any]:
    """Return panels, `wide` in a row; the lowest of each column has labels below."""
    grid = figure.subplots(math.ceil(count / wide), wide, sharex=sharex, sharey=True, squeeze=False)
    for number, axes in enumerate(grid.flat):
        if number >= count:
            axes.set_axis_off()
        elif sharex:
            axes.tick_params(labelbottom=number + wide >= count)
    return list(grid.flat[:count])


def set_axes(axes: Any, data: Data, systems: Sequence[str], ylabel: str) -> None:
    """Label the conditions of some systems, start at zero, and remove clutter."""
    tidy(axes)
    conditions = data.shown(systems)
    # Conditions of several kinds with equal k share a place, which is labeled once.
    places = dict(sorted((data.x(name), short(name).rpartition("-")[2]) for name in conditions))
    axes.set_xticks(list(places), list(places.values()))
    axes.set_xlim(min(places) - 0.4, max(places) + 0.4)
    axes.set_ylim(0, min(max(axes.get_ylim()[1], 10), 103))
    if ylabel:
        axes.set_ylabel(ylabel, size=LABEL, color=INK)


def short(condition: str) -> str:
    """Return the label of a condition."""
    return "none" if condition == NO_HISTORY else condition


def explained(data: Data, systems: Sequence[str], parts: Sequence[str], *notes: str) -> str:
    """Explain hollow points and dashes, where they occur."""
    drawn = [(s, c) for (s, _, part), c in data.cells.items() if s in systems and part in parts]
    hollow = any(not cell.complete for _, cell in drawn)
    dashes = any(system in (*data.absent, *data.beside) for system, _ in drawn)
    marks = []
    if hollow:
        marks.append("hollow: incomplete cell")
    if dashes:
        marks.append("dashes: published rates")
    return "; ".join([*marks, *filter(None, notes)])


def legend(figure: Any, note: str) -> None:
    """Write a note below a figure, if there is one, in lines that fit its width."""
    if note:
        letters = round(_LETTERS * figure.get_figwidth())
        lines = "\n".join(fill(line, letters) for line in note.splitlines())
        place = {"loc": "outside lower center", "frameon": False}
        figure.legend([], [], title=lines, title_fontsize=LABEL - 0.5, **place)


def label_ends(
    axes: Any,
    ends: Mapping[str, float],
    styles: Mapping[str, SeriesStyle],
    height: float,
    size: float,
    of: str | None = None,
) -> None:
    """Label the right ends of lines with marker and name, moved apart as far as necessary.

    The axes have their final limits and are about `height` inches high; letters are `size` points.
    If the lines all show one system, `of` is that system.
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
            connect_right(axes, value, label, 0.02 * size, color=style.color, linewidth=0.5),
            *axes.plot(1, label, **style.point, clip_on=False, transform=place),
            axes.text(1, label, style.label, transform=words, **letters),
        ]
        if system != CHANCE:
            mark(drawn, of or system)


def spread(
    values: Sequence[float], gap: float, low: float = -math.inf, high: float = math.inf
) -> list[float]:
    """Return ascending values, moved to be at least `gap` apart and, if possible, in the bounds.

    Values that are too close form a stack around their mean; stacks that meet are merged.
    """
    stacks: list[tuple[float, int]] = []  # mean and size
    for value in values:
        mean, size = value, 1
        while stacks and mean - stacks[-1][0] < gap * (size + stacks[-1][1]) / 2:
            before, count = stacks.pop()
            mean, size = (mean * size + before * count) / (size + count), size + count
        stacks.append((mean, size))
    placed = [mean + gap * (i - (size - 1) / 2) for mean, size in stacks for i in range(size)]
    last = len(placed) - 1
    return [min(max(v, low + gap * i), high - gap * (last - i)) for i, v in enumerate(placed)]
