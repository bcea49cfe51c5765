"""The figure of offline runs: the action error by condition."""

import math
from collections.abc import Sequence
from itertools import groupby
from typing import Any

from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.action_error import ErrorCell
from robomme_interference_data.schema.conditions import NO_HISTORY, parse_condition
from robomme_interference_data.stats.bootstrap import MIN_EPISODES
from robomme_interference_data.viz.figure import INK, tidy

from .curves import LABEL, TITLE, WIDTH, draw_points, label_ends, legend, mark, shifts, short
from .styles import styles_of

_HIGH = 4.2  # inches


def action_error(figure: Any, score: Score) -> None:
    """Draw the mean action error of each system over the conditions, with 95% intervals.

    A system without history, such as a baseline, is a dashed line across all conditions.
    """
    cells = [cell for cell in score.error_cells if not cell.part and cell.n]
    conditions = score.recordings.conditions if score.recordings else ()
    systems = list(dict.fromkeys(cell.system for cell in cells))
    styles = styles_of(systems, score.recordings.retrieving if score.recordings else ())
    places = {condition: place for place, condition in enumerate(conditions)}
    figure.set_size_inches(WIDTH, _HIGH)
    axes = figure.subplots()
    ends: dict[str, float] = {}
    for system, shift in shifts(systems, min(0.09, 0.55 / max(1, len(systems)))).items():
        own = [cell for cell in cells if cell.system == system]
        points = [(places[cell.condition] + shift, *cell.error) for cell in own]
        for kind, group in groupby(
            zip(own, points, strict=True), lambda pair: parse_condition(pair[0].condition).kind
        ):
            line = [point[:2] for _, point in group]
            if kind.counted:
                mark(axes.plot(*zip(*line, strict=True), **styles[system].stroke), system)
        if len(conditions) > 1 and [cell.condition for cell in own] == [NO_HISTORY]:
            floor = axes.axhline(
                points[0][1], color=styles[system].color, linewidth=0.8, linestyle="--", zorder=0
            )
            mark([floor], system)
        draw_points(axes, points, styles[system], system, [cell.complete for cell in own])
        ends[system] = points[-1][1]
    tidy(axes)
    axes.set_xticks(range(len(conditions)), [short(name) for name in conditions])
    axes.set_xlim(-0.4, len(conditions) - 0.6)
    highest = max(_top(cell.error) for cell in cells)
    # Errors that are all 0 give no scale.
    axes.set_ylim(0, 1.05 * highest if highest else 1)
    axes.set_ylabel("action error, in the actions' units", size=LABEL, color=INK)
    label_ends(axes, ends, styles, _HIGH - 1, LABEL)
    notes = ["Mean absolute difference to the recorded actions", _bars(cells)]
    if not all(cell.complete for cell in cells):
        notes.append("hollow: incomplete cell")
    legend(figure, "; ".join(notes))
    axes.set_title("Action error by condition, offline", loc="left", size=TITLE, color=INK)


def _bars(cells: Sequence[ErrorCell]) -> str:
    """Say which intervals are drawn."""
    without = sum(math.isnan(cell.error.low) for cell in cells)
    few = f"fewer than {MIN_EPISODES} recordings differ"
    if without == len(cells):
        return f"no intervals: {few}"
    bars = "bars: 95% bootstrap intervals"
    return f"{bars}, none where {few}" if without else bars


def _top(error: tuple[float, float, float]) -> float:
    """Return the upper end of an interval, or its estimate without one."""
    value, _, high = error
    return value if math.isnan(high) else high
