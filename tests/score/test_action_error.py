"""The tables of offline runs, worked out by hand."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.collections import LineCollection
from support import scoring as made
from support.messages import raises
from support.scoring import OWN
from support.scoring import recording as row

from robomme_interference_data.errors import FormatError, InvalidOptionError, RunError
from robomme_interference_data.evaluate.run.plan import RunPlan
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.score.compare import compare
from robomme_interference_data.evaluate.score.plots.figures import draw_error_figure
from robomme_interference_data.evaluate.score.report.headline import headlines
from robomme_interference_data.evaluate.score.report.methods import methods
from robomme_interference_data.evaluate.score.rows.export import export
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.evaluate.score.writing import write_score
from robomme_interference_data.viz.figure import open_figure

ERRORS = {  # of the values of actions, in episodes 0, 1, 2
    "no-history": [(0.5, 0.7), (0.4, 0.8), (0.5, 0.5)],  # means 0.6, 0.6, 0.5
    "k0": [(0.1, 0.3), (0.2, 0.2), (0.1, 0.1)],  # 0.2, 0.2, 0.1
    "k1": [(0.1, 0.5), (0.2, 0.4), None],  # 0.3, 0.3
    "held-k1": [(0.1, 0.3), (0.2, 0.2), (0.1, 0.1)],
}


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
    found = made.score(write(tmp_path / name, rows()), draws=2000)
    means = made.records(found, "action_error", family="all")
    assert [(one["condition"], one["n"], round(one["action_l1"], 9)) for one in means] == [
        ("no-history", 3, round(1.7 / 3, 9)),
        ("k0", 3, round(0.5 / 3, 9)),
        ("k1", 2, 0.3),
        ("held-k1", 3, round(0.5 / 3, 9)),
    ]
    changes = {
        (one["condition"], one["against_condition"]): (
            one["n"],
            round(one["difference"], 9),
            (one["gained"], one["lost"]),
            pytest.approx(one["p"], abs=0.05),
        )
        for one in made.records(found, "action_error_effects")
    }
    assert changes == {
        ("k0", "no-history"): (3, -0.4, (3, 0), 0.25),  # three equal differences: 2 of 8 signs
        ("k1", "no-history"): (2, -0.3, (2, 0), 0.5),  # of 4
        ("held-k1", "no-history"): (3, -0.4, (3, 0), 0.25),
        ("k1", "k0"): (2, 0.1, (0, 2), 0.5),
        ("held-k1", "k0"): (3, 0.0, (0, 0), 1.0),
        ("k1", "held-k1"): (2, 0.1, (0, 2), 0.5),
    }
    # No interval of three episodes.
    assert {one["low"] for one in made.records(found, "action_error_effects")} == {None}
    text, cited = methods(found)
    assert "recorded executions" in text and "Success rates" not in text and "efron1987" in cited


def test_intervals_of_enough_episodes(tmp_path: Path) -> None:
    """Episodes 0 to 11: k1 is worse by 0.01 to 0.12, so by 0.065 on average."""
    cells = [row("k0", n, (0.2,)) for n in range(12)]
    cells += [row("k1", n, (0.2 + (n + 1) / 100,)) for n in range(12)]
    repeats = [replace(one, model_seed=1) for one in cells]
    found = made.score(made.write_parquet(tmp_path / "rows.parquet", [*cells, *repeats]))
    [change] = made.records(found, "action_error_effects")
    assert (change["n"], round(change["difference"], 9)) == (12, 0.065)
    assert 0.03 < change["low"] < 0.065 < change["high"] < 0.1
    assert change["p"] == change["p_holm"] < 0.02


@pytest.fixture
def broken(tmp_path: Path) -> Path:
    """A system of which all recordings of the hardest of three families broke, and a whole one."""
    families = {"OpenDrawer": 0.1, "PourTea": 0.2, "StackCups": 0.9}
    every = [
        replace(row("k0", number, (error + number / 100,)), family=family, system=system)
        for system in ("mine", "other")
        for family, error in families.items()
        for number in range(2)
    ]
    kept = [
        replace(one, status="error", action_l1=None, action_l1_values=None, error="it broke")
        if (one.system, one.family) == ("mine", "StackCups")
        else one
        for one in every
    ]
    return made.write_parquet(tmp_path / "broken.parquet", kept)


def test_broken_recordings_are_counted(broken: Path) -> None:
    found = made.score(broken)
    mine = made.record(found, "action_error", system="mine", family="all")
    assert (mine["n"], mine["errors"], mine["missing"], mine["complete"]) == (4, 2, 2, False)
    whole = made.record(found, "action_error", system="other", family="all")
    assert (whole["n"], whole["errors"], whole["missing"], whole["complete"]) == (6, 0, 0, True)
    [grid] = found.grids
    assert dict(grid.rows)["mine"] == "0.1550† n=4, errors: 2"
    assert dict(grid.rows)["other"] == "0.4050 n=6"
    lacking = made.record(found, "action_error", system="mine", family="StackCups")
    assert (lacking["expected"], lacking["n"], lacking["errors"]) == (2, 0, 2)
    assert lacking["missing_episodes"] == lacking["error_episodes"] == "test 0-1"
    # Systems are compared over the recordings that count for both, and the pair is marked.
    pair = made.record(found, "action_error_effects", effect="systems")
    assert (pair["system"], pair["against_system"], pair["n"]) == ("other", "mine", 4)
    assert (pair["difference"], pair["complete"]) == (0, False)
    # The two of `mine`.
    assert "2 broke" in headlines(found)["recordings"]


def test_planned_recordings_are_expected(tmp_path: Path) -> None:
    """A run that stopped early: three of its five planned recordings have rows."""
    plan = RunPlan({"OpenDrawer/test": "0-4"}, ("k0",))
    given = [row("k0", number, (0.1,)) for number in range(3)]
    run = made.write_run(tmp_path / "run", given, plans=(plan,))
    header = json.loads((run / "run.json").read_text())
    header["identity"] = {"simulator": "recordings"}
    (run / "run.json").write_text(json.dumps(header))
    mine = made.record(made.score(run), "action_error", family="all")
    assert (mine["n"], mine["missing"], mine["complete"]) == (3, 2, False)


@pytest.mark.parametrize("simulator", ["recordings", "tabletop", "questions"])
def test_a_run_of_errors_only_is_an_error(tmp_path: Path, simulator: str) -> None:
    given = [replace(made.row(OWN, "k0", "MoveCube", n, "e"), simulator=simulator) for n in (0, 1)]
    path = made.write_parquet(tmp_path / "rows.parquet", given)
    with pytest.raises(RunError) as error:
        made.score(path)
    assert str(path) in error.value.message
    done = made.run("score", path, "--out", tmp_path / "score")
    assert done.exit_code != 0 and not (tmp_path / "score").exists()


def test_systems_are_compared_with_each_other_and_with_baselines(tmp_path: Path) -> None:
    """Twelve recordings; b is better than a by 0.1, and the baseline ran without history only."""
    errors = {("a", "k0"): 0.3, ("b", "k0"): 0.2, ("a", "k1"): 0.4, ("hold", "no-history"): 0.25}
    given = [
        replace(row(condition, n, (error + n / 1000,)), system=system)
        for (system, condition), error in errors.items()
        for n in range(12)
    ]
    found = made.score(made.write_parquet(tmp_path / "rows.parquet", given))
    pairs = {
        (one["system"], one["condition"], one["against_system"], one["against_condition"]): round(
            one["difference"], 9
        )
        for one in made.records(found, "action_error_effects", effect="systems")
    }
    assert pairs == {
        ("a", "k0", "hold", "no-history"): 0.05,
        ("a", "k1", "hold", "no-history"): 0.15,
        ("b", "k0", "hold", "no-history"): -0.05,
        ("b", "k0", "a", "k0"): -0.1,
    }


def headline_of(path: Path, errors: dict[tuple[str, str], float]) -> str:
    """The headline of six recordings with the given error of each system and condition."""
    given = [
        replace(row(condition, n, (error,)), system=system)
        for (system, condition), error in errors.items()
        for n in range(6)
    ]
    return headlines(made.score(made.write_parquet(path / "rows.parquet", given)))["recordings"]


BASELINES = {("hold", "no-history"): 0.1797, ("mean", "no-history"): 0.5723}


def test_no_error_is_called_lowest_that_a_baseline_beats(tmp_path: Path) -> None:
    mine = {("mine", "no-history"): 0.0213, ("mine", "k0"): 0.4875, ("mine", "k3"): 0.5}
    text = headline_of(tmp_path, {**BASELINES, **mine})
    first, second, *_ = text.split(". ")
    assert "lowest" not in text and "0.4875 under k0" in first
    # Worse than Hold and than itself, and better than Mean.
    assert "worse" in second and "Hold (0.1797)" in second and "itself" in second
    assert "(0.0213)" in second and "Mean" not in second


def test_the_lowest_error_is_named_and_each_system_that_is_worse_than_a_baseline(
    tmp_path: Path,
) -> None:
    systems = {("good", "no-history"): 0.3, ("good", "k0"): 0.1, ("bad", "k0"): 0.2}
    text = headline_of(tmp_path, {**BASELINES, **systems})
    first, second, *rest = text.split(". ")
    assert "good has the lowest" in first and "0.1000 under k0" in first
    assert second.startswith("Under k0, bad (0.2000) is worse") and "Hold (0.1797)" in second
    assert "worse" not in "".join(rest)


def test_a_single_error_is_not_called_lowest(tmp_path: Path) -> None:
    assert "lowest" not in headline_of(tmp_path, {("mine", "k0"): 0.1})
    lower_without = headline_of(tmp_path, {("mine", "k1"): 0.3, ("other", "no-history"): 0.2})
    assert "lowest" not in lower_without and "0.3000 under k1" in lower_without


def test_systems_without_a_revision_are_not_compared(tmp_path: Path) -> None:
    lines = [
        f"{system},recordings,OpenDrawer,k0,{n},measured,,20,0.{n + 1}"
        for system in ("a", "b")
        for n in range(2)
    ]
    head = "system,simulator,family,condition,episode,status,success,steps,action_l1"
    path = tmp_path / "rows.csv"
    path.write_text("\n".join([head, *lines]) + "\n")
    found = made.score(path)
    assert "action_error_effects" not in found.tables
    assert [note for note in found.notes if "a, b" in note]


def test_the_report_of_offline_runs_has_no_empty_part(tmp_path: Path) -> None:
    found = made.score(made.write_parquet(tmp_path / "rows.parquet", rows()))
    assert all(table.rows for table in found.tables.values())
    assert [*found.tables] == ["action_error", "action_error_effects"]
    write_score(found, tmp_path / "score", formats=(".png",))
    names = sorted(path.name for path in (tmp_path / "score/figures").iterdir())
    assert names == ["action_error-recordings.png", "action_error-recordings.svg"]
    page = (tmp_path / "score/report.html").read_text(encoding="utf-8")
    assert page.count("<figure ") == 1 and "Empty" not in page
    [data] = re.findall('id="episode-data">(.*?)</script>', page)
    first = json.loads(data)["rows"][0]
    assert first[3:6] == ["test/0", "easy", ["0.6000", "0.2000", "0.3000", "0.2000"]]


@pytest.mark.parametrize(
    ("recordings", "errors", "bars"), [(6, ("k0",), 0), (12, ("k0", "k1"), 1), (12, ("k0",), 1)]
)
def test_the_figure_names_the_intervals_that_it_draws(
    tmp_path: Path, recordings: int, errors: tuple[str, ...], bars: int
) -> None:
    """Errors under k0 vary, those under k1 do not."""
    given = [
        row(condition, n, (n / 100 if condition == "k0" else 0.5,))
        for condition in errors
        for n in range(recordings)
    ]
    found = made.score(made.write_parquet(tmp_path / "rows.parquet", given))
    with open_figure() as figure:
        draw_error_figure(figure, found)
        note = figure.legends[0].get_title().get_text()
        [axes] = figure.axes
        drawn = [one for one in axes.collections if isinstance(one, LineCollection)]
        segments = sum(len(one.get_segments()) for one in drawn)
    assert segments == bars
    assert ("bars" in note) == (bars > 0)
    assert ("fewer than 10" in note) == (bars < len(errors))


def test_errors_that_are_all_zero_have_an_axis(tmp_path: Path) -> None:
    given = [row("k0", n, (0.0,)) for n in range(3)]
    found = made.score(made.write_parquet(tmp_path / "rows.parquet", given))
    with open_figure() as figure:
        draw_error_figure(figure, found)
        assert figure.axes[0].get_ylim() == (0, 1)


def test_rollouts_beside_them_are_scored_as_before(tmp_path: Path) -> None:
    both = made.write_parquet(tmp_path / "both.parquet", [*made.rows(), *rows()])
    alone = made.write_parquet(tmp_path / "alone.parquet", made.rows())
    found, expected = made.score(both, draws=50), made.score(alone, draws=50)
    assert {*found.tables} - {*expected.tables} == {"action_error", "action_error_effects"}
    for name, table in expected.tables.items():
        own = [row for row in found.tables[name].rows if row[0] != "recordings"]
        assert (own, found.tables[name].note) == ([*table.rows], table.note)


def test_two_policies_are_compared(tmp_path: Path) -> None:
    """The second is better by 0.01 to 0.12, so by 0.065 on average."""
    first = made.write_parquet(
        tmp_path / "a.parquet", [replace(row("k0", n, (0.2,)), system="a") for n in range(12)]
    )
    second = made.write_parquet(
        tmp_path / "b.parquet",
        [replace(row("k0", n, (0.2 - (n + 1) / 100,)), system="b") for n in range(12)],
    )
    found = compare(first, second)
    [change, family] = found.table.records()
    assert (change["against_system"], change["system"], change["n"]) == ("a", "b", 12)
    assert (round(change["against_action_l1"], 9), round(change["action_l1"], 9)) == (0.2, 0.135)
    assert (round(change["difference"], 9), change["gained"], change["lost"]) == (-0.065, 12, 0)
    assert -0.1 < change["low"] < -0.065 < change["high"] < -0.03
    assert change["p"] < 0.01 and change["complete"]
    assert family["family"] == "OpenDrawer"


def test_two_conditions_are_compared(tmp_path: Path) -> None:
    path = made.write_parquet(tmp_path / "rows.parquet", rows())
    [change, _] = compare(path, conditions=("k0", "k1")).table.records()
    assert (change["n"], round(change["difference"], 9), change["complete"]) == (2, 0.1, False)


@pytest.mark.parametrize(
    ("held", "suggested"),
    [
        (("no-history", "k0", "k1", "k3"), "--conditions k0,k3"),
        (("no-history", "k1"), "--conditions no-history,k1"),
        (("no-history", "k0"), "--conditions no-history,k0"),
        (("k0",), None),
    ],
)
def test_the_suggested_conditions_are_those_of_the_run(
    tmp_path: Path, held: tuple[str, ...], suggested: str | None
) -> None:
    given = [row(condition, 0, (0.1,)) for condition in held]
    path = made.write_parquet(tmp_path / "rows.parquet", given)
    for second in (None, path):
        with pytest.raises(InvalidOptionError) as error:
            compare(path, second)
        command = error.value.command
        assert command == (suggested and f"compare {path} {suggested}")
        assert all(name in str(error.value.hint) for name in held)


def test_rollouts_are_not_compared_with_recordings(tmp_path: Path) -> None:
    path = made.write_parquet(tmp_path / "rows.parquet", [*rows(), *made.rows()])
    with pytest.raises(InvalidOptionError):
        compare(path, conditions=("k0", "k1"))
    with raises(InvalidOptionError):
        export(read_rows([path]), tmp_path)


@pytest.mark.parametrize(
    "changes",
    [
        {"action_l1": -0.5},
        {"action_l1": float("inf")},
        {"action_l1_values": "0.1 x"},
        {"family": "Open/Drawer"},
        {"action_l1": None},
        {"simulator": "tabletop"},
        {"status": "success", "success": True},
    ],
)
def test_bad_rows(tmp_path: Path, changes: dict[str, object]) -> None:
    bad = [replace(rows()[0], **changes)]  # type: ignore[arg-type]
    with raises(FormatError):
        read_rows([made.write_parquet(tmp_path / "bad.parquet", bad)])


def test_recordings_are_not_compared_with_the_paper(tmp_path: Path) -> None:
    path = made.write_csv(tmp_path / "a.csv", rows())
    without = made.score(path).notes
    found = made.score(path, paper=True)
    assert "paper" not in found.tables
    assert len(found.notes) == len(without) + 1


def test_one_system_is_not_called_the_lowest(tmp_path: Path) -> None:
    [headline] = headlines(made.score(made.write_csv(tmp_path / "a.csv", rows())))
    assert "lowest" not in str(headline)
