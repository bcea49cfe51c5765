"""What figures tell beside their points: who is who, what a hollow point means, who is left out."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import score_rows as made

from robomme_interference_data.evaluate.score.curves import Data
from robomme_interference_data.evaluate.score.figures import _retention, _success
from robomme_interference_data.evaluate.score.grid import Grid
from robomme_interference_data.evaluate.score.looks import looks_of
from robomme_interference_data.evaluate.score.scoring import score
from robomme_interference_data.evaluate.systems import SYSTEMS
from robomme_interference_data.page import open_figure


def words(figure: Any) -> list[str]:
    """Texts of the figure's legends, then those at its foot."""
    legends = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return [*legends, *(text.get_text() for text in figure.texts)]


def drawn(path: Path, rows: list[Any], paper: bool = False) -> Data:
    made.write_parquet(path, rows)
    simulator = rows[0].simulator
    return Data(score([path], grid=Grid.GIVEN, draws=50, against_paper=paper), simulator)


def test_two_dozen_own_systems_differ_without_colour() -> None:
    own = [f"own-{number}" for number in range(24)]
    looks = looks_of([*SYSTEMS, *own])
    shapes = {(looks[name].marker, looks[name].line) for name in own}
    assert len(shapes) == 24
    table = (looks[name] for name in SYSTEMS)
    assert not shapes & {(look.marker, look.line) for look in table}
    more = looks_of([f"own-{number}" for number in range(48)])
    assert len({(look.colour, look.marker, look.line) for look in more.values()}) == 48
    # Neighbours differ in colour as well.
    assert looks["own-0"].colour != looks["own-1"].colour != looks["own-2"].colour


def test_systems_of_the_table_look_the_same_in_every_figure() -> None:
    without = {name for name, system in SYSTEMS.items() if not system.retrieval}
    together = looks_of(["mine", *SYSTEMS])
    for name in without:
        assert looks_of([name])[name] == together[name]
    seen = {(together[n].colour, together[n].marker, together[n].line) for n in without}
    assert len(seen) == len(without)


def test_a_legend_explains_hollow_and_published_points(tmp_path: Path) -> None:
    base = [row for row in made.rows() if row.system == made.BASE]
    robomme = [replace(row, simulator="robomme") for row in base]
    cases = (
        (base, False, []),
        (base[:-1], False, ["cell not complete"]),
        (robomme, True, ["published rate"]),
        (robomme[:-1], True, ["cell not complete", "published rate"]),
        # Published rates are of RoboMME alone.
        (base, True, []),
    )
    for number, (rows, paper, expected) in enumerate(cases):
        data = drawn(tmp_path / f"{number}.parquet", rows, paper)
        with open_figure() as figure:
            assert _success(figure, data)
            assert words(figure) == expected


def test_beside_many_systems_published_rates_are_in_the_table_alone(tmp_path: Path) -> None:
    names = [name for name, s in SYSTEMS.items() if s.paper and s.no_history and s.with_history][:5]
    rows = [
        replace(row, simulator="robomme", system=name)
        for name in names
        for row in made.rows()
        if row.system == made.BASE
    ]
    data = drawn(tmp_path / "a.parquet", rows, paper=True)
    with open_figure() as figure:
        assert _success(figure, data)
        assert words(figure) == ["published rates: in the table"]
        (axes,) = figure.axes
        assert not any(line.get_marker() == "_" for line in axes.lines)
    few = drawn(tmp_path / "b.parquet", [r for r in rows if r.system in names[:4]], paper=True)
    with open_figure() as figure:
        assert _success(figure, few)
        (axes,) = figure.axes
        assert sum(line.get_marker() == "_" for line in axes.lines) == 4


def test_the_retention_figure_names_whom_it_leaves_out(tmp_path: Path) -> None:
    rows = [row for row in made.rows() if row.system != made.OWN]
    # Of the own memory no episode is lifted, and its retention is of nothing.
    own = [
        replace(row, system=made.OWN, status="fail", success=False)
        for row in rows
        if row.system == made.BASE
    ]
    data = drawn(tmp_path / "a.parquet", [*rows, *own])
    with open_figure() as figure:
        assert _retention(figure, data)
        (axes,) = figure.axes
        assert [text.get_text() for text in axes.get_yticklabels()] == [
            "FrameSamp-Modul",
            "Retrieval-FrameSamp-Modul",
        ]
        assert words(figure) == [
            "Not shown (no lift at k0 with p < 0.05, or rows missing at k7): my-memory"
        ]
        # Too few episodes differ for intervals: no bars, two points and the lines at 0 and 1.
        assert len(axes.lines) == 4
    whole = drawn(tmp_path / "b.parquet", rows)
    with open_figure() as figure:
        assert _retention(figure, whole)
        assert words(figure) == []
