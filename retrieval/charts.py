"""Charts of retrieval: `retrieval-score … --out`, with `--calibrate` or without."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any

from robomme_interference_data.schema.conditions import in_order, parse_condition
from robomme_interference_data.viz.figure import GRAY, INK, Hue, open_figure, save_figure, tidy

from .calibrate import Calibration
from .grade import ALL, PASS_MARK, Cell, is_family

_COLORS = (INK, Hue.BLUE, Hue.VERMILION, Hue.GREEN, Hue.PINK, Hue.ORANGE, Hue.SKY)
_MARKERS = "osD^vPXd*"
_SHARES = ("purity", "coverage")


def draw_cells(cells: Sequence[Cell], title: str, out: Path) -> None:
    """Draw purity and coverage by condition: a line per family of one rule, or per rule."""
    rules = dict.fromkeys(cell.rule for cell in cells)
    lines: dict[str, list[Cell]] = {}
    for cell in sorted(cells, key=lambda cell: cell.part != ALL):
        if cell.part == ALL:
            lines.setdefault("all families" if len(rules) == 1 else cell.rule, []).append(cell)
        elif len(rules) == 1 and is_family(cell):
            lines.setdefault(cell.part, []).append(cell)
    names = [condition.name for condition in in_order({cell.condition for cell in cells})]
    with _two_panels(title, out) as panels:
        for axes, share in zip(panels, _SHARES, strict=True):
            for number, (label, line) in enumerate(lines.items()):
                shift = 0.06 * (number - (len(lines) - 1) / 2)
                positions = {name: at + shift for at, name in enumerate(names)}
                _draw_line(axes, line, share, f"{label} (n = {line[0].queries})", number, positions)
            axes.set_xticks(range(len(names)), names)
            axes.set_ylabel(f"{share}, %", size=8, color=INK)
            _percent(axes)
        handles, labels = panels[0].get_legend_handles_labels()
        unique = dict(zip(labels, handles, strict=True))
        panels[1].legend(
            unique.values(), unique, loc="upper left", bbox_to_anchor=(1, 1), frameon=False,
            fontsize=7,
        )  # fmt: skip


def draw_calibration(calibration: Calibration, title: str, out: Path) -> None:
    """Draw the cosines that the released rule separates, and other thresholds."""
    with _two_panels(title, out) as (left, right):
        for label, values, color in (
            ("across true cuts", calibration.cuts, INK),
            ("lowest inside a session", calibration.lowest, Hue.VERMILION),
        ):
            shares = [100 * (n + 1) / len(values) for n in range(len(values))]
            name = f"{label} (n = {len(values)})"
            left.step(values, shares, where="post", color=color, linewidth=1.5, label=name)
        for label, value, color in (
            ("fitted", calibration.threshold, Hue.BLUE),
            ("in use", calibration.in_use, GRAY),
        ):
            name = f"{label}: {value:.3f}"
            left.axvline(value, color=color, linewidth=1.1, linestyle="-.", label=name)
        left.set_xlabel("cosine of adjacent frames", size=8, color=INK)
        left.set_ylabel("share at or below, %", size=8, color=INK)
        last = calibration.sweep[-1].condition
        trials = [trial for trial in calibration.sweep if trial.condition == last]
        lines = ((Hue.BLUE, "-"), (Hue.VERMILION, "--"))  # both are seen where they are equal
        for share, (color, line) in zip(_SHARES, lines, strict=True):
            means = [100 * getattr(trial, share) for trial in trials]
            right.plot(
                [trial.threshold for trial in trials],
                means,
                color=color,
                linestyle=line,
                label=share,
            )
        right.set_xlabel(f"threshold, under {last}", size=8, color=INK)
        right.set_ylabel("mean over queries, %", size=8, color=INK)
        _percent(right)
        for axes in (left, right):
            tidy(axes)
            # Below the axes: a curve may be anywhere in them.
            axes.legend(
                loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, frameon=False, fontsize=7
            )


_STYLES: Sequence[dict[str, Any]] = (
    {"linewidth": 2.6},
    {"linewidth": 1.8, "linestyle": "--"},
    {"linewidth": 1.2, "linestyle": ":"},
)
"""Of lines in their order: each leaves those below it visible where both are equal."""


@contextmanager
def _two_panels(title: str, out: Path) -> Iterator[Any]:
    """Give two axes side by side, of a figure that is then written."""
    with open_figure() as figure:
        figure.set_size_inches(9, 3.7)
        yield figure.subplots(1, 2)
        figure.suptitle(title, x=0.01, ha="left", size=10, color=INK)
        figure.tight_layout(rect=(0, 0, 1, 0.98))
        save_figure(figure, out)


def _draw_line(
    axes: Any, cells: Sequence[Cell], share: str, label: str, number: int, at: dict[str, float]
) -> None:
    """Draw a share by condition with intervals; conditions of different kinds are not joined."""
    color = _COLORS[number % len(_COLORS)]
    # Later lines are thinner and dashed, so that equal ones below them still show.
    style = _STYLES[number % len(_STYLES)]
    for _, group in groupby(cells, key=lambda cell: parse_condition(cell.condition).kind):
        joined = list(group)
        x = [at[cell.condition] for cell in joined]
        values = [100 * getattr(cell, share) for cell in joined]
        marker = _MARKERS[number % len(_MARKERS)]
        axes.plot(x, values, color=color, marker=marker, markersize=4, label=label, **style)
        for position, cell in zip(x, joined, strict=True):
            low, high = getattr(cell, f"{share}_low"), getattr(cell, f"{share}_high")
            if low is not None:
                axes.vlines(position, 100 * low, 100 * high, color=color, linewidth=1)


def _percent(axes: Any) -> None:
    label = f"pass mark, {PASS_MARK:.0%}"
    axes.axhline(100 * PASS_MARK, color=GRAY, linewidth=0.9, linestyle=":", zorder=0, label=label)
    axes.set_ylim(-4, 104)
    tidy(axes)
