"""compare as a command: pairs of two runs, and runs that cannot be paired."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import score_rows as made
from score_rows import run

from robomme_interference_data.intervals import newcombe_paired


def test_compare_on_the_command_line(tmp_path: Path) -> None:
    rows = made.rows()
    a = made.write_csv(tmp_path / "a.csv", [r for r in rows if r.system == made.BASE])
    b = made.write_csv(tmp_path / "b.csv", [r for r in rows if r.system == made.RETRIEVAL])
    done = run("compare", a, b, "--json")
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found["notes"] == [
        "Only in a, and left out: of perceptual-framesamp-modul in tabletop 3 conditions "
        "(no-history, k1, k3)."
    ]
    overall = {row["condition"]: row for row in found["rows"] if row["family"] == "all"}
    assert overall.keys() == {"k0", "k7"}
    assert (overall["k0"]["gained"], overall["k0"]["lost"], overall["k0"]["p"]) == (1, 1, 1.0)
    k7 = overall["k7"]
    assert (k7["n"], k7["rate_a"], k7["rate_b"]) == (12, 2 / 12, 7 / 12)
    assert (k7["gained"], k7["lost"], k7["p"]) == (5, 0, 2 / 32)
    assert k7["difference"] == pytest.approx(5 / 12)
    assert (k7["interval"], k7["pairs"], k7["flips"]) == ("newcombe", 12, 5 / 12)
    assert (k7["low"], k7["high"]) == newcombe_paired(2, 5, 0, 5)
    assert len(found["rows"]) == 6  # both conditions in all, and in the two families
    assert k7["p_holm"] == pytest.approx(6 * 2 / 32)
    assert run("compare", a, b).stdout.startswith("# Two runs compared\n\n| simulator |")


def test_compare_pairs_repeats_of_one_system_and_says_if_revisions_differ(tmp_path: Path) -> None:
    rows = [r for r in made.rows() if r.system == made.BASE]
    changed = [replace(r, revision="cd" * 32, model_seed=9) for r in rows]
    a, b = made.write_csv(tmp_path / "a.csv", rows), made.write_csv(tmp_path / "b.csv", changed)
    found = json.loads(run("compare", a, b, "--json").stdout)
    assert {row["difference"] for row in found["rows"]} == {0.0}
    assert len(found["notes"]) == 1 and "are of different splits" in found["notes"][0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"simulator": "robomme"}, "the rows are of different simulators: tabletop and robomme"),
        ({"seed": 77}, "MoveCube/test/0 has the seed 0 in one run and 77 in the other"),
        ({"episode_split": "val"}, "no episode under a common condition"),
        ({"condition": "k9"}, "no episode under a common condition"),
    ],
)
def test_what_cannot_be_paired_is_not_compared(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    rows = [r for r in made.rows() if r.system == made.BASE and r.condition == "k0"]
    a = made.write_csv(tmp_path / "a.csv", rows)
    b = made.write_csv(tmp_path / "b.csv", [replace(r, **change) for r in rows])
    assert message in str(run("compare", a, b).exception)


def test_systems_that_do_not_meet_are_not_compared(tmp_path: Path) -> None:
    rows = made.rows()
    a = made.write_csv(tmp_path / "a.csv", [r for r in rows if r.system != made.OWN])
    b = made.write_csv(tmp_path / "b.csv", [r for r in rows if r.system == made.OWN])
    assert "no system is in both" in str(run("compare", a, b).exception)
