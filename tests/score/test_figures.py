"""What figures tell beside their points: who is who, what a hollow point means, who is left out."""

from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import scoring as made
from support.scoring import BASE, OWN, cells

from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.score.plots.curves import WIDTH, spread
from robomme_interference_data.evaluate.score.plots.data import Data
from robomme_interference_data.evaluate.score.plots.figures import (
    FIGURES,
    draw_figure,
    draw_figures,
)
from robomme_interference_data.evaluate.score.plots.styles import SeriesStyle, styles_of
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import PAPER_SYSTEMS, SYSTEMS
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.viz.figure import open_figure


def data(path: Path, rows: list[Rollout], paper: bool = False) -> Data:
    found = made.score(made.write_parquet(path / "a.parquet", rows), paper=paper, draws=50)
    return Data(found, rows[0].simulator)


@pytest.fixture
def figure() -> Iterator[Any]:
    with open_figure() as figure:
        yield figure


def explained(figure: Any) -> str:
    """What the figure's legend is headed by."""
    return "; ".join(legend.get_title().get_text() for legend in figure.legends)


def names(figure: Any) -> list[set[str]]:
    """Whom each panel names at the ends of lines."""
    panels = ({text.get_text() for text in axes.texts} - {""} for axes in figure.axes)
    return [found for found in panels if found]


# --- styles -------------------------------------------------------------------------------------


def shapes(styles: Iterable[SeriesStyle], *, color: bool = False) -> set[tuple[str, ...]]:
    return {(style.color * color, style.marker, str(style.line)) for style in styles}


def test_systems_differ_from_each_other_and_look_the_same_in_every_figure() -> None:
    own = [f"own-{number}" for number in range(48)]
    without = [name for name, system in SYSTEMS.items() if system.facts.retrieval is None]
    together = styles_of([*own, *without])
    assert len(shapes(together.values(), color=True)) == len(together)
    for name in without:
        assert styles_of([name])[name] == together[name]
    # Two dozen systems outside the table differ without color, too.
    mine, table = (shapes(together[n] for n in names) for names in (own[:24], without))
    assert len(mine) == 24 and not mine & table
    paper = styles_of([system.name for system in PAPER_SYSTEMS]).values()
    assert len(shapes(paper, color=True)) == 13


def test_retrieval_steps_of_one_system_differ_in_color_and_marker() -> None:
    names = [f"retrieval-replay-full-{step}" for step in ("max", "oracle", "joined")]
    found = styles_of(names, names).values()
    assert len({style.color for style in found}) == len({style.marker for style in found}) == 3


# --- figures -----------------------------------------------------------------------------------

WHOLE = [row for row in made.rows() if row.system == BASE]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rows", "paper", "expected"),
    [
        (WHOLE, True, ""),  # published rates are of RoboMME alone
        (
            made.changed(WHOLE[:-1], simulator="robomme"),
            True,
            "hollow: incomplete cell; dashes: published rates",
        ),
    ],
)
def test_a_legend_explains_hollow_and_published_points(
    tmp_path: Path, figure: Any, rows: list[Rollout], paper: bool, expected: str
) -> None:
    assert draw_figure("success", figure, data(tmp_path, rows, paper))
    assert explained(figure) == expected


def test_the_retention_figure_names_whom_it_leaves_out(tmp_path: Path, figure: Any) -> None:
    rows = [row for row in made.rows() if row.system != OWN]
    # Of the own memory no episode is lifted, and its retention is of nothing.
    own = made.changed(WHOLE, system=OWN, status="fail", success=False)
    assert draw_figure("retention", figure, data(tmp_path, [*rows, *own]))
    (axes,) = figure.axes
    labels = [text.get_text() for text in axes.get_yticklabels()]
    assert labels == ["Retrieval-FrameSamp-Modul", "FrameSamp-Modul"]
    assert explained(figure).endswith("or rows missing at k7): my-memory")
    # Two points, and the lines at 0 and 1.
    assert len(axes.lines) == 4
    with open_figure() as other:
        assert draw_figure("retention", other, data(tmp_path, rows))
        assert "Not shown" not in explained(other)


