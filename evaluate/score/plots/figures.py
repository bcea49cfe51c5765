"""Figures of a score, one set for each simulator."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robomme_interference_data.constants import ABILITIES, DIFFICULTIES, RECORDINGS
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import published_base
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS, parse_condition
from robomme_interference_data.viz.figure import INK, open_figure, save_figure

from . import cost, curves, family_forest, forests, matrices
from .curves import curve, explained, legend
from .data import FEW, PUBLISHED, Data

_PAPER = {parse_condition(name).kind for name in DEFAULT_CONDITIONS}
_ALL = "All families"


def draw_figures(
    score: Score, folder: Path, suffixes: Sequence[str] = (".svg",)
) -> dict[str, Path]:
    """Draw every figure that has data, as `<figure>-<simulator>` with each suffix.

    Returns the SVGs by name without suffix, in the order of `FIGURES`.
    """
    drawn = {}
    for simulator in score.outcomes:
        data = Data(score, simulator)
        for kind in [name for name, known in FIGURES.items() if known.draw is not None]:
            with open_figure() as figure:
                if draw_figure(kind, figure, data):
                    name = f"{kind}-{simulator}"
                    for suffix in suffixes:
                        save_figure(figure, folder / (name + suffix))
                    drawn[name] = folder / f"{name}.svg"
    if any(cell.n for cell in score.error_cells):
        with open_figure() as figure:
            draw_error_figure(figure, score)
            name = f"action_error-{RECORDINGS}"
            for suffix in suffixes:
                save_figure(figure, folder / (name + suffix))
            drawn[name] = folder / f"{name}.svg"
    return drawn


def draw_error_figure(figure: Any, score: Score) -> None:
    """Draw the figure of offline runs."""
    from . import offline  # few scores have any

    figure.set_layout_engine("constrained")
    offline.action_error(figure, score)
    _finish(figure)


def draw_figure(kind: str, figure: Any, data: Data) -> bool:
    """Draw one of `FIGURES` of rollouts; return False if there is no data for it."""
    known = FIGURES[kind]
    assert known.draw is not None
    shown = data if known.all_kinds else data.of(_PAPER)
    figure.set_layout_engine("constrained")
    if not (shown.cells and known.draw(figure, shown)):
        return False
    _finish(figure)
    return True


def _finish(figure: Any) -> None:
    """Lay out a drawn figure, and give its marked elements ids."""
    figure.get_layout_engine().execute(figure)
    figure.set_layout_engine("none")  # once, not again for each file
    for number, artist in enumerate(figure.findobj(lambda artist: artist.get_gid())):
        artist.set_gid(f"{artist.get_gid()}:{number}")  # ids must be unique in a file


def _success(figure: Any, data: Data) -> bool:
    few = len(data.systems) <= FEW
    systems = [*data.systems, *data.absent]
    places = curves.shifts(systems, min(0.09, 0.55 / len(systems)))
    high = 4.2 if few else 5.5
    figure.set_size_inches(curves.WIDTH, high)
    axes = figure.subplots()
    ends: dict[str, float] = {}
    for name, shift in places.items():
        ends |= curve(axes, data, name, "", shift)
    # With many systems, published points would be clutter.
    beside = data.beside if few else []
    for name in beside:
        shift = places[name.removesuffix(", published")]
        curve(axes, data, name, "", shift, bars=False)
    ends |= curves.chance_level(axes, data, "")
    curves.set_axes(axes, data, [*places, *beside], "success, %")
    curves.label_ends(axes, ends, data.styles, high - 1, curves.LABEL)
    note = "published rates: in the table “paper”" if len(beside) < len(data.beside) else ""
    legend(figure, explained(data, [*places, *beside], [""], note))
    title = f"Success by condition, {data.simulator}, with 95% intervals"
    axes.set_title(title, loc="left", size=curves.TITLE, color=INK)
    return True


def _families(figure: Any, data: Data) -> bool:
    panels = {part: (data, part) for part in data.parts(data.families)}
    few = len(data.systems) <= FEW
    published = [name for name in (*data.absent, *data.beside) if few and data.has_parts(name)]
    return _panels(figure, data, panels, [*data.systems, *published])


def _difficulty(figure: Any, data: Data) -> bool:
    panels = {part: (data, part) for part in data.parts(DIFFICULTIES)}
    return _panels(figure, data, panels, data.systems)


def _ability(figure: Any, data: Data) -> bool:
    panels = {part: (data, part) for part in data.parts(ABILITIES)}
    return _panels(figure, data, panels, data.systems)


def _retrieval(figure: Any, data: Data) -> bool:
    systems = []
    for system in data.systems:
        for name in (data.bases[system], f"{published_base(system)}{PUBLISHED}"):
            if name in data.systems or name in data.absent:
                systems += [system, name]
    panels = {part or _ALL: (data, part) for part in ("", *data.parts(data.families))}
    return _panels(figure, data, panels, systems)


def _kinds(figure: Any, data: Data) -> bool:
    if _PAPER.issuperset(data.kinds):
        return False
    plain = [kind for kind in data.kinds if not kind.counted]  # the floor of each panel
    counted = [kind for kind in data.kinds if kind.counted]
    panels = {kind.pattern: (data.of([*plain, kind]), "") for kind in counted}
    return _panels(figure, data, panels, data.systems)


def _panels(
    figure: Any, data: Data, panels: Mapping[str, tuple[Data, str]], systems: Sequence[str]
) -> bool:
    """Draw panels, three in a row: each title to its data and its part of the episodes."""
    if not (panels and systems):
        return False
    wide, bars = 3, len(systems) <= FEW
    high = 2.0 if bars else 2.4
    figure.set_size_inches(curves.WIDTH, 0.9 + high * math.ceil(len(panels) / wide))
    grid = curves.panel_grid(figure, len(panels), wide)
    ends: list[dict[str, float]] = []
    for axes, (title, (shown, part)) in zip(grid, panels.items(), strict=True):
        ends.append({})
        # Without intervals, points do not hide one another.
        for system, shift in curves.shifts(systems, 0.09 if bars else 0.0).items():
            ends[-1] |= curve(axes, shown, system, part, shift, bars=bars)
        ends[-1] |= curves.chance_level(axes, shown, part)
        axes.set_title(
            title, size=curves.HEADING, color=INK, weight="bold" if title == _ALL else "normal"
        )
    for number, axes in enumerate(grid):
        curves.set_axes(axes, data, systems, "" if number % wide else "success, %")
    for axes, own_ends in zip(grid, ends, strict=True):
        curves.label_ends(axes, own_ends, data.styles, high - 0.45, curves.SMALL)
    note = "95% intervals" if bars else "95% intervals: in the table"
    legend(figure, explained(data, systems, [p for _, p in panels.values()], note))
    return True


@dataclass(frozen=True)
class FigureKind:
    """A kind of figure.

    Attributes:
        title: Its title.
        tables: The tables with its numbers.
        draw: Draws it; returns False without data for it. None for the figure of offline runs.
        all_kinds: Whether it shows all kinds of conditions; the others show the paper's.
    """

    title: str
    tables: tuple[str, ...]
    draw: Callable[[Any, Data], bool] | None
    all_kinds: bool = False


FIGURES = {
    "family_falls": FigureKind(
        "Fall in each family, and over all other families",
        ("parts", "families"),
        family_forest.family_falls,
    ),
    "interference": FigureKind(
        "Effect of each kind of interference", ("effects",), forests.interference, all_kinds=True
    ),
    "kinds": FigureKind(
        "Success by condition and kind of condition", ("main",), _kinds, all_kinds=True
    ),
    "effects": FigureKind(
        "Effect of each condition, paired over episodes", ("effects",), forests.effects
    ),
    "success": FigureKind("Success by condition, all families", ("main", "paper"), _success),
    "families": FigureKind("Success by condition and family", ("parts",), _families),
    "difficulty": FigureKind("Success by condition and difficulty", ("parts",), _difficulty),
    "ability": FigureKind("Success by condition and ability", ("parts",), _ability, all_kinds=True),
    "retention": FigureKind(
        "Share of the lift that is left at the most sessions", ("effects",), forests.retention
    ),
    "heatmap": FigureKind(
        "Success by family and condition", ("parts",), matrices.heatmap, all_kinds=True
    ),
    "retrieval": FigureKind("Systems with and without retrieval", ("effects", "parts"), _retrieval),
    "by_evidence_kept": FigureKind(
        "Success by whether the memory kept the evidence",
        ("evidence_effects", "evidence_use"),
        forests.by_evidence_kept,
    ),
    "ceiling": FigureKind(
        "Gap to the ideal observer with the same memory",
        ("effects",),
        forests.ceiling,
        all_kinds=True,
    ),
    "cost": FigureKind("Success against the seconds of a rollout", ("cost",), cost.cost),
    "matrix": FigureKind("Which systems differ significantly", ("matrix", "main"), matrices.matrix),
    "action_error": FigureKind(
        "Action error by condition", ("action_error", "action_error_effects"), None
    ),
}
"""Figures by name, in the order of the report.

The first ones show conditions beyond the paper's, where there are any: they are what such a run is
about, and the figures after them leave them out.
"""
