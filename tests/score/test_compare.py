"""Two runs compared: pairs, the noise floor, and runs that cannot be paired."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from support import scoring as made
from support.messages import raises
from support.scoring import BASE, OWN, cells, run

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.run.plan import RunPlan
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.score.compare import RunComparison, compare
from robomme_interference_data.stats.intervals import newcombe_paired, wilson
from robomme_interference_data.stats.sequential import look_levels


def compared(tmp_path: Path, a: Sequence[Rollout], b: Sequence[Rollout]) -> RunComparison:
    paths = [made.write_csv(tmp_path / f"{n}.csv", r) for n, r in (("a", a), ("b", b))]
    return compare(*paths)


def own(seed: int = 0, **outcomes: str) -> list[Rollout]:
    return cells({(OWN, condition): text for condition, text in outcomes.items()}, seed)


def test_two_runs_of_one_system_show_the_noise_floor(tmp_path: Path) -> None:
    found = compared(tmp_path, own(k0="ssff", k7="ssss"), own(k0="sfsf"))
    low, high = wilson(2, 4)
    noise, left_out = found.notes
    assert "my-memory ran in both, with the same model seeds, in tabletop" in noise
    assert noise.endswith(f"k0 50.0% of 4 (95% interval {100 * low:.1f} to {100 * high:.1f}).")
    assert left_out.endswith("my-memory in tabletop, k7 (4).")
    assert found.table.records()[0]["flips"] == 0.5


def test_runs_with_other_renderers_are_noted(tmp_path: Path) -> None:
    def ran(name: str, renderer: object) -> Path:
        renderers = {"demonstrations": "A", "distractors": None, "live observations": renderer}
        identity = {"simulator": "tabletop", "renderers": renderers}
        return made.write_run(tmp_path / name, own(k0="ssff"), identity)

    alike = [ran("a", "A"), ran("same", "A"), ran("blind", None)]
    assert not any("renderers" in note for b in alike[1:] for note in compare(alike[0], b).notes)
    differ = (
        "Images come from different renderers: demonstrations and live observations from A; live "
        "observations from B; distractors unknown."
    )
    other = ran("b", "B")
    assert any(note.startswith(differ) for note in compare(alike[0], other).notes)
    # A run by itself: its lessons are of A.
    differ = differ.replace(" and live observations from A", " from A")
    (note,) = (note for note in made.score(other).notes if "renderers" in note)
    assert note.startswith(differ)


def test_model_seeds_are_matched(tmp_path: Path) -> None:
    # Without a seed in common by rank.
    found = compared(tmp_path, own(3, k0="ssff"), own(7, k0="sfff"))
    assert "with other model seeds" in found.notes[0]
    overall = found.table.records()[0]
    assert (overall["n"], overall["gained"], overall["lost"]) == (4, 0, 1)
    # With seed 7 on both sides, it is that seed: episode 0 is lost, and 1 gained.
    found = compared(tmp_path, own(3, k0="ffff") + own(7, k0="sf"), own(7, k0="fsss"))
    overall = found.table.records()[0]
    assert (overall["n"], overall["gained"], overall["lost"], overall["flips"]) == (4, 1, 1, 1)
    assert "with partly other model seeds" in found.notes[0]


def test_runs_over_other_histories_show_no_noise_floor(tmp_path: Path) -> None:
    other = made.changed(own(k0="sf"), revision="cd" * 32, model_seed=9)
    found = compared(tmp_path, own(k0="ss"), other)
    (note,) = found.notes
    assert "are of different buffer sets" in note
    released = made.released(
        tmp_path / "c.csv", [f"{OWN},MoveCube,k0,{e},{e},easy,fail,0,9" for e in range(2)]
    )
    both = made.write_csv(tmp_path / "b.csv", made.changed(own(k0="ss"), simulator="robomme"))
    (note,) = compare(both, released).notes
    assert "different buffer sets (revisions abab" in note
    again = tmp_path / "d.csv"
    again.write_text(released.read_text())
    assert "name no revision of a buffer set" in compare(released, again).notes[0]


def test_two_conditions_of_one_run_are_compared(tmp_path: Path) -> None:
    rows = own(k0="ssssssf-", k7="sfffffse") + cells({(BASE, "k0"): "ss"})
    found = compare(made.write_csv(tmp_path / "a.csv", rows), conditions=("k0", "k7"))
    (overall, _) = found.table.records()
    assert (overall["against_condition"], overall["condition"], overall["n"]) == ("k0", "k7", 7)
    assert (overall["gained"], overall["lost"], overall["p"]) == (1, 5, 14 / 64)
    # Episode 7 broke: the cell is not complete, and every p provisional.
    assert not overall["complete"] and "0.219†" in found.table.markdown()
    assert len(found.runs) == 1 and "noise" not in " ".join(found.notes)
    with raises(InvalidOptionError):
        compare(tmp_path / "a.csv")
    with raises(InvalidOptionError) as none:
        compare(tmp_path / "a.csv", conditions=("k0", "k3"))
    assert f"{BASE}: k0; {OWN}: k0, k7" in str(none.value)
    with raises(InvalidOptionError):
        compare(tmp_path / "a.csv", tmp_path / "a.csv")


def test_what_a_shift_costs_is_measured(tmp_path: Path) -> None:
    found = compared(tmp_path, own(k0="ssss"), made.changed(own(k0="sfff"), shift="light:2"))
    (overall, _) = found.table.records()
    assert (overall["lost"], overall["gained"]) == (3, 0)
    (note,) = found.notes  # and no noise floor: the runs are no repeats
    assert "a is of tabletop and b of tabletop+light:2" in note and "effect of the shift" in note


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"simulator": "robomme"}, "the rows are of different simulators: tabletop and robomme"),
        ({"seed": 77}, "has the seed 0 in one run and 77 in the other"),
        ({"split": "val"}, "counts on both sides under a common condition"),
        ({"condition": "k9"}, "counts on both sides under a common condition"),
        ({"system": "other"}, ""),
    ],
)
def test_what_cannot_be_paired_is_not_compared(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    a, b = own(k0="sfsf"), made.changed(own(k0="sfsf"), **change)
    if not message:  # two systems, one a run, are compared
        assert compared(tmp_path, a, b).table.records()[0]["system"] == "other"
        a, message = [*a, *cells({(BASE, "k0"): "s"})], "no system is in both"
    with raises(InvalidOptionError):
        compared(tmp_path, a, b)


def test_a_run_that_was_stopped_is_marked(tmp_path: Path) -> None:
    plan = RunPlan({"MoveCube/test": "0-9"}, ("k0", "k7"))
    both = own(k0="ssssss", k7="sfffff")
    stopped = made.write_run(tmp_path / "stopped", both, plans=(plan,), status="incomplete")
    found = compare(stopped, conditions=("k0", "k7"))
    overall = found.table.records()[0]
    assert not overall["complete"] and "0.062†" in found.table.markdown()
    (note,) = found.notes
    assert "a was stopped early" in note and "k0 (4 of 10); my-memory in tabletop, k7" in note
    whole = made.write_run(tmp_path / "whole", own(k0="s" * 10, k7="s" * 10), plans=(plan,))
    found = compare(whole, conditions=("k0", "k7"))
    assert found.notes == () and found.table.records()[0]["complete"]
    assert "Without the record of a run" not in found.table.note
    # Nothing is known of the plan of a file by itself.
    alone = made.write_csv(tmp_path / "a.csv", both)
    assert "Without the record of a run" in compare(alone, conditions=("k0", "k7")).table.note


def test_a_planned_look_has_a_level_and_intervals_of_its_own(tmp_path: Path) -> None:
    path = made.write_csv(tmp_path / "a.csv", own(k0="s" * 30, k7="s" * 18 + "f" * 12))
    (overall, _) = compare(path, conditions=("k0", "k7"), look=(2, 5)).table.records()
    level = look_levels(5)[1]
    bounds = newcombe_paired(18, 0, 12, 0, 1 - level)
    assert (overall["low"], overall["high"]) == bounds
    assert (overall["joint_low"], overall["joint_high"]) == bounds  # one row of all families
    done = run("compare", path, "--conditions", "k0,k7", "--looks", "2/5")
    text = " ".join(done.stdout.split())
    assert "Look 2 of 5" in text and f"p holm is below {level:.2g}" in text
    wrong = run("compare", path, "--conditions", "k0,k7", "--looks", "6/5")
    assert isinstance(wrong.exception, InvalidOptionError) and "6/5" in str(wrong.exception)


def test_one_condition_of_two_runs(tmp_path: Path) -> None:
    a = made.write_csv(tmp_path / "a.csv", own(k0="ssff", k7="ssss"))
    b = made.write_csv(tmp_path / "b.csv", own(k0="sfsf", k7="ssff"))
    found = compare(a, b, conditions=["k7"]).table.records()
    assert {(row["condition"], row["against_condition"]) for row in found} == {("k7", "k7")}
    assert (found[0]["n"], found[0]["lost"]) == (4, 2)
    with pytest.raises(InvalidOptionError):
        compare(a, conditions=["k7"])


def test_a_system_that_is_stated_for_no_file_is_an_error(tmp_path: Path) -> None:
    path = made.write_csv(tmp_path / "a.csv", made.rows())
    other = made.write_csv(tmp_path / "b.csv", made.rows())
    with raises(InvalidOptionError) as raised:
        compare(path, None, (None, "mine"), conditions=("k0", "k7"))
    assert raised.value.option == "system_b"
    with raises(InvalidOptionError) as raised:
        compare(path, other, ("mine", None))
    assert raised.value.option == "system_a"
