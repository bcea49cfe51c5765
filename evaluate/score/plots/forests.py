"""Figures of differences and shares, one row each, with their intervals."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from textwrap import fill
from typing import Any

from robomme_interference_data.evaluate.score.tables.contrast import (
    COMPARISONS,
    LESSON_ONLY,
    Contrast,
    Effect,
)
from robomme_interference_data.schema.conditions import KINDS, parse_condition
from robomme_interference_data.stats.bootstrap import Interval
from robomme_interference_data.stats.significance import ALPHA
from robomme_interference_data.viz.figure import GRAY, INK, Hue, tidy

from .curves import (
    HEADING,
    SMALL,
    TITLE,
    WIDTH,
    draw_points,
    label_ends,
    legend,
    mark,
    panel_grid,
    set_axes,
    short,
)
from .data import Data
from .styles import SeriesStyle

_FLIPS = 0.06
"""Assumed share of outcomes that flip between repeats: RoboMME's on a GPU, at the least."""

_LEVELS = {
    "all": SeriesStyle("all kept", Hue.BLUE, "o", "-"),
    "some": SeriesStyle("some kept", Hue.ORANGE, "s", "--"),
    "none": SeriesStyle("none kept", Hue.VERMILION, "^", ":"),
}

_BARS = "bars: 95% intervals"
_Groups = dict[str, dict[str, Contrast]]
"""Label of a comparison to each system's contrast."""


def _forest(
    figure: Any,
    data: Data,
    panels: _Groups,
    rows: Mapping[str, str],
    title: str,
    *notes: str,
    value: Callable[[Contrast], Interval] = lambda contrast: contrast.pairs.change,
    scale: float = 100,
    guides: Sequence[float] = (0,),
    band: float = 0.0,
    wide: int = 3,
) -> None:
    """Draw contrasts with their intervals: a panel for each title, a row for each key of `rows`.

    `band` is shaded around zero; `guides` are upright lines.
    """
    grid = panel_grid(figure, len(panels), min(wide, len(panels)))
    places = {key: place for place, key in enumerate(rows)}
    for axes, (name, group) in zip(grid, panels.items(), strict=True):
        if band:
            axes.axvspan(-band, band, color=GRAY, alpha=0.2, linewidth=0, zorder=0)
        for guide, line in zip(guides, ("-", "--"), strict=False):
            axes.axvline(guide, color=GRAY, linewidth=0.8, linestyle=line, zorder=0)
        for key, contrast in group.items():
            point = (places[key], *(scale * number for number in value(contrast)))
            style = data.styles[contrast.system]
            draw_points(axes, [point], style, contrast.system, [contrast.complete], horizontal=True)
        tidy(axes)
        axes.set_title(fill(name, 26), size=HEADING, color=INK)
    grid[0].set_yticks(range(len(rows)), list(rows.values()))
    grid[0].set_ylim(len(rows) - 0.4, -0.6)
    figure.suptitle(title, size=TITLE, color=INK)
    hollow = not all(contrast.complete for group in panels.values() for contrast in group.values())
    lines = [note for note in notes if note]
    if hollow:
        lines.append("hollow: incomplete cell")
    legend(figure, "\n".join(lines))


def _by_system(
    figure: Any, data: Data, groups: _Groups, title: str, *notes: str, band: float = 0.0
) -> None:
    """Draw a panel for each comparison and a row for each system, sorted by the last common one."""
    most = max(map(len, groups.values()))
    leading = next(group for group in reversed([*groups.values()]) if len(group) == most)
    systems = [name for name in data.systems if any(name in group for group in groups.values())]
    systems.sort(key=lambda s: -leading[s].pairs.change.value if s in leading else math.inf)
    figure.set_size_inches(WIDTH, 1.5 + 0.27 * max(3, len(systems)))
    rows = {system: data.styles[system].label for system in systems}
    _forest(figure, data, groups, rows, title, *notes, band=band, wide=len(groups))


def effects(figure: Any, data: Data) -> bool:
    """Draw the effect of each condition with sessions, by system, over a band of noise."""
    counted = [
        c for c in data.contrasts if c.pairs.n and parse_condition(c.condition).kind.name == "k"
    ]
    last = max((parse_condition(c.condition).k for c in counted), default=0)
    groups: _Groups = {}
    for contrast in counted:
        name = ""
        if contrast.effect is Effect.HISTORY and contrast.condition == LESSON_ONLY:
            name = f"{LESSON_ONLY} − {short(contrast.against[1])}"
        elif contrast.effect is Effect.SESSIONS:
            name = f"{contrast.condition} − {LESSON_ONLY}"
        elif contrast.effect is Effect.RETRIEVAL and parse_condition(contrast.condition).k == last:
            name = f"{contrast.condition}, with − without retrieval"
        if name:
            groups.setdefault(name, {})[contrast.system] = contrast
    if not groups:
        return False
    flips = _FLIPS if data.flips is None else data.flips
    source = "assumed without repeats" if data.flips is None else "measured between repeats"
    most = max(c.pairs.n for group in groups.values() for c in group.values())
    # 1.96 standard deviations of the difference, in points; see `PowerPlan.noise`.
    band = 196 * math.sqrt(flips / most)
    note = (
        f"gray: ±{band:.1f} points, the 95% range of noise for {most} episodes if "
        f"{100 * flips:.0f}% of outcomes flip between repeats ({source})"
    )
    title = f"Effect of each condition, paired over episodes, {data.simulator}"
    _by_system(figure, data, groups, title, f"points; {_BARS}", note, band=band)
    return True


