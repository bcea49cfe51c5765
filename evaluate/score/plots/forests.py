"""Figures of differences and shares, a row each, with their intervals."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from textwrap import fill
from typing import Any

from robomme_interference_data.evaluate.score.comparisons.contrast import (
    COMPARISONS,
    START,
    Contrast,
)
from robomme_interference_data.schema.conditions import KINDS, parse_condition
from robomme_interference_data.stats.bootstrap import Interval
from robomme_interference_data.stats.significance import ALPHA
from robomme_interference_data.viz.figure import GREY, INK, Hue, tidy

from .curves import label_ends, legend, mark, panel_grid, points_with_bars, set_axes, short
from .data import Data
from .styles import SeriesStyle

_FLIPS = 0.06
"""Share of outcomes that flip when RoboMME's episodes are repeated on a GPU, at the least."""

_LEVELS = {
    "all": SeriesStyle("all kept", Hue.BLUE, "o", "-"),
    "some": SeriesStyle("some kept", Hue.ORANGE, "s", "--"),
    "none": SeriesStyle("none kept", Hue.VERMILION, "^", ":"),
}

_HOLLOW = "hollow: cell not complete"
_Groups = dict[str, dict[str, Contrast]]
"""What is compared, in words, to each system's comparison."""


def _points(one: Contrast) -> Interval:
    return Interval(*(100 * value for value in one.pairs.change))


def draw_rows(
    axes: Any,
    data: Data,
    rows: Iterable[tuple[int, Contrast]],
    value: Callable[[Contrast], Interval] = _points,
    guides: Mapping[float, str] | None = None,
) -> None:
    """Draw values with their intervals, each in its row, hollow where a cell is not complete.

    Bounds that are NaN are left out. `guides` has for values the styles of upright lines at them.
    """
    for place, line in (guides or {0: "-"}).items():
        axes.axvline(place, color=GREY, linewidth=0.8, linestyle=line, zorder=0)
    for row, contrast in rows:
        style, (middle, low, high) = data.styles[contrast.system], value(contrast)
        drawn = []
        if not math.isnan(low):
            drawn += axes.plot((low, high), (row, row), color=style.colour, linewidth=1.5)
        face = style.colour if contrast.complete else "white"
        drawn += axes.plot(middle, row, **style.point | {"markerfacecolor": face})
        mark(drawn, contrast.system)
    tidy(axes)


def effects(figure: Any, data: Data) -> bool:
    """Draw what each condition with sessions changes, system by system, over a band of noise."""
    own = [c for c in data.contrasts if c.pairs.n and parse_condition(c.condition).kind.name == "k"]
    last = max((parse_condition(c.condition).k for c in own), default=0)
    found: _Groups = {}
    for one in own:
        name = ""
        if one.table == "lift" and one.condition == START:
            name = f"{START} − {short(one.against[1])}"
        elif one.table == "effects" and one.against == (one.system, START):
            name = f"{one.condition} − {START}"
        elif one.table == "effects" and parse_condition(one.condition).k == last:
            name = f"{one.condition}, with − without retrieval"
        if name:
            found.setdefault(name, {})[one.system] = one
    if not found:
        return False
    flips = _FLIPS if data.flips is None else data.flips
    source = "assumed, there are no repeats" if data.flips is None else "measured over repeats"
    most = max(c.pairs.n for group in found.values() for c in group.values())
    band = 196 * math.sqrt(flips / most)
    note = (
        f"grey: ±{band:.1f} points, which chance alone stays within in 95% of comparisons of "
        f"{most} episodes if {100 * flips:.0f}% of outcomes flip between repeats ({source})"
    )
    title = f"What each condition changes, paired over episodes, {data.simulator}"
    _forest(figure, data, found, title, "difference of success, points", band, note)
    return True


def ceiling(figure: Any, data: Data) -> bool:
    """Draw how far systems stay below the ideal observer with their memory."""
    found: _Groups = {}
    for one in data.contrasts:
        if one.table == "ceiling" and one.pairs.n:
            found.setdefault(one.condition, {})[one.system] = one
    if not found:
        return False
    title = f"Gap to the ideal observer with the same memory, {data.simulator}"
    _forest(figure, data, found, title, "system − ideal observer, points")
    return True


def _forest(
    figure: Any,
    data: Data,
    found: _Groups,
    title: str,
    xlabel: str,
    band: float = 0.0,
    note: str = "",
) -> None:
    """Draw a panel for each comparison, named by what is compared, and a row for each system.

    The band, in points, lies around zero. The systems whose last comparison in common with most
    is the highest stand first.
    """
    sizes = [len(group) for group in found.values()]
    leading = next(group for group in reversed([*found.values()]) if len(group) == max(sizes))
    systems = [one for one in data.systems if any(one in group for group in found.values())]
    ranked = sorted(
        systems, key=lambda s: -leading[s].pairs.change.value if s in leading else math.inf
    )
    figure.set_size_inches(10, 1.5 + 0.27 * max(3, len(ranked)))
    panels = panel_grid(figure, len(found), len(found))
    for axes, (name, group) in zip(panels, found.items(), strict=True):
        if band:
            axes.axvspan(-band, band, color=GREY, alpha=0.2, linewidth=0, zorder=0)
        draw_rows(axes, data, ((ranked.index(system), one) for system, one in group.items()))
        axes.set_title(fill(name, 22), size=9, color=INK)
    panels[0].set_yticks(range(len(ranked)), [data.styles[system].label for system in ranked])
    panels[0].set_ylim(len(ranked) - 0.4, -0.6)
    figure.suptitle(title, size=10, color=INK)
    lines = [f"{xlabel}; bars: 95% intervals", _hollow(found), fill(note, 150)]
    legend(figure, "\n".join(filter(None, lines)))


