"""What rollouts cost: means of what their rows record, beside the rates of `main`."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support import scoring as made
from support.scoring import BASE, OWN, record, records

from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.score.plots.data import Data
from robomme_interference_data.evaluate.score.plots.figures import draw_figure
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.viz.figure import open_figure


def timed(letters: str, *costs: dict[str, Any], condition: str = "k0") -> list[Any]:
    """Rows of an episode a letter, each with its costs."""
    rows = made.cells({(OWN, condition): letters})
    return [replace(row, **cost) for row, cost in zip(rows, costs, strict=True)]


def test_means_over_the_rollouts_that_count_and_have_times(tmp_path: Path) -> None:
    rows = timed(
        "sffes",
        {"history_s": 1.0, "policy_s": 2.0},
        {"history_s": 2.0, "policy_s": 4.0, "model_s": 3.0, "model_tokens": 100},
        {"history_s": 3.0},
        {"history_s": 100.0},  # an error
        {},
    )
    found = made.score(made.write_parquet(tmp_path / "a.parquet", rows))
    cost, main = record(found, "cost"), record(found, "main", system=OWN)
    assert {name: cost[name] for name in ("n", "rate", "low", "high", "complete")} == {
        name: main[name] for name in ("n", "rate", "low", "high", "complete")
    }
    assert cost["rollouts"] == 3
    assert (cost["history_s"], cost["policy_s"], cost["model_s"]) == (2.0, 3.0, 3.0)
    assert (cost["seconds"], cost["model_tokens"]) == (5.0, 100)  # (3 + 9 + 3) / 3
    assert cost["seconds_per_success"] == 15.0  # of three rollouts, one succeeds


def test_without_a_success_or_times(tmp_path: Path) -> None:
    rows = timed("ff", {"policy_s": 1.0}, {"policy_s": 1.0}, condition="k7")
    rows += timed("s", {})
    found = made.score(made.write_parquet(tmp_path / "a.parquet", rows))
    (cost,) = records(found, "cost")
    assert (cost["condition"], cost["seconds_per_success"], cost["history_s"]) == ("k7", None, None)


def test_rows_without_times_have_no_table_of_costs(small: Any) -> None:
    assert "cost" not in small.tables
    with open_figure() as figure:
        assert not draw_figure("cost", figure, Data(small, "tabletop"))


def test_runs_and_their_tables_cost_the_same(tmp_path: Path) -> None:
    rows = timed("sf", {"policy_s": 0.5, "model_tokens": 7}, {"policy_s": 1.5})
    paths = (
        made.write_run(tmp_path / "run", rows),
        made.write_csv(tmp_path / "a.csv", rows),
        made.write_parquet(tmp_path / "a.parquet", rows),
    )
    tables = {made.score(path).tables["cost"].csv() for path in paths}
    assert len(tables) == 1


@pytest.mark.parametrize(
    ("column", "value"), [("policy_s", -1.0), ("history_s", float("inf")), ("model_tokens", -5)]
)
def test_costs_below_zero_are_bad_rows(tmp_path: Path, column: str, value: Any) -> None:
    path = made.write_parquet(tmp_path / "a.parquet", timed("s", {column: value}))
    with pytest.raises(FormatError) as raised:
        read_rows([path])
    assert column in raised.value.message


def test_the_figure_has_a_point_for_each_condition(tmp_path: Path) -> None:
    costs = {"no-history": 0.1, "k0": 1.0, "k7": 20.0}
    rows = []
    for system in (OWN, BASE):
        for condition, seconds in costs.items():
            cells = made.cells({(system, condition): "sf"})
            rows += [replace(row, policy_s=seconds) for row in cells]
    found = made.score(made.write_parquet(tmp_path / "a.parquet", rows))
    with open_figure() as figure:
        assert draw_figure("cost", figure, Data(found, "tabletop"))
        (axes,) = figure.axes
        assert axes.get_xscale() == "log"
        labels = [text.get_text() for text in axes.texts]
    assert sorted(labels[:3] + labels[3:6]) == sorted(["none", "k0", "k7"] * 2)