def ceiling(figure: Any, data: Data) -> bool:
    """Draw how far systems are below the ideal observer with their memory."""
    groups: _Groups = {}
    for contrast in data.contrasts:
        if contrast.effect is Effect.CEILING and contrast.pairs.n:
            groups.setdefault(contrast.condition, {})[contrast.system] = contrast
    if not groups:
        return False
    title = f"Gap to the ideal observer with the same memory, {data.simulator}"
    _by_system(figure, data, groups, title, f"system − ideal observer, points; {_BARS}")
    return True


def retention(figure: Any, data: Data) -> bool:
    """Draw the share of each system's lift that is left at the most sessions."""
    lifts = [
        contrast
        for contrast in data.contrasts
        if contrast.effect is Effect.HISTORY and not math.isnan(contrast.retention.value)
    ]
    if not lifts:
        return False
    last = max((c.condition for c in lifts), key=lambda name: parse_condition(name).k)
    lifts = sorted(
        (c for c in lifts if c.condition == last),
        key=lambda c: (not c.complete, -c.retention.value),
    )
    rows = {}
    for contrast in lifts:
        label = data.styles[contrast.system].label
        rows[contrast.system] = label if contrast.complete else f"{label} †"
    absent = [data.styles[system].label for system in data.systems if system not in rows]
    note = ""
    if absent:
        note = (
            f"Not shown (no lift at k0 with p < {ALPHA}, or rows missing at {last}): "
            f"{', '.join(absent)}"
        )
    figure.set_size_inches(WIDTH, 1.6 + 0.3 * max(2, len(lifts)))
    _forest(
        figure,
        data,
        {"": {contrast.system: contrast for contrast in lifts}},
        rows,
        f"Retention at {last}, {data.simulator}",
        f"({last} − no history) / (k0 − no history); 0: nothing left, 1: all; {_BARS}",
        note,
        value=lambda contrast: contrast.retention,
        scale=1,
        guides=(0, 1),
    )
    return True


def interference(figure: Any, data: Data) -> bool:
    """Draw the effect of each kind of interference, at equally many sessions."""
    asked = {contrast.system for contrast in data.contrasts if contrast.asks and contrast.pairs.n}
    systems = [system for system in data.systems if system in asked]
    if not systems:
        return False
    groups = _at_one_k([contrast for contrast in data.contrasts if contrast.system in asked])
    panels = {
        data.styles[system].label: {
            name: group[system] for name, group in groups.items() if system in group
        }
        for system in systems
    }
    figure.set_size_inches(WIDTH, 0.9 + (0.5 + 0.34 * len(groups)) * math.ceil(len(systems) / 3))
    title = f"Effect of each kind of interference, {data.simulator}"
    _forest(figure, data, panels, {name: name for name in groups}, title, f"points; {_BARS}")
    return True


def _at_one_k(contrasts: Sequence[Contrast]) -> _Groups:
    """Return each comparison of kinds of conditions by system, at one number of sessions.

    It is the number that most comparisons have, the larger if several; a comparison without it
    has its own largest number.
    """
    by_question: dict[str, dict[int, list[Contrast]]] = {}
    for contrast in contrasts:
        condition = parse_condition(contrast.condition)
        asks = condition.kind.asks if contrast.effect is Effect.SESSIONS else contrast.asks
        if asks and contrast.pairs.n:
            by_question.setdefault(asks, {}).setdefault(condition.k, []).append(contrast)
    counts = Counter(k for by_k in by_question.values() for k in by_k)
    most = max(counts, key=lambda k: (counts[k], k))
    shown = {}
    for asks in (KINDS["k"].asks, *(comparison.asks for comparison in COMPARISONS.values())):
        if by_k := by_question.get(asks):
            at_k = by_k.get(most) or by_k[max(by_k)]
            name = f"{asks}\n{at_k[0].condition} − {at_k[0].against[1]}"
            shown[name] = {contrast.system: contrast for contrast in at_k}
    return shown


def by_evidence_kept(figure: Any, data: Data) -> bool:
    """Draw success where all, some and none of the evidence was kept, by system."""
    names = {condition.name for condition in data.conditions}
    rows = [row for row in data.by_evidence_kept if row["condition"] in names]
    systems = list(dict.fromkeys(row["system"] for row in rows))
    if not systems:
        return False
    wide = min(3, len(systems))
    figure.set_size_inches(WIDTH, 1.1 + 2.3 * math.ceil(len(systems) / wide))
    panels = panel_grid(figure, len(systems), wide)
    ends: dict[str, dict[str, float]] = {system: {} for system in systems}
    for axes, system in zip(panels, systems, strict=True):
        for number, (level, style) in enumerate(_LEVELS.items()):
            cells = [row for row in rows if (row["system"], row["kept"]) == (system, level)]
            if not cells:
                continue
            shift = 0.09 * (number - 1)
            points = [
                (
                    data.x(row["condition"]) + shift,
                    100 * row["rate"],
                    100 * row["rate_low"],
                    100 * row["rate_high"],
                )
                for row in cells
            ]
            mark(axes.plot(*zip(*(p[:2] for p in points), strict=True), **style.stroke), system)
            draw_points(axes, points, style, system, [True] * len(points))
            ends[system][level] = points[-1][1]
        axes.set_title(data.styles[system].label, size=HEADING, color=INK)
    for number, (axes, system) in enumerate(zip(panels, systems, strict=True)):
        set_axes(axes, data, systems, "" if number % wide else "success, %")
        label_ends(axes, ends[system], _LEVELS, 1.8, SMALL, system)
    note = "Different episodes, not paired. Bars: 95% Wilson intervals; n: see the table."
    title = f"Success by whether the memory kept the evidence, {data.simulator}"
    figure.suptitle(title, size=TITLE, color=INK)
    legend(figure, f"By whether all, some or none of the evidence was in the memory. {note}")
    return True
