"""Figures of a score, one set for each simulator."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from robomme_interference_data.conditions import DEFAULT_CONDITIONS, KINDS, parse_condition
from robomme_interference_data.constants import DIFFICULTIES, FAMILIES
from robomme_interference_data.drawing import GREY, INK, ink_on, open_figure, save_figure, tidy
from robomme_interference_data.evaluate.score import curves
from robomme_interference_data.evaluate.score.contrasts import QUESTIONS, START, Contrast
from robomme_interference_data.evaluate.score.curves import Data, curve, explained, legend
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import base_of
from robomme_interference_data.significance import SURE

_PAPER = {parse_condition(one).kind for one in DEFAULT_CONDITIONS}
_ALL_KINDS = ("heatmap", "kinds", "interference")
"""Figures of all kinds of conditions; the others show the paper's."""

_ALL = "All families"

_FEW = 4
"""Up to so many systems, small panels show intervals."""

FIGURES = {
    "success": "Success by condition, all families",
    "families": "Success by condition, family by family",
    "difficulty": "Success by condition, by difficulty",
    "retention": "What is left of the lift at the most sessions",
    "heatmap": "Success by family and condition",
    "retrieval": "Retrieval against the same system without it",
    "kinds": "Success by condition, kind by kind",
    "interference": "What kind of interference hurts",
}
"""Name to what a figure shows."""


def draw_figures(score: Score, folder: Path, *, png: bool = False) -> dict[str, Path]:
    """Draw every figure for which there is data, as `<figure>-<simulator>.svg`.

    Args:
        score: What is drawn.
        folder: Where to write.
        png: Whether to write each as `.png`, too.

    Returns:
        Name without suffix to the SVG, in the order of `FIGURES`.
    """
    drawn = {}
    for simulator in score.cubes:
        data = Data(score, simulator)
        for kind in FIGURES:
            with open_figure() as figure:
                if draw_figure(kind, figure, data):
                    name = f"{kind}-{simulator}"
                    for suffix in (".svg", *[".png"] * png):
                        save_figure(figure, folder / (name + suffix))
                    drawn[name] = folder / f"{name}.svg"
    return drawn


def draw_figure(kind: str, figure: Any, data: Data) -> bool:
    """Draw one of `FIGURES`, and tell whether there is data for it."""
    drawers = (
        *(_success, _families, _difficulty, _retention, _heatmap, _retrieval),
        *(_kinds, _interference),
    )
    shown = data if kind in _ALL_KINDS else data.of(_PAPER)
    figure.set_layout_engine("constrained")
    if not (shown.cells and dict(zip(FIGURES, drawers, strict=True))[kind](figure, shown)):
        return False
    figure.get_layout_engine().execute(figure)
    figure.set_layout_engine("none")  # once, not again for each file
    return True


def _success(figure: Any, data: Data) -> bool:
    few = len(data.systems) <= _FEW
    shifts = dict(curves.dodged([*data.systems, *data.absent]))
    figure.set_size_inches(7.5, 4.2 if few else 5.5)
    axes = figure.subplots()
    ends = [end for name in shifts for end in curve(axes, data, name, "", shifts[name])]
    # Beside many systems' own points the published ones would only clutter.
    beside = data.beside if few else []
    for name in beside:
        curve(axes, data, name, "", shifts[name.removesuffix(", published")], bars=False)
    curves.set_axes(axes, data, [*shifts, *beside], "success, %")
    curves.label_ends(axes, ends, axes.get_ylim()[1] * (0.05 if few else 0.04))
    note = "published rates: in the table" if len(beside) < len(data.beside) else ""
    legend(figure, [], explained(data, [*shifts, *beside], [""], note))
    title = f"Success by condition, {data.simulator}, with 95% Wilson intervals"
    axes.set_title(title, loc="left", size=10, color=INK)
    return True


def _families(figure: Any, data: Data) -> bool:
    panels = {part: (data, part) for part in data.parts(FAMILIES)}
    return _panels(figure, data, panels, data.systems, wide=3, height=2.0)


def _difficulty(figure: Any, data: Data) -> bool:
    panels = {part: (data, part) for part in data.parts(DIFFICULTIES)}
    return _panels(figure, data, panels, data.systems, wide=len(panels), height=2.7)


