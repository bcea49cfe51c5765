"""What the figures of one simulator show, and the curves, axes and legends that they share."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from robomme_interference_data.evaluate.rows import NO_HISTORY, condition_rank
from robomme_interference_data.evaluate.score.cells import Cell
from robomme_interference_data.evaluate.score.effects import base_of
from robomme_interference_data.evaluate.score.looks import (
    INCOMPLETE,
    PUBLISHED,
    Look,
    inches,
    looks_of,
)
from robomme_interference_data.evaluate.score.paper import Published, published
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.page import INK, tidy

__all__ = ["Cells", "Data", "as_published", "curve", "dodged", "explain", "keys"]
__all__ += ["legend", "published_curves", "set_axes", "short"]

Cells = Mapping[tuple[str, str, str], Cell]
"""System, condition and part to the cell, of one simulator."""


class Data:
    """What the figures of one simulator show."""

    def __init__(self, score: Score, simulator: str):
        def mine(cells: Sequence[Cell]) -> dict[tuple[str, str, str], Cell]:
            found = [c for c in cells if c.simulator == simulator and c.n]
            return {(c.system, c.condition, c.part): c for c in found}

        self.simulator = simulator
        self.all, self.families = mine(score.cells), mine(score.family_cells)
        self.difficulty = mine(score.difficulty_cells)
        self.systems = list(dict.fromkeys(system for system, _, _ in self.all))
        self.own_conditions = sorted({c for _, c, _ in self.all}, key=condition_rank)
        self.lift = [c for one in score.effects for c in one.lift if c.simulator == simulator]
        self.published: list[Published] = []
        if score.against_paper:
            self.published = [one for one in published() if one.simulator == simulator]
        shown = {one.condition for one in self.published} if self.published else set()
        self.conditions = sorted({*self.own_conditions, *shown}, key=condition_rank)
        self.bases = [b for s in self.systems if (b := base_of(s)) is not None]
        self.looks = looks_of([*self.systems, *(b for b in self.bases if b not in self.systems)])

    def x(self, condition: str) -> float:
        """Place on the x axis: evenly, with a gap after no-history, which is no small k."""
        place = self.conditions.index(condition)
        return place - (0.3 if condition == NO_HISTORY else 0.0)


def dodged(systems: Sequence[str]) -> Iterator[tuple[float, str]]:
    """Yield systems, each with its shift on the x axis, so that intervals do not overlap."""
    for place, system in enumerate(systems):
        yield (place - (len(systems) - 1) / 2) * min(0.09, 0.5 / len(systems)), system


def curve(
    axes: Any, data: Data, cells: Cells, system: str, part: str, shift: float, *, bars: bool = True
) -> float:
    """Draw a system's rates over the conditions; return the last one, NaN if there is none.

    Points of incomplete cells are hollow. no-history is joined by a thin line: it is the rate
    without memory, not a smaller k.
    """
    look = data.looks[system]
    found = [c for name in data.conditions if (c := cells.get((system, name, part)))]
    if not found:
        return math.nan
    xs = [data.x(cell.condition) + shift for cell in found]
    ys = [100 * cell.rate for cell in found]
    start = int(found[0].condition == NO_HISTORY)
    if start == len(found) > 0 and len(data.conditions) > 1:  # a system without memory: the floor
        axes.axhline(ys[0], color=look.colour, linewidth=0.8, linestyle="--", zorder=0)
    axes.plot(xs[start:], ys[start:], look.line, color=look.colour, linewidth=look.width)
    axes.plot(xs[: start + 1], ys[: start + 1], ":", color=look.colour, linewidth=0.7)
    for x, y, cell in zip(xs, ys, found, strict=True):
        if bars:
            low, high = cell.interval
            axes.plot((x, x), (100 * low, 100 * high), color=look.colour, linewidth=0.9, alpha=0.7)
        face = look.colour if cell.complete else "white"
        style = {"color": look.colour, "markerfacecolor": face, "markersize": look.size}
        axes.plot(x, y, look.marker, **style, clip_on=False, zorder=3)  # whole at 0 and at 100%
    return ys[-1]


def as_published(look: Look) -> Look:
    """Return the look of a published curve: short dashes as points, a dashed line."""
    return Look(f"{look.label}, published", look.colour, "_", (0, (4, 2)), 1.2)


def keys(cells: Cells, *, published: bool) -> list[Look]:
    """Return what a legend has to explain beside the systems, as far as it is drawn.

    Args:
        cells: Those that the figure draws.
        published: Whether it draws published rates.
    """
    incomplete = any(not cell.complete for cell in cells.values())
    return [INCOMPLETE] * incomplete + [PUBLISHED] * published


def published_curves(
    axes: Any, data: Data, shifts: Mapping[str, float]
) -> list[tuple[float, Look]]:
    """Draw published rates at the systems' shifts; return the ends of curves and their looks.

    Points are short dashes. Those of a system whose rows are not here, but stand behind a
    retrieval step, are joined to a curve.
    """
    ends = []
    for system, shift in shifts.items():
        known = {one.condition: one for one in data.published if one.system == system}
        found = [known[c] for c in data.conditions if c in known]
        if not found:
            continue
        look = as_published(data.looks[system])
        xs = [data.x(one.condition) + shift for one in found]
        ys = [100 * one.rate for one in found]
        absent = system not in data.systems
        start = int(found[0].condition == NO_HISTORY)
        if absent:
            axes.plot(xs[start:], ys[start:], linestyle=look.line, color=look.colour, linewidth=1.2)
            for x, one in zip(xs, found, strict=True):
                bounds = [100 * bound for bound in one.interval]
                axes.plot((x, x), bounds, color=look.colour, linewidth=0.9, alpha=0.7)
            ends.append((ys[-1], look))
        axes.plot(
            xs,
            ys,
            look.marker,
            color=look.colour,
            markersize=look.size,
            markeredgewidth=look.edge,
        )
    return ends


def set_axes(axes: Any, data: Data, conditions: Sequence[str], ylabel: str) -> None:
    """Name the conditions, start at zero, and take away what carries nothing."""
    tidy(axes)
    places = [data.x(condition) for condition in conditions]
    axes.set_xticks(places, [short(condition) for condition in conditions])
    axes.set_xlim(places[0] - 0.4, places[-1] + 0.4)
    axes.set_ylim(0, min(max(axes.get_ylim()[1], 10), 103))
    if ylabel:
        axes.set_ylabel(ylabel, size=8, color=INK)


def legend(figure: Any, looks: Sequence[Look], note: str = "") -> None:
    """Lay out the panels above a legend."""
    widest = 0.7 + inches(max((look.label for look in looks), key=len))
    columns = max(1, min(len(looks), int(figure.get_figwidth() / widest)))
    rows = -(-len(looks) // columns)
    height = (0.2 * rows + 0.3) / figure.get_figheight()
    figure.tight_layout(rect=(0, height, 1, 1))
    explain(figure, looks, note, columns)


def explain(figure: Any, looks: Sequence[Look], note: str = "", columns: int = 2) -> None:
    """Write a legend at the foot of a figure, and a note under it."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D(
            [],
            [],
            color=look.colour,
            marker=look.marker,
            linestyle=look.line,
            markerfacecolor="white" if look.hollow else look.colour,
            markersize=look.size,
            markeredgewidth=look.edge,
            linewidth=look.width,
        )
        for look in looks
    ]
    if looks:
        figure.legend(
            handles,
            [look.label for look in looks],
            loc="lower center",
            ncols=columns,
            fontsize=8,
            frameon=False,
            handlelength=3.2,  # long enough for a line's dashes to be seen
            bbox_to_anchor=(0.5, (0.16 if note else 0.02) / figure.get_figheight()),
        )
    if note:
        place = 0.06 / figure.get_figheight()
        figure.text(0.5, place, note, size=7.5, color=INK, ha="center", va="bottom")


def short(condition: str) -> str:
    """Return a condition as axes name it."""
    return "none" if condition == NO_HISTORY else condition
