"""Figures of a score, one set for each simulator."""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from robomme_interference_data.constants import DIFFICULTIES
from robomme_interference_data.evaluate.score.comparisons.contrast import Contrast
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import published_base
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS, parse_condition
from robomme_interference_data.simulators.registry import RECORDINGS
from robomme_interference_data.stats.significance import ALPHA
from robomme_interference_data.viz.figure import (
    INK,
    cell_box,
    ink_on,
    mapped,
    open_figure,
    save_figure,
)

from . import curves, forests, offline
from .curves import curve, explained, legend
from .data import FEW, PUBLISHED, Data

_PAPER = {parse_condition(one).kind for one in DEFAULT_CONDITIONS}
_ALL_KINDS = ("heatmap", "kinds", "interference", "ceiling")
"""Figures that show all kinds of conditions; the others show the paper's."""

_ALL = "All families"

FIGURES = {
    "interference": "Effect of each kind of interference",
    "kinds": "Success by condition and kind of condition",
    "effects": "Effect of each condition, paired over episodes",
    "success": "Success by condition, all families",
    "families": "Success by condition and family",
    "difficulty": "Success by condition and difficulty",
    "retention": "Share of the lift that is left at the most sessions",
    "heatmap": "Success by family and condition",
    "retrieval": "Systems with and without retrieval",
    "by_evidence_kept": "Success by whether the memory kept the evidence",
    "ceiling": "Gap to the ideal observer with the same memory",
    "matrix": "Which systems differ significantly",
    "action_error": "Action error by condition",
}
"""Figure to its title, in the order of the report.

The first ones show conditions beyond the paper's, where there are any: they are what such a run is
about, and the figures after them leave them out.
"""


def draw_figures(
    score: Score, folder: Path, suffixes: Sequence[str] = (".svg",)
) -> dict[str, Path]:
    """Draw every figure that has data, as `<figure>-<simulator>` with each suffix.

    Returns the SVGs by name without suffix, in the order of `FIGURES`.
    """
    drawn = {}
    for simulator in score.outcomes:
        data = Data(score, simulator)
        for kind in _DRAWERS:
            with open_figure() as figure:
                if draw_figure(kind, figure, data):
                    name = f"{kind}-{simulator}"
                    for suffix in suffixes:
                        save_figure(figure, folder / (name + suffix))
                    drawn[name] = folder / f"{name}.svg"
    if any(cell.n for cell in score.error_cells):
        with open_figure() as figure:
            draw_error_figure(figure, score)
            name = f"action_error-{RECORDINGS}"
            for suffix in suffixes:
                save_figure(figure, folder / (name + suffix))
            drawn[name] = folder / f"{name}.svg"
    return drawn


def draw_error_figure(figure: Any, score: Score) -> None:
    """Draw the figure of offline runs."""
    figure.set_layout_engine("constrained")
    offline.action_error(figure, score)
    _finish(figure)


def draw_figure(kind: str, figure: Any, data: Data) -> bool:
    """Draw one of `FIGURES`; return False if there is no data for it."""
    shown = data if kind in _ALL_KINDS else data.of(_PAPER)
    figure.set_layout_engine("constrained")
    if not (shown.cells and _DRAWERS[kind](figure, shown)):
        return False
    _finish(figure)
    return True


def _finish(figure: Any) -> None:
    """Lay out a drawn figure, and give its marked elements ids."""
    figure.get_layout_engine().execute(figure)
    figure.set_layout_engine("none")  # once, not again for each file
    for number, artist in enumerate(figure.findobj(lambda one: one.get_gid())):
        artist.set_gid(f"{artist.get_gid()}:{number}")  # ids must be unique in a file


def _success(figure: Any, data: Data) -> bool:
    few = len(data.systems) <= FEW
    systems = [*data.systems, *data.absent]
    places = curves.shifts(systems, min(0.09, 0.55 / len(systems)))
    high = 4.2 if few else 5.5
    figure.set_size_inches(curves.WIDTH, high)
    axes = figure.subplots()
    ends: dict[str, float] = {}
    for name, shift in places.items():
        ends |= curve(axes, data, name, "", shift)
    # With many systems, published points would be clutter.
    beside = data.beside if few else []
    for name in beside:
        shift = places[name.removesuffix(", published")]
        curve(axes, data, name, "", shift, bars=False)
    ends |= curves.chance_level(axes, data, "")
    curves.set_axes(axes, data, [*places, *beside], "success, %")
    curves.label_ends(axes, ends, data.styles, high - 1, curves.LABEL)
    note = "published rates: in the table “paper”" if len(beside) < len(data.beside) else ""
    legend(figure, explained(data, [*places, *beside], [""], note))
    title = f"Success by condition, {data.simulator}, with 95% Wilson intervals"
    axes.set_title(title, loc="left", size=curves.TITLE, color=INK)
    return True