def _retrieval(figure: Any, data: Data) -> bool:
    systems = []
    for system in data.systems:
        for base in (base_of(system), f"{base_of(system)}, published"):
            systems += [system, base] if base in (*data.systems, *data.absent) else []
    panels = {part or _ALL: (data, part) for part in ("", *data.parts(FAMILIES))}
    return _panels(figure, data, panels, systems, wide=5, height=2.1)


def _kinds(figure: Any, data: Data) -> bool:
    if _PAPER.issuperset(data.kinds):
        return False
    plain = [kind for kind in data.kinds if not kind.counted]  # in each panel, as the floor
    counted = [kind for kind in data.kinds if kind.counted]
    panels = {kind.pattern: (data.of([*plain, kind]), "") for kind in counted}
    return _panels(figure, data, panels, data.systems, wide=3, height=2.0)


def _panels(
    figure: Any,
    data: Data,
    panels: Mapping[str, tuple[Data, str]],
    systems: Sequence[str],
    wide: int,
    height: float,
) -> bool:
    """Draw panels of `height` inches, `wide` in a row, on the axes of `data`.

    `panels` has for each title which of the data it shows, and which part of the episodes.
    """
    if not (panels and systems):
        return False
    rows = -(-len(panels) // wide)
    figure.set_size_inches(2 * wide if wide > 3 else 7.5, 0.9 + height * rows)
    grid = figure.subplots(rows, wide, sharex=True, sharey=True, squeeze=False)
    bars = len(systems) <= _FEW
    for axes, (title, (shown, part)) in zip(grid.flat, panels.items(), strict=False):
        for system, shift in curves.dodged(systems):
            curve(axes, shown, system, part, shift, bars=bars)
        axes.set_title(title, size=9, color=INK, weight="bold" if title == _ALL else "normal")
    for number, axes in enumerate(grid.flat):
        if number < len(panels):
            curves.set_axes(axes, data, systems, "" if number % wide else "success, %")
            axes.tick_params(labelbottom=number + wide >= len(panels))  # nothing below
        else:
            axes.set_axis_off()
    note = f"95% {'Wilson intervals' if bars else 'intervals: in the table'}"
    looks = [data.looks[system] for system in systems]
    legend(figure, looks, explained(data, systems, [p for _, p in panels.values()], note))
    return True


def _retention(figure: Any, data: Data) -> bool:
    lifts = (one for one in data.contrasts if one.table == "lift")
    found = [c for c in lifts if not math.isnan(c.retention.value)]
    if not found:
        return False
    last = max((c.condition for c in found), key=lambda name: parse_condition(name).k)
    found = sorted(
        (c for c in found if c.condition == last), key=lambda c: (c.complete, c.retention.value)
    )
    shown = {contrast.system for contrast in found}
    absent = [data.looks[system].label for system in data.systems if system not in shown]
    note = fill(
        f"Not shown (no lift at k0 with p < {SURE}, or rows missing at {last}): "
        f"{', '.join(absent)}",
        110,
    )
    figure.set_size_inches(7.5, 1.4 + 0.32 * max(2, len(found)))
    axes = figure.subplots()
    for place, contrast in enumerate(found):
        look, kept = data.looks[contrast.system], contrast.retention
        if not math.isnan(kept.low):
            axes.plot((kept.low, kept.high), (place, place), color=look.colour, linewidth=1.6)
        face = look.colour if contrast.complete else "white"
        axes.plot(kept.value, place, **look.point | {"markersize": 7, "markerfacecolor": face})
    for value, style in ((0, "-"), (1, "--")):
        axes.axvline(value, color=GREY, linewidth=0.8, linestyle=style, zorder=0)
    tidy(axes)
    axes.grid(visible=False)
    labels = [data.looks[c.system].label + ("" if c.complete else " † not ranked") for c in found]
    axes.set_yticks(range(len(found)), labels)
    axes.set_ylim(-0.6, len(found) - 0.4)
    scale = f"({last} − no history) / (k0 − no history); 0 nothing left, 1 all; bars: 95% intervals"
    axes.set_xlabel(scale, size=8, color=INK)
    axes.set_title(f"Retention at {last}, {data.simulator}", loc="left", size=10, color=INK)
    legend(figure, [], note if absent else "")
    return True


def _heatmap(figure: Any, data: Data) -> bool:
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    names, conditions = data.parts(FAMILIES), data.shown(data.systems)
    labels = [curves.short(condition) for condition in conditions]
    turned = 90 if max(map(len, labels)) > len("none") else 0
    many = max(5, len(conditions))
    wide = max(1, min(20 // many, len(data.systems)))
    rows = -(-len(data.systems) // wide)
    figure.set_size_inches(1.3 + 1.65 * wide * many / 5, 0.6 + (0.6 + 0.24 * len(names)) * rows)
    panels = figure.subplots(rows, wide, sharey=True, squeeze=False)
    colours = colormaps["cividis"]  # the same to the colour-blind, and even in grey
    highest = max(cell.rate for (*_, part), cell in data.cells.items() if part in names)
    for axes, system in zip(panels.flat, data.systems, strict=False):
        rates = np.full((len(names), len(conditions)), np.nan)
        for (y, name), (x, condition) in product(enumerate(names), enumerate(conditions)):
            if cell := data.cells.get((system, condition, name)):
                rates[y, x] = cell.rate
                text = f"{100 * cell.rate:.0f}" + ("" if cell.complete else "†")
                ink = ink_on(to_hex(colours(cell.rate / highest if highest else 0.0)))
                axes.text(x, y, text, ha="center", va="center", size=7, color=ink)
        axes.imshow(rates, cmap=colours, vmin=0, vmax=highest, aspect="auto")
        axes.set_xticks(range(len(conditions)), labels, size=7, rotation=turned)
        axes.set_yticks(range(len(names)), names, size=7)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        axes.set_title(fill(data.looks[system].label, 26), size=8, color=INK)
    for axes in panels.flat[len(data.systems) :]:
        axes.set_axis_off()
    figure.suptitle(f"Success in %, {data.simulator}", size=9, color=INK)
    return True


def _interference(figure: Any, data: Data) -> bool:
    asked = {one.system for one in data.contrasts if one.asks and one.pairs.n}
    systems = [system for system in data.systems if system in asked]
    if not systems:
        return False
    shown = _most_asked([one for one in data.contrasts if one.system in asked])
    wide = min(3, len(systems))
    rows = -(-len(systems) // wide)
    figure.set_size_inches(7.5, 0.7 + (0.5 + 0.34 * len(shown)) * rows)
    panels = figure.subplots(rows, wide, sharex=True, sharey=True, squeeze=False)
    for number, (axes, system) in enumerate(zip(panels.flat, systems, strict=False)):
        look = data.looks[system]
        axes.axvline(0, color=GREY, linewidth=0.8, zorder=0)
        for place, found in enumerate(shown.values()):
            if contrast := found.get(system):
                change = [100 * value for value in contrast.pairs.change]
                if not math.isnan(change[1]):
                    axes.plot(change[1:], (place, place), color=look.colour, linewidth=1.4)
                face = look.colour if contrast.complete else "white"
                axes.plot(change[0], place, **look.point | {"markerfacecolor": face})
        tidy(axes)
        axes.tick_params(labelbottom=number + wide >= len(systems))  # nothing below
        axes.set_yticks(range(len(shown)), list(shown), size=7)
        axes.set_title(fill(look.label, 26), size=9, color=INK)
    panels[0, 0].set_ylim(len(shown) - 0.5, -0.5)  # downwards, as in the table
    for axes in panels.flat[len(systems) :]:
        axes.set_axis_off()
    figure.supxlabel("difference of success, points, with 95% intervals", size=8, color=INK)
    whole = all(contrast.complete for found in shown.values() for contrast in found.values())
    legend(figure, [], "" if whole else "hollow: cell not complete")
    return True


def _most_asked(contrasts: Iterable[Contrast]) -> dict[str, dict[str, Contrast]]:
    """Return what is asked, in words, to each system's comparison, of equally many sessions.

    They are as many as most questions are answered with, of several the most; where a question is
    not answered with so many, the most that it is answered with.
    """
    found: dict[str, dict[int, list[Contrast]]] = {}
    for one in contrasts:
        condition = parse_condition(one.condition)
        asks = one.asks or condition.kind.asks * (one.against == (one.system, START))
        if asks and one.pairs.n:
            found.setdefault(asks, {}).setdefault(condition.k, []).append(one)
    counts = Counter(k for by_k in found.values() for k in by_k)
    most = max(counts, key=lambda k: (counts[k], k))
    shown = {}
    for asks in (KINDS["k"].asks, *(question.asks for question in QUESTIONS.values())):
        if by_k := found.get(asks):
            chosen = by_k.get(most) or by_k[max(by_k)]
            name = f"{asks}\n{chosen[0].condition} − {chosen[0].against[1]}"
            shown[name] = {one.system: one for one in chosen}
    return shown
