"""Figures of numbers in a grid: rates by family and condition, and differences of systems."""

from collections.abc import Sequence
from itertools import product
from textwrap import fill
from typing import Any

import numpy as np

from robomme_interference_data.evaluate.score.tables.contrast import Contrast, Effect
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.stats.significance import ALPHA
from robomme_interference_data.viz.figure import INK, cell_box, ink_on, mapped

from . import curves
from .curves import legend
from .data import Data


def heatmap(figure: Any, data: Data) -> bool:
    """Draw the rate of each family under each condition, a panel for each system."""
    names, conditions = data.parts(data.families), data.shown(data.systems)
    labels = [curves.short(condition) for condition in conditions]
    turned = 90 if max(map(len, labels)) > len("none") else 0
    many = max(5, len(conditions))
    rows = -(-len(data.systems) // max(1, 25 // many))
    wide = -(-len(data.systems) // rows)
    figure.set_size_inches(curves.WIDTH, 0.6 + (0.6 + 0.24 * len(names)) * rows)
    panels = curves.panel_grid(figure, len(data.systems), wide, sharex=False)
    colors = "cividis"  # readable with color vision deficiency, and in gray
    highest = max(cell.rate for (*_, part), cell in data.cells.items() if part in names)
    for axes, system in zip(panels, data.systems, strict=True):
        rates = np.full((len(names), len(conditions)), np.nan)
        for (y, name), (x, condition) in product(enumerate(names), enumerate(conditions)):
            if cell := data.cells.get((system, condition, name)):
                rates[y, x] = cell.rate
                text = f"{100 * cell.rate:.0f}" + ("" if cell.complete else "†")
                ink = ink_on(mapped(colors, cell.rate / highest if highest else 0.0))
                inside: dict[str, Any] = {"ha": "center", "va": "center", "in_layout": False}
                axes.text(x, y, text, **inside, size=curves.SMALL, color=ink)
        axes.imshow(rates, cmap=colors, vmin=0, vmax=highest, aspect="auto")
        axes.set_xticks(range(len(conditions)), labels, size=curves.SMALL, rotation=turned)
        axes.set_yticks(range(len(names)), names, size=curves.SMALL)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        label = fill(data.styles[system].label, max(10, 100 // wide))
        axes.set_title(label, size=curves.HEADING, color=INK)
    figure.suptitle(
        f"Success by family and condition, %, {data.simulator}", size=curves.TITLE, color=INK
    )
    return True


def matrix(figure: Any, data: Data) -> bool:
    """Draw all pairs of systems at k0 and at the most sessions: the row's rate − the column's."""
    pairs = [contrast for contrast in data.contrasts if contrast.effect is Effect.SYSTEMS]
    last = max((parse_condition(contrast.condition).k for contrast in pairs), default=0)
    panels: dict[str, list[Contrast]] = {}
    for condition in data.conditions:
        own = [contrast for contrast in pairs if contrast.condition == condition.name]
        if own and condition.kind.counted and condition.k in (0, last):
            panels[condition.name] = own
    most = max((len(_systems_of(own)) for own in panels.values()), default=0)
    if most < 3:  # two systems make a single difference, which the other figures show
        return False
    figure.set_size_inches(curves.WIDTH, 1.6 + 0.5 * most)
    widest = 100 * max(abs(contrast.pairs.change.value) for contrast in pairs)
    grid = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (name, own) in zip(grid, panels.items(), strict=True):
        _pairs(axes, data, name, own, widest)
    figure.suptitle(
        f"Success of the row's system minus the column's, points, {data.simulator}",
        size=curves.TITLE,
        color=INK,
    )
    legend(figure, f"colored and bold: p < {ALPHA} after Holm's correction; gray: not significant")
    return True


def _systems_of(contrasts: Sequence[Contrast]) -> set[str]:
    """Return the systems that are compared."""
    systems = {contrast.system for contrast in contrasts}
    return systems | {contrast.against[0] for contrast in contrasts}


def _pairs(
    axes: Any, data: Data, condition: str, contrasts: Sequence[Contrast], widest: float
) -> None:
    """Draw the differences of each system to those below it, by their rates."""
    changes = dict[tuple[str, str], float]()
    for contrast in contrasts:
        change = 100 * contrast.pairs.change.value
        changes[contrast.system, contrast.against[0]] = change
        changes[contrast.against[0], contrast.system] = -change
    compared = _systems_of(contrasts)
    systems = [system for system in data.systems if system in compared]
    systems.sort(key=lambda system: -data.cells[system, condition, ""].rate)
    # The best system is no column, and the last one no row: they would be empty.
    rows, columns = systems[:-1], systems[1:]
    values = np.full((len(rows), len(columns)), np.nan)
    for (y, row), (x, column) in product(enumerate(rows), enumerate(columns)):
        if x < y:
            continue
        differ = (condition, frozenset((row, column))) in data.distinguishable
        change = changes[row, column]
        style: dict[str, Any] = {"weight": "bold", "color": "black"} if differ else {"color": INK}
        style |= {"ha": "center", "va": "center", "in_layout": False, "size": curves.SMALL}
        axes.text(x, y, f"{round(change) + 0:.0f}".replace("-", "−"), **style)
        if differ:
            values[y, x] = change
        else:
            axes.add_patch(cell_box(x, y))
    axes.imshow(values, cmap="RdBu", vmin=-2 * widest, vmax=2 * widest, aspect="auto")
    turned = len(columns) > 3
    heads = [data.styles[name].label for name in columns]
    if not turned:
        heads = [fill(head, 20) for head in heads]
    names = [fill(data.styles[name].label, 20) for name in rows]
    axes.set_xticks(range(len(columns)), heads, size=curves.SMALL, rotation=90 if turned else 0)
    axes.set_yticks(range(len(rows)), names, size=curves.SMALL)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_title(condition, size=curves.HEADING, color=INK)
