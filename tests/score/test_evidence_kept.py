"""Success by the evidence kept: within families, and split into use and execution."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from support import scoring as made
from support.scoring import REPLAY, record, records

from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.score.report.methods import methods
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import name_system
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.stats.intervals import newcombe_paired, wilson


def rows(outcomes: Mapping[str, tuple[str, str]]) -> list[Rollout]:
    """Rows of replay-framesamp at k0: by family, each episode's outcome and thirds kept."""
    return [
        replace(
            made.row(REPLAY, "k0", "MoveCube", episode, letter),
            family=family,
            evidence_kept=int(thirds) / 3,
        )
        for family, (letters, kept) in outcomes.items()
        for episode, (letter, thirds) in enumerate(zip(letters, kept, strict=True))
    ]


def scored(folder: Path, *parts: list[Rollout]) -> Score:
    return made.score(made.write_parquet(folder / "a.parquet", [r for p in parts for r in p]))


def test_levels_are_compared_within_families(tmp_path: Path) -> None:
    # In both families as many succeed of those that kept all as of those that kept nothing; the
    # easier one keeps more. InsertPeg has one level alone and does not contribute.
    outcomes = {
        "MoveCube": ("ssssssfff" + "ssf", "333333333" + "000"),
        "PatternLock": ("sff" + "sssffffff", "333" + "000000000"),
        "InsertPeg": ("sss", "333"),
    }
    found = scored(tmp_path, rows(outcomes))
    rates = {
        r["kept"]: (r["n"], r["rate"]) for r in records(found, "evidence_effects", against_kept="")
    }
    assert rates == {"all": (15, 10 / 15), "none": (12, 5 / 12)}
    effect = record(found, "evidence_effects", kept="all", against_kept="none")
    assert (effect["kept"], effect["against_kept"], effect["families"]) == ("all", "none", 2)
    assert (effect["n"], effect["against_n"]) == (12, 12)
    assert effect["rate"] == effect["against_rate"] == pytest.approx(0.5)
    assert effect["difference"] == 0 and effect["p"] == effect["p_holm"] == 1
    assert effect["low"] < 0 < effect["high"]
    assert "mantel1959" in methods(found)[1]


def test_no_family_with_two_levels_has_no_effect(tmp_path: Path) -> None:
    found = scored(tmp_path, rows({"MoveCube": ("ssf", "333"), "InsertPeg": ("fff", "000")}))
    levels = records(found, "evidence_effects")
    assert [(row["kept"], row["against_kept"], row["p"]) for row in levels] == [
        ("all", "", None),
        ("none", "", None),
    ]


KEPT = {"MoveCube": ("sssssffffe" + "ff", "3333333333" + "12")}


def test_failures_with_all_evidence_are_split_by_the_control(tmp_path: Path) -> None:
    # Nine count with all evidence, four of them fail. The control fails two of these four and one
    # other: 3 of 9 are execution, and use is 4/9 − 3/9.
    control = made.cells({("oracle", "k0"): "fssssffsssss"})
    found = record(scored(tmp_path, rows(KEPT), control), "evidence_use")
    assert (found["control"], found["control_condition"], found["n"]) == ("oracle", "k0", 9)
    assert (found["failures"], found["execution"]) == pytest.approx((4 / 9, 3 / 9))
    low, high = wilson(3, 9)
    assert (found["execution_low"], found["execution_high"]) == pytest.approx((low, high))
    assert found["use"] == pytest.approx(1 / 9)
    bounds = newcombe_paired(4, 2, 1, 2)
    assert (found["use_low"], found["use_high"]) == pytest.approx(bounds)


def test_the_control_is_the_system_itself_if_it_ran_with_the_answer(tmp_path: Path) -> None:
    cells = {("oracle", "k0"): "s" * 12, ("follow-subgoals-oracle", "k0"): "s" * 12}
    told = replace(name_system(REPLAY).facts, subgoals="oracle", reference=True)
    itself = made.changed(made.cells({("told", "k7"): "f" * 12}), **to_dict(told))
    found = scored(tmp_path, rows(KEPT), made.cells(cells), itself)
    one = record(found, "evidence_use")
    assert (one["control"], one["control_condition"]) == ("told", "k7")
    assert (one["execution"], one["use"]) == pytest.approx((1, 4 / 9 - 1))
    found = scored(tmp_path, rows(KEPT), made.cells(cells))
    assert record(found, "evidence_use")["control"] == "follow-subgoals-oracle"


def test_without_a_control_the_table_names_the_command(tmp_path: Path) -> None:
    found = scored(tmp_path, rows(KEPT))
    one = record(found, "evidence_use")
    assert (one["n"], one["failures"]) == (9, pytest.approx(4 / 9))
    assert one["execution"] is one["use"] is None and one["control"] == ""
    assert "--policy oracle" in found.tables["evidence_use"].note


def test_answers_are_not_executed(tmp_path: Path) -> None:
    asked = made.changed(rows({"MoveCube": ("ssf", "333")}), chance=0.5, steps=0)
    found = scored(tmp_path, asked)
    assert "evidence_effects" in found.tables and "evidence_use" not in found.tables
