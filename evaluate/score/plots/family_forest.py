"""The figure of falls by family, beside the mean fall without each family."""

import math
from typing import Any

from robomme_interference_data.evaluate.score.tables.contrast import LESSON_ONLY
from robomme_interference_data.viz.figure import GRAY, INK, tidy

from .curves import HEADING, SMALL, TITLE, WIDTH, draw_points, legend, mark, panel_grid
from .data import Data

_WIDE = 4
"""The most panels in a row."""

_OWN = ("fall", "fall_low", "fall_high")


def family_falls(figure: Any, data: Data) -> bool:
    """Draw each system's fall in each family, and that over all other families."""
    systems = list(dict.fromkeys(row["system"] for row in data.family_falls))
    if not systems:
        return False
    families = [
        name for name in data.families if any(row["part"] == name for row in data.family_falls)
    ]
    wide = min(_WIDE, len(systems))
    high = 0.45 + 0.19 * len(families)
    figure.set_size_inches(WIDTH, 0.9 + high * math.ceil(len(systems) / wide))
    panels = panel_grid(figure, len(systems), wide)
    for axes, system in zip(panels, systems, strict=True):
        own = [row for row in data.family_falls if row["system"] == system]
        axes.axvline(0, color=GRAY, linewidth=0.8, zorder=0)
        points = [(families.index(row["part"]), *(100 * row[name] for name in _OWN)) for row in own]
        style = data.styles[system]
        complete = [data.falls[system].complete for _ in own]
        draw_points(axes, points, style, system, complete, horizontal=True)
        places = [point[0] for point in points]
        without = [100 * row["fall_without"] for row in own]
        mark(axes.plot(without, places, "|", color=INK, markersize=9, zorder=2), system)
        tidy(axes)
        axes.set_title(style.label, size=HEADING, color=INK)
    panels[0].set_yticks(range(len(families)), families, size=SMALL)
    panels[0].set_ylim(len(families) - 0.4, -0.6)
    ends = dict.fromkeys(row["condition"] for row in data.family_falls)
    compared = f"{' or '.join(ends)} − {LESSON_ONLY}"
    figure.suptitle(f"Falls by family, {data.simulator}", size=TITLE, color=INK)
    notes = [f"{compared}, points, with 95% intervals", "upright lines: all other families"]
    if not all(data.falls[system].complete for system in systems):
        notes.append("hollow: incomplete cell")
    legend(figure, "; ".join(notes))
    return True