def _hollow(found: _Groups) -> str:
    whole = all(one.complete for group in found.values() for one in group.values())
    return "" if whole else _HOLLOW


def retention(figure: Any, data: Data) -> bool:
    """Draw what is left of each system's lift at the most sessions."""
    lifts = (one for one in data.contrasts if one.table == "lift")
    found = [c for c in lifts if not math.isnan(c.retention.value)]
    if not found:
        return False
    last = max((c.condition for c in found), key=lambda name: parse_condition(name).k)
    found = sorted(
        (c for c in found if c.condition == last), key=lambda c: (c.complete, c.retention.value)
    )
    shown = {contrast.system for contrast in found}
    absent = [data.styles[system].label for system in data.systems if system not in shown]
    note = fill(
        f"Not shown (no lift at k0 with p < {ALPHA}, or rows missing at {last}): "
        f"{', '.join(absent)}",
        110,
    )
    figure.set_size_inches(8, 1.4 + 0.3 * max(2, len(found)))
    axes = figure.subplots()
    draw_rows(axes, data, enumerate(found), lambda one: one.retention, {0: "-", 1: "--"})
    axes.grid(visible=False)
    labels = [data.styles[c.system].label + ("" if c.complete else " † not ranked") for c in found]
    axes.set_yticks(range(len(found)), labels)
    axes.set_ylim(-0.6, len(found) - 0.4)
    scale = f"({last} − no history) / (k0 − no history); 0 nothing left, 1 all; bars: 95% intervals"
    axes.set_xlabel(scale, size=8, color=INK)
    axes.set_title(f"Retention at {last}, {data.simulator}", loc="left", size=10, color=INK)
    legend(figure, note if absent else "")
    return True


def by_evidence_kept(figure: Any, data: Data) -> bool:
    """Draw success where all, some and none of the evidence was kept, system by system."""
    names = {one.name for one in data.conditions}
    rows = [row for row in data.by_evidence_kept if row[1] in names]
    systems = list(dict.fromkeys(row[0] for row in rows))
    if not systems:
        return False
    wide = min(3, len(systems))
    figure.set_size_inches(max(6.0, 3.6 * wide), 0.9 + 2.3 * -(-len(systems) // wide))
    panels = panel_grid(figure, len(systems), wide)
    ends: dict[str, dict[str, float]] = {system: {} for system in systems}
    for axes, system in zip(panels, systems, strict=True):
        for number, (level, style) in enumerate(_LEVELS.items()):
            cells = [row for row in rows if row[0] == system and row[2] == level]
            if not cells:
                continue
            points = [
                (data.x(condition) + 0.09 * (number - 1), *(100 * value for value in values))
                for _, condition, _, _, *values in cells
            ]
            line = {"linestyle": style.line, "linewidth": style.width}
            mark(points_with_bars(axes, points, style, line), system)
            ends[system][level] = points[-1][1]
        axes.set_title(data.styles[system].label, size=9, color=INK)
    for number, (axes, system) in enumerate(zip(panels, systems, strict=True)):
        set_axes(axes, data, systems, "" if number % wide else "success, %")
        label_ends(axes, ends[system], _LEVELS, 1.8, 7, system)
    note = "Different episodes: nothing is paired. Bars: 95% Wilson intervals; n in the table."
    legend(figure, f"Where all, some or none of the evidence was in the memory. {note}")
    return True


def interference(figure: Any, data: Data) -> bool:
    """Draw which kind of interference hurts, at equally many sessions."""
    asked = {one.system for one in data.contrasts if one.asks and one.pairs.n}
    systems = [system for system in data.systems if system in asked]
    if not systems:
        return False
    shown = _most_asked([one for one in data.contrasts if one.system in asked])
    wide = min(3, len(systems))
    rows = -(-len(systems) // wide)
    figure.set_size_inches(7.5, 0.7 + (0.5 + 0.34 * len(shown)) * rows)
    panels = panel_grid(figure, len(systems), wide)
    for axes, system in zip(panels, systems, strict=True):
        found = enumerate(group.get(system) for group in shown.values())
        draw_rows(axes, data, ((place, one) for place, one in found if one))
        axes.set_yticks(range(len(shown)), list(shown), size=7)
        axes.set_title(fill(data.styles[system].label, 26), size=9, color=INK)
    panels[0].set_ylim(len(shown) - 0.5, -0.5)  # downwards, as in the table
    figure.supxlabel("difference of success, points, with 95% intervals", size=8, color=INK)
    legend(figure, _hollow(shown))
    return True


def _most_asked(contrasts: Sequence[Contrast]) -> _Groups:
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
    for asks in (KINDS["k"].asks, *(one.asks for one in COMPARISONS.values())):
        if by_k := found.get(asks):
            chosen = by_k.get(most) or by_k[max(by_k)]
            name = f"{asks}\n{chosen[0].condition} − {chosen[0].against[1]}"
            shown[name] = {one.system: one for one in chosen}
    return shown
