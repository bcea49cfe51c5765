"""Paired comparisons: which rollouts are paired, which interval they bear, what they come to."""

from pathlib import Path

import pytest
from support import scoring as made
from support.scoring import BASE, OWN, RETRIEVAL, cells, record, records

from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.stats.intervals import fieller, newcombe_paired, wilson


def scored(tmp_path: Path, *parts: list[Rollout]) -> Score:
    rows = [row for part in parts for row in part]
    return made.score(made.write_parquet(tmp_path / "a.parquet", rows), draws=2000)


def own(**outcomes: str) -> list[Rollout]:
    """Rows of one's own memory; `none` is no-history."""
    return cells({(OWN, c.replace("none", NO_HISTORY)): text for c, text in outcomes.items()})


def test_retention_has_fiellers_interval(tmp_path: Path) -> None:
    # k0 lifts 30 of 60; k1 keeps all but nine of them, k3 every one, k7 none.
    outcomes = {
        "none": "f" * 60,
        "k0": "s" * 30 + "f" * 30,
        "k1": "f" * 9 + "s" * 21 + "f" * 30,
        "k3": "s" * 30 + "f" * 30,
        "k7": "f" * 60,
    }
    found = scored(tmp_path, own(**outcomes))
    kept = {c: record(found, "effects", effect="history", condition=c) for c in ("k1", "k3", "k7")}
    assert [kept[c]["retention"] for c in kept] == pytest.approx([21 / 30, 1, 0])
    assert {kept[c]["retention_n"] for c in kept} == {60}
    # Of the lifts 0.35 and 0.5: variances 0.2275/59 and 0.25/59, covariance 0.35 · 0.5/59.
    bounds = fieller(0.35, 0.5, (0.2275 / 59, 0.25 / 59), 0.175 / 59)
    assert (kept["k1"]["retention_low"], kept["k1"]["retention_high"]) == pytest.approx(bounds)
    # As k0, or as no-history, in every episode: the interval of no change, over the lift of a half.
    low, high = newcombe_paired(30, 0, 0, 30)
    bounds = (1 + low / 0.5, 1 + high / 0.5)
    assert (kept["k3"]["retention_low"], kept["k3"]["retention_high"]) == pytest.approx(bounds)
    low, high = newcombe_paired(0, 0, 0, 60)
    bounds = (low / 0.5, high / 0.5)
    assert (kept["k7"]["retention_low"], kept["k7"]["retention_high"]) == pytest.approx(bounds)
    # Where no-history lacks ten episodes, retention is of the other fifty.
    found = scored(tmp_path, own(**outcomes | {"none": "-" * 10 + "f" * 50}))
    assert record(found, "effects", effect="history", condition="k1")["retention_n"] == 50


@pytest.mark.parametrize(("gained", "sure"), [(5, False), (6, True)])
def test_retention_is_of_a_lift_that_the_exact_test_is_sure_of(
    tmp_path: Path, gained: int, sure: bool
) -> None:
    # Five gained and none lost: p = 2/32. Six: 2/64.
    k0 = "s" * gained + "f" * (20 - gained)
    found = scored(tmp_path, own(none="f" * 20, k0=k0, k7=k0))
    assert record(found, "effects", effect="history", condition="k7")["retention"] == (
        1.0 if sure else None
    )


def test_pairs_are_of_the_lowest_seed_that_counts_on_both_sides(tmp_path: Path) -> None:
    found = scored(
        tmp_path,
        # Seed 0 broke at k7 in episodes 0 to 2; in episode 3 no seed counts on both sides.
        cells({(OWN, "k0"): "sssss", (OWN, "k7"): "eeeef"}),
        cells({(OWN, "k0"): "fsf-s", (OWN, "k7"): "sfsss"}, seed=1),
    )
    effect = record(found, "effects", condition="k7", effect="sessions")
    # Episodes 0 and 2 are gained and 1 is lost with seed 1; 4 is lost with seed 0.
    assert effect["n"] == 5
    assert (effect["gained"], effect["lost"], effect["flips"]) == (2, 2, 1.0)
    # The test is of the means: 1/2, 1, 1/2, 1 and 1 at k0, then 1, 0, 1, 1 and 1/2. In halves the
    # differences are 1, −2, 1, 0 and −1, their sum −1: odd, so all sums are as far from 0.
    assert (effect["difference"], effect["p"]) == (-0.1, 1.0)
    assert effect["low"] < -0.1 < effect["high"]


def test_interval_and_test_of_repeats_agree(tmp_path: Path) -> None:
    # Of 12 episodes, seed 0 gains 2 and seed 1 gains 8 others: nine differ by a half, one by one.
    found = scored(
        tmp_path,
        cells({(OWN, "k0"): "f" * 12, (OWN, "k7"): "ssffffffffff"}),
        cells({(OWN, "k0"): "f" * 12, (OWN, "k7"): "fsssssssssff"}, seed=1),
    )
    effect = record(found, "effects", condition="k7", effect="sessions")
    assert (effect["gained"], effect["lost"], effect["n"]) == (2, 0, 12)
    assert effect["p"] == 2 / 2**10  # ten differ, all the same way
    assert effect["low"] > 0


def test_noise_is_of_the_two_lowest_seeds_that_count(tmp_path: Path) -> None:
    parts = [cells({(OWN, "k0"): text}, seed) for seed, text in enumerate(("ess-", "sfse", "fssf"))]
    found = scored(tmp_path, *parts, cells({(OWN, "k1"): "ss"}))
    # Episode 0 flips from seed 1 to 2, episode 1 from seed 0 to 1; episode 3 counts once.
    assert found.outcomes["tabletop"].repeat_flips == (3, 2)
    low, high = wilson(2, 3)
    (note,) = found.notes
    assert "2 of 3 repeated rollouts" in note
    assert f"(66.7%, 95% interval {100 * low:.1f} to {100 * high:.1f})" in note


def test_rows_without_a_revision_stand_beside_others_and_are_not_paired(tmp_path: Path) -> None:
    """Released rows name no revision: their buffers may be others than those of one's own runs."""
    rows = made.changed(made.rows(), simulator="robomme")
    base = made.write_csv(tmp_path / "own.csv", [r for r in rows if r.system == BASE])
    pinned = made.write_csv(tmp_path / "b.csv", [r for r in rows if r.system == RETRIEVAL])
    lines = [
        f"{r.system},{r.family},{r.condition},{r.episode},{r.seed},{r.difficulty},{r.status},"
        f"{int(bool(r.success))},9"
        for r in rows
        if r.system == RETRIEVAL
    ]
    unpinned = made.released(tmp_path / "c.csv", lines)
    inside = {(BASE, BASE), (RETRIEVAL, RETRIEVAL)}
    for paths in ([base, unpinned], [unpinned, base]):
        found = made.score(*paths)
        pairs = {(r["system"], r["against_system"]) for r in records(found, "effects")}
        assert pairs == inside
        (note,) = found.notes
        assert "are not paired" in note and f"the rows of {RETRIEVAL} name no revision" in note
    found = made.score(base, pinned)
    pairs = {(r["system"], r["against_system"]) for r in records(found, "effects")}
    assert (pairs, found.notes) == (inside | {(RETRIEVAL, BASE)}, ())
