"""The tables of offline runs, worked out by hand."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from support import scoring as made
from support.scoring import OWN

from robomme_interference_data.errors import FormatError, InvalidOptionError
from robomme_interference_data.evaluate.score.comparisons.compare import compare
from robomme_interference_data.evaluate.score.report.methods import methods
from robomme_interference_data.evaluate.score.rows.export import export
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.evaluate.score.writing import write_score
from robomme_interference_data.schema.rollouts import Rollout

ERRORS = {  # of the values of actions, in episodes 0, 1, 2
    "no-history": [(0.5, 0.7), (0.4, 0.8), (0.5, 0.5)],  # means 0.6, 0.6, 0.5
    "k0": [(0.1, 0.3), (0.2, 0.2), (0.1, 0.1)],  # 0.2, 0.2, 0.1
    "k1": [(0.1, 0.5), (0.2, 0.4), None],  # 0.3, 0.3
    "held-k1": [(0.1, 0.3), (0.2, 0.2), (0.1, 0.1)],
}


def row(condition: str, episode: int, values: tuple[float, ...] | None) -> Rollout:
    one = made.row(OWN, condition, "MoveCube", episode, "s")
    one = replace(one, simulator="recordings", family="OpenDrawer", seed=None)
    if values is None:
        return replace(one, status="error", success=None, error="it broke")
    return replace(
        one,
        status="measured",
        success=None,
        action_l1=sum(values) / len(values),
        action_l1_values=" ".join(map(str, values)),
    )


def rows() -> list[Rollout]:
    return [
        row(condition, episode, values)
        for condition, cells in ERRORS.items()
        for episode, values in enumerate(cells)
    ]


@pytest.mark.parametrize(
    ("name", "write"),
    [("a.csv", made.write_csv), ("a.parquet", made.write_parquet), ("run", made.write_run)],
)
def test_means_and_changes(tmp_path: Path, name: str, write: Callable[..., Path]) -> None:
    found = made.score(write(tmp_path / name, rows()), draws=200)
    means = found.tables["action_error"].rows
    assert [(*one[:3], round(one[3], 9)) for one in means] == [
        (OWN, "no-history", 3, round(1.7 / 3, 9)),
        (OWN, "k0", 3, round(0.5 / 3, 9)),
        (OWN, "k1", 2, 0.3),
        (OWN, "held-k1", 3, round(0.5 / 3, 9)),
    ]
    values = found.tables["action_error_values"].rows
    k1 = [(one[2], one[3], round(one[4], 9)) for one in values if one[1] == "k1"]
    assert k1 == [(0, 2, 0.15), (1, 2, 0.45)]
    changes = {(one[1], one[2]): one[3:] for one in found.tables["action_error_changes"].rows}
    assert {pair: (one[0], round(one[3], 9), one[6]) for pair, one in changes.items()} == {
        ("k0", "no-history"): (3, -0.4, 0.25),  # three equal differences: 2 of 8 signs
        ("k1", "no-history"): (2, -0.3, 0.5),  # of 4
        ("held-k1", "no-history"): (3, -0.4, 0.25),
        ("k1", "k0"): (2, 0.1, 0.5),
        ("held-k1", "k0"): (3, 0.0, 1.0),
        ("k1", "held-k1"): (2, 0.1, 0.5),
    }
    assert {one[7] for one in changes.values()} == {1.0}  # of six tests: 6 · 0.25 is above 1
    assert {one[4:6] for one in changes.values()} - {(0.0, 0.0)}  # no interval of three episodes
    text, cited = methods(found)
    assert "recorded executions" in text and "Success rates" not in text and "efron1987" in cited
    write_score(found, tmp_path / "score")
    assert "Action error offline" in (tmp_path / "score/report.html").read_text(encoding="utf-8")


def test_intervals_of_enough_episodes(tmp_path: Path) -> None:
    """Episodes 0 to 11: k1 is worse by 0.01 to 0.12, so by 0.065 on average."""
    cells = [row("k0", n, (0.2,)) for n in range(12)]
    cells += [row("k1", n, (0.2 + (n + 1) / 100,)) for n in range(12)]
    repeats = [replace(one, model_seed=1) for one in cells]
    found = made.score(made.write_parquet(tmp_path / "rows.parquet", [*cells, *repeats]))
    [change] = found.tables["action_error_changes"].records()
    assert (change["n"], round(change["difference"], 9)) == (12, 0.065)
    assert 0.04 < change["low"] < 0.065 < change["high"] < 0.09
    assert change["p"] == change["p_holm"] == 2 / 2**12


def test_rollouts_beside_them_are_scored_as_before(tmp_path: Path) -> None:
    both = made.write_parquet(tmp_path / "both.parquet", [*made.rows(), *rows()])
    alone = made.write_parquet(tmp_path / "alone.parquet", made.rows())
    found, expected = made.score(both, draws=50), made.score(alone, draws=50)
    assert {*found.tables} - {*expected.tables} == {
        "action_error",
        "action_error_changes",
        "action_error_values",
    }
    for name, table in expected.tables.items():
        assert found.tables[name].csv() == table.csv()


def test_what_needs_outcomes_says_so(tmp_path: Path) -> None:
    path = made.write_parquet(tmp_path / "rows.parquet", rows())
    with pytest.raises(InvalidOptionError, match="rows of offline runs have no outcomes"):
        compare(path, conditions=("k0", "k1"))
    with pytest.raises(InvalidOptionError, match="12 rows of offline runs"):
        export(read_rows([path]), tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"action_l1": -0.5}, "action_l1 -0.5; expected a number from 0"),
        ({"action_l1": float("inf")}, "action_l1 inf"),
        ({"action_l1_values": "0.1 x"}, "action_l1_values '0.1 x'"),
        ({"family": "Open/Drawer"}, "Open/Drawer"),
    ],
)
def test_bad_rows(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    bad = [replace(rows()[0], **changes)]  # type: ignore[arg-type]
    with pytest.raises(FormatError, match=message):
        read_rows([made.write_parquet(tmp_path / "bad.parquet", bad)])
