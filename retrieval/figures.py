"""Figures of `retrieval-score` and `calibrate`."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robomme_interference_data.drawing import GREY, INK, open_figure, save_figure, tidy
from robomme_interference_data.retrieval.calibrate import Calibration
from robomme_interference_data.retrieval.grade import ALL, PASS_MARK, Cell

__all__ = ["draw_calibration", "draw_cells"]

_PURITY, _COVERAGE = "#0072B2", "#D55E00"
_SHARES = (("purity", _PURITY, "o", "-"), ("coverage", _COVERAGE, "s", "--"))
_RULES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#222222")
_MARKERS = "osD^vPX"


def draw_cells(cells: Sequence[Cell], title: str, out: Path) -> None:
    """Draw purity and coverage by k: of one rule by family, or of several, all families together.

    Raises:
        InvalidOptionError: `out` has another suffix than `.png` or `.svg`, or cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    rules = list(dict.fromkeys(cell.rule for cell in cells))
    with open_figure() as figure:
        if len(rules) == 1:
            _by_family(figure, cells)
        else:
            _by_rule(figure, [cell for cell in cells if cell.family == ALL], rules)
        figure.suptitle(title, x=0.01, ha="left", size=10, color=INK)
        save_figure(figure, out)


def _by_family(figure: Any, cells: Sequence[Cell]) -> None:
    names = list(dict.fromkeys(cell.family for cell in cells))
    names = [ALL, *(name for name in names if name != ALL)]
    wide = min(5, len(names))
    rows = -(-len(names) // wide)
    figure.set_size_inches(max(5.0, 2 * wide), 1.0 + 1.9 * rows)
    panels = figure.subplots(rows, wide, sharex=True, sharey=True, squeeze=False)
    for axes, name in zip(panels.flat, names, strict=False):
        here = [cell for cell in cells if cell.family == name]
        for shift, (share, colour, marker, line) in zip((-0.06, 0.06), _SHARES, strict=True):
            _line(axes, here, share, colour, marker, line, shift)
        bold = "bold" if name == ALL else "normal"
        queries = max(cell.episodes for cell in here)
        label = "All families" if name == ALL else name
        axes.set_title(f"{label} (n = {queries})", size=8, color=INK, weight=bold)
        _frame(axes, here)
    for axes in list(panels.flat)[len(names) :]:
        axes.set_axis_off()
    for axes in panels[:, 0]:
        axes.set_ylabel("%", size=8, color=INK)
    figure.tight_layout(rect=(0, 0.06, 1, 0.97))
    handles, labels = panels.flat[0].get_legend_handles_labels()
    _legend(figure, handles, labels)


def _by_rule(figure: Any, cells: Sequence[Cell], rules: Sequence[str]) -> None:
    figure.set_size_inches(8.5, 4.3)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (share, *_) in zip(panels, _SHARES, strict=True):
        for place, rule in enumerate(rules):
            here = [cell for cell in cells if cell.rule == rule]
            colour, marker = _RULES[place % len(_RULES)], _MARKERS[place % len(_MARKERS)]
            shift = 0.08 * (place - (len(rules) - 1) / 2)
            _line(axes, here, share, colour, marker, "-", shift, label=rule)
        axes.set_title(f"{share}, all families (n = {cells[0].episodes})", size=9, color=INK)
        _frame(axes, cells)
    panels[0].set_ylabel("%", size=8, color=INK)
    figure.tight_layout(rect=(0, 0.12, 1, 0.97))
    handles, labels = panels[0].get_legend_handles_labels()
    _legend(figure, handles, labels)


def _line(
    axes: Any,
    cells: Sequence[Cell],
    share: str,
    colour: str,
    marker: str,
    line: str,
    shift: float,
    *,
    label: str | None = None,
) -> None:
    places = [math.log2(cell.k + 1) + shift for cell in cells]
    found = [getattr(cell, share) for cell in cells]
    values = [100 * one.value for one in found]
    style = {"color": colour, "marker": marker, "linestyle": line, "markersize": 4}
    axes.plot(places, values, linewidth=1.4, label=label or share, **style)
    for place, one in zip(places, found, strict=True):
        if not math.isnan(one.low):
            axes.plot((place, place), (100 * one.low, 100 * one.high), color=colour, linewidth=1)


def _frame(axes: Any, cells: Sequence[Cell]) -> None:
    ks = sorted({cell.k for cell in cells})
    axes.axhline(100 * PASS_MARK, color=GREY, linewidth=0.9, linestyle=":", zorder=0)
    axes.set_xticks([math.log2(k + 1) for k in ks], [f"k{k}" for k in ks])
    axes.set_ylim(-4, 104)
    tidy(axes)


def _legend(figure: Any, handles: Sequence[Any], labels: Sequence[str]) -> None:
    from matplotlib.lines import Line2D

    mark = Line2D([], [], color=GREY, linewidth=0.9, linestyle=":")
    figure.legend(
        [*handles, mark],
        [*labels, f"pass mark, {PASS_MARK:.0%}"],
        loc="lower center",
        ncols=min(4, len(labels) + 1),
        frameon=False,
        fontsize=8,
    )


def draw_calibration(found: Calibration, own: float, title: str, out: Path) -> None:
    """Draw what the released rule parts, and what other thresholds would give.

    Args:
        found: The calibration.
        own: The threshold that the encoder uses by itself.
        title: Title.
        out: File to write, `.png` or `.svg`.

    Raises:
        InvalidOptionError, MissingExtraError: As for `draw_cells`.
    """
    with open_figure() as figure:
        figure.set_size_inches(8.5, 3.7)
        left, right = figure.subplots(1, 2)
        _distributions(left, found, own)
        _sweep(right, found, own)
        figure.suptitle(title, x=0.01, ha="left", size=10, color=INK)
        figure.tight_layout(rect=(0, 0, 1, 0.98))
        save_figure(figure, out)


def _distributions(axes: Any, found: Calibration, own: float) -> None:
    named = (
        ("across true cuts", found.cuts, INK, "-"),
        ("lowest inside a session", found.lowest, _COVERAGE, "-"),
    )
    for name, values, colour, line in named:
        shares = [100 * (n + 1) / len(values) for n in range(len(values))]
        label = f"{name} (n = {len(values)})"
        axes.step(
            values, shares, where="post", color=colour, linestyle=line, linewidth=1.5, label=label
        )
    between = sorted((found.cut_percentile, found.lowest_percentile))
    axes.axvspan(*between, color="#eeeeee", zorder=0, label="between the percentiles")
    _thresholds(axes, found, own)
    if found.held_out:
        fitted = [one.threshold for one in found.held_out]
        axes.plot(
            fitted,
            [50] * len(fitted),
            "|",
            color=_PURITY,
            markersize=9,
            label="without one family",
        )
    axes.set_xlabel("cosine of adjacent frames", size=8, color=INK)
    axes.set_ylabel("share at or below, %", size=8, color=INK)
    tidy(axes)
    axes.legend(frameon=False, fontsize=7, loc="upper left")


def _sweep(axes: Any, found: Calibration, own: float) -> None:
    ks = sorted({point.k for point in found.sweep})
    few = len(found.sweep) <= 30 * len(ks)
    for share, colour, marker, line in _SHARES:
        for k in ks:
            here = [point for point in found.sweep if point.k == k]
            last = k == ks[-1]
            axes.plot(
                [point.threshold for point in here],
                [100 * getattr(point, share) for point in here],
                color=colour,
                linestyle=line,
                linewidth=1.6 if last else 0.6,
                alpha=1 if last else 0.5,
                marker=marker if last and few else None,
                markersize=3,
                label=f"{share} at k{k}" if last else None,
            )
    axes.axhline(100 * PASS_MARK, color=GREY, linewidth=0.9, linestyle=":", zorder=0)
    limits = (found.sweep[0].threshold - 0.01, found.sweep[-1].threshold + 0.01)
    _thresholds(axes, found, own, limits)
    axes.set_ylim(-4, 104)
    axes.set_xlabel("threshold (thin lines: smaller k)", size=8, color=INK)
    axes.set_ylabel("mean over queries, %", size=8, color=INK)
    tidy(axes)
    axes.legend(frameon=False, fontsize=7, loc="lower left")


def _thresholds(
    axes: Any, found: Calibration, own: float, limits: tuple[float, float] | None = None
) -> None:
    for value, colour, name in ((found.threshold, _PURITY, "fitted"), (own, GREY, "in use")):
        if limits is None or limits[0] <= value <= limits[1]:
            label = f"{name}: {value:.3f}"
            axes.axvline(value, color=colour, linewidth=1.1, linestyle="-.", label=label)
    if limits is not None:
        axes.set_xlim(*limits)