# --- many systems ------------------------------------------------------------------------------


@pytest.mark.slow
def test_twelve_systems_are_named_at_their_values_without_dodge(full: Score, figure: Any) -> None:
    shown = Data(full, "robomme")
    everyone = {shown.styles[system].label for system in shown.systems}
    places = {shown.x(name) for name in shown.shown(shown.systems)}
    for kind, panels in (("success", 1), ("families", 9), ("difficulty", 3)):
        with open_figure() as other:
            assert draw_figure(kind, other, shown)
            assert names(other) == [everyone] * panels
            for axes in other.axes[:panels]:
                heights = sorted(text.get_position()[1] for text in axes.texts if text.get_text())
                letter = 6.5 / 72 * axes.get_ylim()[1] / axes.bbox.height * other.dpi
                assert np.diff(heights).min() > letter
                assert heights[0] >= 0 and heights[-1] <= axes.get_ylim()[1]
                points = {x for line in axes.lines for x in line.get_xdata()} - {0, 1}
                # Floors and labels: 0 and 1 of the width. Only one panel has room for intervals.
                assert kind == "success" or points <= places

    # Each row of effects is marked as its system's, and an id occurs once.
    assert draw_figure("effects", figure, shown)
    first, *others = figure.axes
    rows = [label.get_text() for label in first.get_yticklabels()]
    assert len(rows) == 11 and rows[-1] == "FrameSamp-Modul"  # it falls most
    titles = [axes.get_title() for axes in (first, *others)]
    assert titles == ["k0 − none", "k1 − k0", "k3 − k0", "k7 − k0"]
    marks = [one.get_gid() for one in figure.findobj(lambda one: one.get_gid())]
    assert len(marks) == len(set(marks)) == 11 * 4 * 2  # an interval and a point
    assert {gid.split(":")[1] for gid in marks} == {*shown.systems} - {"pi05_baseline"}
    # 196 √(0.06 / 450) points of noise, assumed.
    assert "±2.3 points" in explained(figure) and "assumed" in explained(figure)

    # All pairs of the eleven at k0 and at k7, best first; filled are those that can be told apart.
    with open_figure() as other:
        assert draw_figure("matrix", other, shown)
        for axes, condition in zip(other.axes, ("k0", "k7"), strict=True):
            told = {one for name, one in shown.distinguishable if name == condition}
            assert axes.get_title() == condition and len(axes.texts) == 11 * 10 / 2
            assert sum(text.get_weight() == "bold" for text in axes.texts) == len(told) > 0
            assert (~np.isnan(axes.images[0].get_array().filled(np.nan))).sum() == len(told)
        best = [axes.get_yticklabels()[0].get_text() for axes in other.axes]
        assert best == ["FrameSamp-Modul", "GroundSG"]

    # Of FrameSamp's systems it is known what was kept: at k0 all of it.
    with open_figure() as other:
        assert draw_figure("by_evidence_kept", other, shown)
        labels = {"all kept", "some kept", "none kept"}
        assert names(other) == [labels] * 3
        lines = [line for line in other.axes[0].lines if len(line.get_xdata()) > 1]
        assert lines[0].get_ydata()[0] == pytest.approx(100 * 204 / 450)
        assert len(lines[0].get_xdata()) == 4


