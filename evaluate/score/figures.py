"""Figures of a score, one set for each simulator."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.rows import condition_rank
from robomme_interference_data.evaluate.score.check import DIFFICULTIES
from robomme_interference_data.evaluate.score.curves import (
    Cells,
    Data,
    as_published,
    curve,
    dodged,
    explain,
    keys,
    legend,
    published_curves,
    set_axes,
    short,
)
from robomme_interference_data.evaluate.score.effects import SURE, Contrast, base_of
from robomme_interference_data.evaluate.score.looks import inches, label_ends
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.page import GREY, INK, ink_on, open_figure, save_figure, tidy

__all__ = ["FIGURES", "draw_figures"]

_FEW = 4
"""Up to so many systems, small panels show intervals."""

FIGURES = {
    "success": "Success by condition, all families",
    "families": "Success by condition, family by family",
    "difficulty": "Success by condition, by difficulty",
    "retention": "What is left of the lift at the most sessions",
    "heatmap": "Success by family and condition",
    "retrieval": "Retrieval against the same system without it",
}
"""Name to what a figure shows."""


def draw_figures(score: Score, folder: Path) -> dict[str, Path]:
    """Draw every figure for which there is data, as `<figure>-<simulator>.svg` and `.png`.

    Returns:
        Name without suffix to the SVG, in the order of `FIGURES`.
    """
    kinds: dict[str, Callable[[Any, Data], bool]] = {
        "success": _success,
        "families": _families,
        "difficulty": _difficulty,
        "retention": _retention,
        "heatmap": _heatmap,
        "retrieval": _retrieval,
    }
    drawn = {}
    for simulator in score.expected:
        data = Data(score, simulator)
        for kind, draw in kinds.items():
            with open_figure() as figure:
                if data.all and draw(figure, data):
                    name = f"{kind}-{simulator}"
                    for suffix in (".png", ".svg"):
                        save_figure(figure, folder / (name + suffix))
                    drawn[name] = folder / f"{name}.svg"
    return drawn


def _success(figure: Any, data: Data) -> bool:
    few = len(data.systems) <= _FEW
    shown = [*data.systems, *(b for b in data.bases if b not in data.systems)]
    shifts = {system: shift for shift, system in dodged(shown)}
    labels = [data.looks[system].label for system in data.systems]
    labels += [as_published(data.looks[base]).label for base in shown[len(data.systems) :]]
    # Beside many systems' own points the published ones would only clutter.
    beside = shifts if few else {b: shifts[b] for b in shown if b not in data.systems}
    published = {one.system for one in data.published}
    explained = keys(data.all, published=bool(published & set(beside)))
    shared = published & set(data.systems)
    note = "" if shared <= set(beside) else "published rates: in the table"
    foot = 0.65 if explained or note else 0.42
    width, height, plot = 5.8 + inches(max(labels, key=len)), foot + (3.8 if few else 5.0), 4.7
    figure.set_size_inches(width, height)
    axes = figure.add_axes((0.65 / width, foot / height, plot / width, 1 - (foot + 0.38) / height))
    ends = [
        (curve(axes, data, data.all, system, "", shifts[system]), data.looks[system])
        for system in data.systems
    ]
    ends += published_curves(axes, data, beside)
    explain(figure, explained, note)
    set_axes(axes, data, data.conditions, "success, %")
    ends = [end for end in ends if not math.isnan(end[0])]
    span = axes.get_ylim()[1]
    label_ends(axes, plot, ends, span * (0.05 if few else 0.04))
    axes.set_title(
        f"Success by condition, {data.simulator}, with 95% Wilson intervals",
        loc="left",
        size=10,
        color=INK,
    )
    return True


def _families(figure: Any, data: Data) -> bool:
    names = [name for name in FAMILIES if any(part == name for _, _, part in data.families)]
    rows = -(-len(names) // 3)
    figure.set_size_inches(7.5, 0.9 + 2.0 * rows)
    panels = figure.subplots(rows, 3, sharex=True, sharey=True, squeeze=False).flat
    _panels(figure, data, data.families, list(panels), names)
    return True


def _difficulty(figure: Any, data: Data) -> bool:
    names = [name for name in DIFFICULTIES if any(p == name for _, _, p in data.difficulty)]
    if not names:
        return False
    figure.set_size_inches(7.5, 3.6)
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False).flat
    _panels(figure, data, data.difficulty, list(panels), names)
    return True


def _panels(
    figure: Any, data: Data, cells: Cells, panels: Sequence[Any], names: Sequence[str]
) -> None:
    bars = len(data.systems) <= _FEW
    for axes, name in zip(panels, names, strict=False):
        for dodge, system in dodged(data.systems):
            curve(axes, data, cells, system, name, dodge, bars=bars)
    for axes, name in zip(panels, names, strict=False):
        left = axes in panels[:: _columns(panels)]
        set_axes(axes, data, data.own_conditions, "success, %" if left else "")
        axes.set_title(name, size=9, color=INK)
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    note = "" if bars else "95% intervals: in the table"
    looks = [data.looks[system] for system in data.systems]
    legend(figure, [*looks, *keys(cells, published=False)], note)


def _columns(panels: Sequence[Any]) -> int:
    return int(panels[0].get_gridspec().ncols)


def _retention(figure: Any, data: Data) -> bool:
    found = [c for c in data.lift if not math.isnan(c.retention.value)]
    if not found:
        return False
    last = max({c.condition for c in found}, key=condition_rank)
    found = sorted(
        (c for c in found if c.condition == last),
        key=lambda c: (c.complete, c.retention.value),
    )
    labels = [data.looks[c.system].label + ("" if c.complete else " † not ranked") for c in found]
    left = 0.4 + inches(max(labels, key=len))
    note = _left_out(data, found, last, int((left + 5) / 0.058))
    below = 0.6 + 0.15 * len(note.splitlines())
    height = below + 0.45 + 0.32 * max(2, len(found))
    figure.set_size_inches(left + 5.3, height)
    size = (5 / (left + 5.3), 1 - (below + 0.45) / height)
    axes = figure.add_axes((left / (left + 5.3), below / height, *size))
    if note:
        figure.text(0.1 / (left + 5.3), 0.1 / height, note, size=7.5, color=INK, va="bottom")
    for place, contrast in enumerate(found):
        look, kept = data.looks[contrast.system], contrast.retention
        if not math.isnan(kept.low):
            axes.plot((kept.low, kept.high), (place, place), color=look.colour, linewidth=1.6)
        face = look.colour if contrast.complete else "white"
        axes.plot(
            kept.value, place, look.marker, color=look.colour, markerfacecolor=face, markersize=7
        )
    for value, style in ((0, "-"), (1, "--")):
        axes.axvline(value, color=GREY, linewidth=0.8, linestyle=style, zorder=0)
    tidy(axes)
    axes.grid(visible=False)
    axes.set_yticks(range(len(found)), labels)
    axes.set_ylim(-0.6, len(found) - 0.4)
    axes.set_xlabel(
        f"({last} − no history) / (k0 − no history); 0 nothing left, 1 all; bars: 95% intervals",
        size=8,
        color=INK,
    )
    axes.set_title(f"Retention at {last}, {data.simulator}", loc="left", size=10, color=INK)
    return True


def _left_out(data: Data, found: Sequence[Contrast], last: str, width: int) -> str:
    """Name the systems without a retention, in lines of so many letters."""
    shown = {contrast.system for contrast in found}
    absent = [data.looks[system].label for system in data.systems if system not in shown]
    if not absent:
        return ""
    why = f"no lift at k0 with p < {SURE}, or rows missing at {last}"
    return fill(f"Not shown ({why}): {', '.join(absent)}", width)


def _heatmap(figure: Any, data: Data) -> bool:
    names = [name for name in FAMILIES if any(part == name for _, _, part in data.families)]
    wide = min(4, len(data.systems))
    rows = -(-len(data.systems) // wide)
    figure.set_size_inches(1.3 + 1.65 * wide, 0.6 + (0.6 + 0.24 * len(names)) * rows)
    figure.set_layout_engine("constrained")
    panels = figure.subplots(rows, wide, sharey=True, squeeze=False)
    colours = _colour_map()
    conditions = data.own_conditions
    highest = max(cell.rate for cell in data.families.values())
    for axes, system in zip(panels.flat, data.systems, strict=False):
        rates = [
            [
                cell.rate if (cell := data.families.get((system, c, name))) else math.nan
                for c in conditions
            ]
            for name in names
        ]
        axes.imshow(rates, cmap=colours, vmin=0, vmax=highest, aspect="auto")
        for y, row in enumerate(rates):
            for x, rate in enumerate(row):
                if not math.isnan(rate):
                    ink = ink_on(_hex(colours(rate / highest if highest else 0.0)))
                    cell = data.families[(system, conditions[x], names[y])]
                    mark = "" if cell.complete else "†"
                    axes.text(
                        x, y, f"{100 * rate:.0f}{mark}", ha="center", va="center", size=7, color=ink
                    )
        axes.set_xticks(range(len(conditions)), [short(c) for c in conditions], size=7)
        axes.set_yticks(range(len(names)), names, size=7)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        axes.set_title(fill(data.looks[system].label, 26), size=8, color=INK)
    for axes in panels.flat[len(data.systems) :]:
        axes.set_axis_off()
    figure.suptitle(f"Success in %, {data.simulator}", size=9, color=INK)
    return True


def _retrieval(figure: Any, data: Data) -> bool:
    pairs = [(s, b) for s in data.systems if (b := base_of(s)) is not None]
    known = {one.system for one in data.published} | set(data.systems)
    pairs = [(system, base) for system, base in pairs if base in known]
    if not pairs:
        return False
    shown = [name for pair in pairs for name in pair]
    names = ["", *(f for f in FAMILIES if any(part == f for _, _, part in data.families))]
    rows = -(-len(names) // 5)
    figure.set_size_inches(10, 0.9 + 2.1 * rows)
    panels = list(figure.subplots(rows, 5, sharex=True, sharey=True, squeeze=False).flat)
    for axes, name in zip(panels, names, strict=False):
        cells = data.families if name else data.all
        for dodge, system in dodged([system for system in shown if system in data.systems]):
            curve(axes, data, cells, system, name, dodge)
        if not name:
            published_curves(axes, data, {base: 0 for base in shown if base not in data.systems})
    for axes, name in zip(panels, names, strict=False):
        set_axes(axes, data, data.conditions, "success, %" if axes in panels[::5] else "")
        axes.set_title(
            name or "All families", size=9, color=INK, weight="normal" if name else "bold"
        )
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    looks = [data.looks[name] for name in shown if name in data.systems]
    absent = [data.looks[name] for name in shown if name not in data.systems]
    looks += [*map(as_published, absent)]
    mine = {key: cell for key, cell in data.families.items() if key[0] in shown}
    legend(figure, [*looks, *keys(mine, published=False)], "with 95% Wilson intervals")
    return True


def _colour_map() -> Any:
    from matplotlib import colormaps

    return colormaps["cividis"]  # the same to the colour-blind, and even in grey


def _hex(colour: Any) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in colour[:3])
