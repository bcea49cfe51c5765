"""The figure of success against cost."""

from typing import Any

from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.viz.figure import INK, tidy

from . import curves
from .data import Data

_WIDE_RANGE = 10
"""A ratio of the greatest to the least cost from which the axis is logarithmic."""


def cost(figure: Any, data: Data) -> bool:
    """Draw each system's success against the seconds of a rollout, a line through each k."""
    shown = {condition.name for condition in data.conditions}
    records = [record for record in data.costs if record["condition"] in shown]
    if not records:
        return False
    high = 4.2
    figure.set_size_inches(curves.WIDTH, high)
    axes = figure.subplots()
    costs = [record["seconds"] for record in records]
    if max(costs) > _WIDE_RANGE * min(costs) > 0:
        axes.set_xscale("log")
    ends = {}
    for system in dict.fromkeys(record["system"] for record in records):
        own = [record for record in records if record["system"] == system]
        style = data.styles[system]
        points = [
            (record["seconds"], *(100 * record[name] for name in ("rate", "low", "high")))
            for record in own
        ]
        places, values, _, _ = zip(*points, strict=True)
        # no-history is no smaller number of sessions: it is not joined.
        joined = [
            point[:2]
            for record, point in zip(own, points, strict=True)
            if parse_condition(record["condition"]).kind.counted
        ]
        if joined:
            curves.mark(axes.plot(*zip(*joined, strict=True), **style.stroke), system)
        complete = [record["complete"] for record in own]
        curves.draw_points(axes, points, style, system, complete)
        for record, place, value in zip(own, places, values, strict=True):
            curves.mark([_label(axes, curves.short(record["condition"]), place, value)], system)
        ends[system] = values[-1]
    tidy(axes)
    axes.set_ylim(0, 103)
    axes.set_xlabel("seconds of history, policy and model in a rollout", size=curves.LABEL)
    axes.set_ylabel("success, %", size=curves.LABEL, color=INK)
    curves.label_ends(axes, ends, data.styles, high - 1, curves.LABEL)
    notes = ["means of the rollouts with times; labels: condition"]
    if not all(record["complete"] for record in records):
        notes.insert(0, "hollow: incomplete cell")
    curves.legend(figure, "; ".join(notes))
    title = f"Success against cost, {data.simulator}, with 95% intervals"
    axes.set_title(title, loc="left", size=curves.TITLE, color=INK)
    return True


def _label(axes: Any, text: str, place: float, value: float) -> Any:
    return axes.annotate(
        text,
        (place, value),
        xytext=(4, 4),
        textcoords="offset points",
        size=curves.SMALL,
        color=INK,
    )