@pytest.mark.slow
def test_numbers_in_figures_are_those_of_tables(full: Score) -> None:
    shown = Data(full, "robomme")
    systems = {style.label: name for name, style in shown.styles.items()}
    with open_figure() as figure:
        assert draw_figure("heatmap", figure, shown)
        for axes in figure.axes[: len(shown.systems)]:
            conditions = [label.get_text() for label in axes.get_xticklabels()]
            assert axes.texts
            for text in axes.texts:
                x, y = text.get_position()
                system = systems[axes.get_title().replace("\n", " ")]
                condition = NO_HISTORY if conditions[x] == "none" else conditions[x]
                key = {"system": system, "condition": condition, "part": shown.families[y]}
                assert text.get_text() == f"{100 * made.record(full, 'parts', **key)['rate']:.0f}"
    with open_figure() as figure:
        assert draw_figure("matrix", figure, shown)
        for axes in figure.axes:
            rows, columns = (
                [systems[label.get_text().replace("\n", " ")] for label in labels]
                for labels in (axes.get_yticklabels(), axes.get_xticklabels())
            )
            for text in axes.texts:
                x, y = text.get_position()
                [pair] = [
                    record
                    for record in made.records(full, "matrix", condition=axes.get_title())
                    if {record["system"], record["against_system"]} == {rows[y], columns[x]}
                ]
                points = 100 * pair["difference"] * (1 if pair["system"] == rows[y] else -1)
                assert int(text.get_text().replace("\N{MINUS SIGN}", "-")) == round(points)
                assert (text.get_weight() == "bold") == (pair["verdict"] == "shown")
    with open_figure() as figure:
        assert draw_figure("family_falls", figure, shown)
        for axes, system in zip(figure.axes, shown.systems[1:], strict=False):  # without π0.5
            falls = made.record(
                full, "families", system=system, condition="k7", against_condition="k0"
            )
            lines = [line for line in axes.lines if line.get_marker() == "|"]
            [without] = [sorted(line.get_xdata()) for line in lines]
            ends = [100 * falls[name] for name in ("without_low", "without_high")]
            assert [without[0], without[-1]] == pytest.approx(ends)
            parts = made.records(full, "parts", system=system, by="family", condition="k7")
            assert without == pytest.approx(sorted(100 * part["fall_without"] for part in parts))


def test_systems_of_equal_rates_keep_the_order_of_tables(tmp_path: Path, figure: Any) -> None:
    systems = [f"system-{letter}" for letter in "abcdefg"]
    given = {(name, "k0"): "sf" if place % 2 else "fs" for place, name in enumerate(systems)}
    assert draw_figure("matrix", figure, data(tmp_path, cells(given)))
    (axes,) = figure.axes
    assert [label.get_text() for label in axes.get_yticklabels()] == systems[:-1]
    assert [label.get_text() for label in axes.get_xticklabels()] == systems[1:]
    assert {text.get_text() for text in axes.texts} == {"0"}  # and not −0


def test_two_systems_have_no_matrix(tmp_path: Path, figure: Any) -> None:
    given = {(name, "k0"): "ssff" for name in ("a", "b")}
    assert not draw_figure("matrix", figure, data(tmp_path, cells(given)))


@pytest.mark.slow
def test_figures_are_as_wide_as_each_other_and_hold_their_notes(tmp_path: Path) -> None:
    """A page scales all figures to one width: then letters of one size look alike."""
    found = Data(made.kinds(tmp_path), "tabletop")
    drawn = 0
    for kind in FIGURES:
        with open_figure() as figure:
            if kind == "action_error" or not draw_figure(kind, figure, found):
                continue
            drawn += 1
            assert figure.get_figwidth() == WIDTH, kind
            page = figure.bbox
            for note in figure.legends:
                box = note.get_window_extent()
                assert page.x0 <= box.x0 and box.x1 <= page.x1, kind
    assert drawn > 6


@pytest.mark.slow
def test_conditions_beyond_the_papers_come_first(tmp_path: Path) -> None:
    found = made.kinds(tmp_path)
    names = [name.partition("-")[0] for name in draw_figures(found, tmp_path / "figures")]
    assert names[:2] == ["interference", "kinds"]


@given(st.lists(st.floats(0, 100), min_size=1, max_size=12).map(sorted), st.floats(0.1, 9))
def test_labels_keep_their_order_their_distance_and_their_bounds(
    values: list[float], gap: float
) -> None:
    found = spread(values, gap, 0, 100)
    assert len(found) == len(values)
    assert all(b - a >= gap - 1e-9 for a, b in pairwise(found))
    assert found[0] >= -1e-9 and found[-1] <= 100 + 1e-9
    if all(b - a >= gap for a, b in pairwise(values)):
        assert found == pytest.approx(values)
