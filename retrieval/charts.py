"""Charts of many choices: `retrieval-score … --out` and `calibrate … --out`."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from robomme_interference_data.schema.conditions import in_order, parse_condition
from robomme_interference_data.viz.figure import GREY, INK, Hue, open_figure, save_figure, tidy

from .calibrate import Calibration
from .grade import ALL, PASS_MARK, Cell

_COLOURS = (Hue.BLUE, Hue.VERMILION, Hue.GREEN, Hue.PINK, Hue.ORANGE, Hue.SKY, INK)
_MARKERS = "osD^vPX"
_SHARES = ("purity", "coverage")
_LINES = ("-", "--")


def draw_cells(cells: Sequence[Cell], title: str, out: Path) -> None:
    """Draw purity and coverage by condition: of one rule by family, or of several, all families."""
    rules = dict.fromkeys(cell.rule for cell in cells)
    panels: dict[str, list[tuple[str, str, list[Cell]]]] = {}
    if len(rules) == 1:
        for family in dict.fromkeys([ALL, *(cell.family for cell in cells)]):
            here = [cell for cell in cells if cell.family == family]
            name = "All families" if family == ALL else family
            panels[name] = [(share, share, here) for share in _SHARES]
        wide, width, height = min(5, len(panels)), 2.0, 1.9
    else:
        every = {rule: [c for c in cells if (c.rule, c.family) == (rule, ALL)] for rule in rules}
        for share in _SHARES:
            panels[f"{share}, all families"] = [(rule, share, every[rule]) for rule in rules]
        wide, width, height = 2, 4.2, 3.0
    high = -(-len(panels) // wide)
    names = [one.name for one in in_order({cell.condition for cell in cells})]
    with open_figure() as figure:
        figure.set_size_inches(max(5.0, width * wide), 1.2 + height * high)
        grid = figure.subplots(high, wide, sharex=True, sharey=True, squeeze=False)
        for axes in grid.flat[len(panels) :]:
            axes.set_axis_off()
        for axes, (name, lines) in zip(grid.flat, panels.items(), strict=False):
            most = max(cell.queries for *_, here in lines for cell in here)
            axes.set_title(f"{name} (n = {most})", size=8, color=INK)
            for number, (label, share, here) in enumerate(lines):
                shift = 0.08 * (number - (len(lines) - 1) / 2)
                places = {name: place + shift for place, name in enumerate(names)}
                _line(axes, here, share, label, number, places)
            axes.set_xticks(range(len(names)), names)
            _percent(axes)
        for axes in grid[:, 0]:
            axes.set_ylabel("%", size=8, color=INK)
        figure.suptitle(title, x=0.01, ha="left", size=10, color=INK)
        figure.tight_layout(rect=(0, 0.18 / high, 1, 0.98))
        handles, labels = grid.flat[0].get_legend_handles_labels()
        named = dict(zip(labels, handles, strict=True))
        look = {"loc": "lower center", "ncols": min(4, len(named)), "frameon": False}
        figure.legend(list(named.values()), list(named), fontsize=8, **look)
        save_figure(figure, out)


def _line(
    axes: Any, cells: Sequence[Cell], share: str, label: str, number: int, places: dict[str, float]
) -> None:
    """Draw a share by condition; conditions of different kinds are not joined."""
    colour, line = _COLOURS[number % len(_COLOURS)], _LINES[number % 2]
    style = {"color": colour, "marker": _MARKERS[number % len(_MARKERS)], "markersize": 4}
    for _, group in groupby(cells, key=lambda cell: parse_condition(cell.condition).kind):
        found = list(group)
        values = [100 * getattr(cell, share) for cell in found]
        x = [places[cell.condition] for cell in found]
        axes.plot(x, values, linewidth=1.4, linestyle=line, label=label, **style)
        for place, cell in zip(x, found, strict=True):
            low, high = getattr(cell, f"{share}_low"), getattr(cell, f"{share}_high")
            if low is not None:
                axes.plot((place, place), (100 * low, 100 * high), color=colour, linewidth=1)


def _percent(axes: Any) -> None:
    label = f"pass mark, {PASS_MARK:.0%}"
    axes.axhline(100 * PASS_MARK, color=GREY, linewidth=0.9, linestyle=":", zorder=0, label=label)
    axes.set_ylim(-4, 104)
    tidy(axes)


def draw_calibration(found: Calibration, title: str, out: Path) -> None:
    """Draw what the released rule separates, and what other thresholds would give."""
    with open_figure() as figure:
        figure.set_size_inches(8.5, 3.7)
        left, right = figure.subplots(1, 2)
        _distributions(left, found)
        _sweep(right, found)
        for axes in (left, right):
            limits = axes.get_xlim()
            for value, colour, name in (
                (found.threshold, _COLOURS[0], "fitted"),
                (found.in_use, GREY, "in use"),
            ):
                if axes is left or limits[0] <= value <= limits[1]:
                    label = f"{name}: {value:.3f}"
                    axes.axvline(value, color=colour, linewidth=1.1, linestyle="-.", label=label)
            axes.legend(
                framealpha=1,  # it hides the vertical lines behind it
                edgecolor="none",
                fontsize=7,
                loc="upper left" if axes is left else "lower left",
            )
        figure.suptitle(title, x=0.01, ha="left", size=10, color=INK)
        figure.tight_layout(rect=(0, 0, 1, 0.98))
        save_figure(figure, out)


def _distributions(axes: Any, found: Calibration) -> None:
    for name, values, colour in (
        ("across true cuts", found.cuts, INK),
        ("lowest inside a session", found.lowest, _COLOURS[1]),
    ):
        shares = [100 * (n + 1) / len(values) for n in range(len(values))]
        label = f"{name} (n = {len(values)})"
        axes.step(values, shares, where="post", color=colour, linewidth=1.5, label=label)
    between = sorted((found.cut_percentile, found.lowest_percentile))
    axes.axvspan(*between, color="#eeeeee", zorder=0, label="between the percentiles")
    if fitted := [one.threshold for one in found.held_out]:
        middle = [50] * len(fitted)
        label = "without one family"
        axes.plot(fitted, middle, "|", color=_COLOURS[0], markersize=9, label=label)
    axes.set_xlabel("cosine of adjacent frames", size=8, color=INK)
    axes.set_ylabel("share at or below, %", size=8, color=INK)
    tidy(axes)


def _sweep(axes: Any, found: Calibration) -> None:
    for number, share in enumerate(_SHARES):
        for name in dict.fromkeys(trial.condition for trial in found.sweep):
            here = [trial for trial in found.sweep if trial.condition == name]
            last = name == found.sweep[-1].condition
            axes.plot(
                [trial.threshold for trial in here],
                [100 * getattr(trial, share) for trial in here],
                color=_COLOURS[number],
                linestyle=_LINES[number],
                linewidth=1.6 if last else 0.6,
                alpha=1 if last else 0.5,
                marker=_MARKERS[number] if last and len(here) <= 30 else None,
                markersize=3,
                label=f"{share} under {name}" if last else None,
            )
    axes.set_xlim(found.sweep[0].threshold - 0.01, found.sweep[-1].threshold + 0.01)
    axes.set_xlabel("threshold (thin lines: the other conditions)", size=8, color=INK)
    axes.set_ylabel("mean over queries, %", size=8, color=INK)
    _percent(axes)