def _families(figure: Any, data: Data) -> bool:
    panels = {part: (data, part) for part in data.parts(data.families)}
    few = len(data.systems) <= FEW
    published = [name for name in (*data.absent, *data.beside) if few and data.has_parts(name)]
    return _panels(figure, data, panels, [*data.systems, *published])


def _difficulty(figure: Any, data: Data) -> bool:
    panels = {part: (data, part) for part in data.parts(DIFFICULTIES)}
    return _panels(figure, data, panels, data.systems)


def _retrieval(figure: Any, data: Data) -> bool:
    systems = []
    for system in data.systems:
        bases = (data.bases[system], f"{published_base(system)}{PUBLISHED}")
        for base in bases:
            if base in (*data.systems, *data.absent):
                systems += [system, base]
    panels = {part or _ALL: (data, part) for part in ("", *data.parts(data.families))}
    return _panels(figure, data, panels, systems)


def _kinds(figure: Any, data: Data) -> bool:
    if _PAPER.issuperset(data.kinds):
        return False
    plain = [kind for kind in data.kinds if not kind.counted]  # the floor of each panel
    counted = [kind for kind in data.kinds if kind.counted]
    panels = {kind.pattern: (data.of([*plain, kind]), "") for kind in counted}
    return _panels(figure, data, panels, data.systems)


def _panels(
    figure: Any, data: Data, panels: Mapping[str, tuple[Data, str]], systems: Sequence[str]
) -> bool:
    """Draw panels, three in a row: each title to its data and its part of the episodes."""
    if not (panels and systems):
        return False
    wide, bars = 3, len(systems) <= FEW
    high = 2.0 if bars else 2.4
    figure.set_size_inches(curves.WIDTH, 0.9 + high * -(-len(panels) // wide))
    grid = curves.panel_grid(figure, len(panels), wide)
    ends: list[dict[str, float]] = []
    for axes, (title, (shown, part)) in zip(grid, panels.items(), strict=True):
        ends.append({})
        for system, shift in curves.shifts(systems, 0.09 * bars).items():
            ends[-1] |= curve(axes, shown, system, part, shift, bars=bars)
        ends[-1] |= curves.chance_level(axes, shown, part)
        axes.set_title(
            title, size=curves.HEADING, color=INK, weight="bold" if title == _ALL else "normal"
        )
    for number, axes in enumerate(grid):
        curves.set_axes(axes, data, systems, "" if number % wide else "success, %")
    for axes, found in zip(grid, ends, strict=True):
        curves.label_ends(axes, found, data.styles, high - 0.45, curves.SMALL)
    note = f"95% {'Wilson intervals' if bars else 'intervals: in the table'}"
    legend(figure, explained(data, systems, [p for _, p in panels.values()], note))
    return True


def _heatmap(figure: Any, data: Data) -> bool:
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


def _matrix(figure: Any, data: Data) -> bool:
    """Draw all pairs of systems at k0 and at the most sessions: the row's rate − the column's."""
    pairs = [one for one in data.contrasts if one.table == "matrix"]
    last = max((parse_condition(one.condition).k for one in pairs), default=0)
    shown = [c.name for c in data.conditions if c.kind.counted and c.k in (0, last)]
    panels = {name: found for name in shown if (found := [p for p in pairs if p.condition == name])}
    # Two systems make a single difference, which the other figures show.
    most = max(
        (
            len({name for one in found for name in (one.system, one.against[0])})
            for found in panels.values()
        ),
        default=0,
    )
    if most < 3:
        return False
    figure.set_size_inches(curves.WIDTH, 1.6 + 0.5 * most)
    widest = 100 * max(abs(one.pairs.change.value) for one in pairs)
    for axes, (condition, found) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        _pairs(axes, data, condition, found, widest)
    figure.suptitle(
        f"Success of the row's system minus the column's, points, {data.simulator}",
        size=curves.TITLE,
        color=INK,
    )
    legend(figure, f"colored and bold: p < {ALPHA} after Holm's correction; gray: not significant")
    return True


def _pairs(axes: Any, data: Data, condition: str, found: Sequence[Contrast], widest: float) -> None:
    """Draw the differences of each system to those below it, by their rates."""
    changes = {(one.system, one.against[0]): 100 * one.pairs.change.value for one in found}
    changes |= {(other, one): -change for (one, other), change in changes.items()}
    systems = sorted(
        (one for one in data.systems if any(one in two for two in changes)),
        key=lambda s: -data.cells[s, condition, ""].rate,
    )
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


_DRAWERS = {
    "interference": forests.interference,
    "kinds": _kinds,
    "effects": forests.effects,
    "success": _success,
    "families": _families,
    "difficulty": _difficulty,
    "retention": forests.retention,
    "heatmap": _heatmap,
    "retrieval": _retrieval,
    "by_evidence_kept": forests.by_evidence_kept,
    "ceiling": forests.ceiling,
    "matrix": _matrix,
}
