"""Paired comparisons: which rollouts are paired, which interval they bear, what is left out."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import score_rows as made
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from robomme_interference_data.bootstrap import Interval
from robomme_interference_data.cli import app
from robomme_interference_data.evaluate.rows import NO_HISTORY, Rollout
from robomme_interference_data.evaluate.score.compare import compare
from robomme_interference_data.evaluate.score.grid import Grid
from robomme_interference_data.evaluate.score.paired import interval_of
from robomme_interference_data.evaluate.score.scoring import Score, score
from robomme_interference_data.intervals import newcombe_paired, wilson

COUNTS = st.tuples(*[st.integers(0, 300)] * 4).filter(any)


@pytest.mark.parametrize(
    ("counts", "interval"),
    [
        # p = 2/21 in (0.0265188, 0.2891414), q = 8/21 in (0.2075101, 0.5912135). A = 12 − 7 = 5 is
        # under 21/2, so φ is 0: −6/21 − √(0.0687193² + 0.2102610²), −6/21 + √(0.1939033² +
        # 0.1734423²).
        ((1, 1, 7, 12), (-0.506920, -0.025559)),
        # p = 32/50 in (0.5014102, 0.7586125), q = 22/50 in (0.3116220, 0.5769397). A = 320 − 24 =
        # 296, less 25 is 271; φ = 271/√(32 · 18 · 22 · 28) = 0.4549542.
        # 0.2 − √(0.1385898² − 2φ · 0.1385898 · 0.1369397 + 0.1369397²)
        ((20, 12, 2, 16), (0.056156, 0.329207)),
        # p = 48/50 in (0.8653991, 0.9889611), q = 38/50 in (0.6258732, 0.8570260). A = −24 stays;
        # φ = −24/√(48 · 2 · 38 · 12) = −0.1147079.
        ((36, 12, 2, 0), (0.056930, 0.340428)),
        # All agree, half of them in success: A = 25, less 5 is 20, φ = 20/25. Both rates in
        # (0.2365931, 0.7634069): ±0.2634069 · √(2 − 1.6)
        ((5, 0, 0, 5), (-0.166593, 0.166593)),
        # Both sides certain, without a correlation: low is 1 − √(0.6576198² + 0.6576198²).
        ((0, 2, 0, 0), (0.069985, 1.0)),
        ((0, 0, 0, 0), (-1.0, 1.0)),
    ],
)
def test_newcombes_paired_interval_by_hand(
    counts: tuple[int, int, int, int], interval: tuple[float, float]
) -> None:
    assert newcombe_paired(*counts) == pytest.approx(interval, abs=1e-6)


@given(COUNTS)
def test_newcombes_paired_interval_holds_the_estimate_and_mirrors(
    counts: tuple[int, int, int, int],
) -> None:
    both, first, second, neither = counts
    low, high = newcombe_paired(*counts)
    assert -1 <= low <= (first - second) / sum(counts) <= high <= 1
    assert high - low > 1e-3
    mirrored = newcombe_paired(both, second, first, neither)
    assert mirrored == pytest.approx((-high, -low), abs=1e-9)
    # Failure in the place of success turns the difference round as well.
    assert newcombe_paired(neither, first, second, both) == pytest.approx((low, high), abs=1e-9)


@given(COUNTS, st.booleans())
def test_no_interval_has_width_zero(counts: tuple[int, int, int, int], once: bool) -> None:
    kinds = np.array([[1, 1], [0, 1], [1, 0], [0, 0]], float)
    values = np.repeat(kinds, counts, axis=0)
    differing = counts[1] + counts[2]
    estimate = (counts[1] - counts[2]) / len(values)
    drawn = Interval(estimate, estimate - 0.01, estimate + 0.01)
    found, kind = interval_of(values, once, drawn)
    assert found.value == estimate
    if kind == "bca":
        assert differing >= 10 and found == drawn
    elif kind == "newcombe":
        assert once and (found.low, found.high) == newcombe_paired(*counts)
    else:
        assert not once and math.isnan(found.low) and math.isnan(found.high)
    # A bootstrap whose draws all agree has no interval to give, whatever the episodes.
    flat, kind = interval_of(values, once, Interval(estimate, estimate, estimate))
    assert kind != "bca" and flat.low != flat.high


def rows(condition: str, letters: str, seed: int = 0) -> list[Rollout]:
    """Rows of MoveCube, an episode a letter (see `score_rows`)."""
    return [
        replace(
            made.row(made.OWN, condition, "MoveCube", 0, letter),
            episode=place,
            seed=place,
            model_seed=seed,
            difficulty="easy",
        )
        for place, letter in enumerate(letters)
        if letter != "-"
    ]


def scored(path: Path, *parts: Sequence[Rollout]) -> Score:
    given = [row for part in parts for row in part]
    return score([made.write_parquet(path, given)], grid=Grid.GIVEN, draws=2000)


def record(score: Score, table: str, condition: str) -> dict[str, Any]:
    (found,) = (r for r in score.tables[table].records() if r["condition"] == condition)
    return found


def test_two_episodes_prove_no_lift_and_no_retention(tmp_path: Path) -> None:
    found = scored(
        tmp_path / "a.parquet", rows(NO_HISTORY, "ff"), rows("k0", "ss"), rows("k7", "ss")
    )
    lift = record(found, "lift", "k0")
    assert (lift["p"], lift["interval"]) == (0.5, "newcombe")
    assert (lift["low"], lift["high"]) == newcombe_paired(0, 2, 0, 0)
    assert record(found, "lift", "k7")["retention"] is None
    # None of two differs between k7 and k0: no difference, and no certainty of it.
    effect = record(found, "effects", "k7")
    assert (effect["low"], effect["high"]) == newcombe_paired(2, 0, 0, 0)


def test_the_bootstrap_begins_at_ten_episodes_that_differ(tmp_path: Path) -> None:
    found = scored(
        tmp_path / "a.parquet",
        rows("k0", "f" * 10 + "s" * 30),
        rows("k1", "s" * 9 + "f" + "s" * 30),
        rows("k3", "s" * 10 + "s" * 30),
    )
    nine, ten = (record(found, "effects", condition) for condition in ("k1", "k3"))
    assert (nine["interval"], nine["gained"]) == ("newcombe", 9)
    assert (ten["interval"], ten["gained"]) == ("bca", 10)
    assert 0 < ten["low"] < 0.25 < ten["high"]


def test_retention_has_an_interval_if_all_three_conditions_differ(tmp_path: Path) -> None:
    # k0 lifts 30 of 60; k1 keeps all but nine of them, k3 all but ten, k7 nine alone.
    k0 = "s" * 30 + "f" * 30
    found = scored(
        tmp_path / "a.parquet",
        rows(NO_HISTORY, "f" * 60),
        rows("k0", k0),
        rows("k1", "f" * 9 + "s" * 21 + "f" * 30),
        rows("k3", "f" * 10 + "s" * 20 + "f" * 30),
        rows("k7", "s" * 9 + "f" * 51),
    )
    kept = {condition: record(found, "lift", condition) for condition in ("k1", "k3", "k7")}
    assert [kept[c]["retention"] for c in kept] == pytest.approx([21 / 30, 20 / 30, 9 / 30])
    assert kept["k1"]["retention_low"] is kept["k7"]["retention_high"] is None
    assert 0 < kept["k3"]["retention_low"] < 20 / 30 < kept["k3"]["retention_high"] < 1


def test_retention_is_of_a_lift_that_the_exact_test_is_sure_of(tmp_path: Path) -> None:
    # Five gained and none lost: p = 2/32. Six: 2/64.
    for gained, sure in ((5, False), (6, True)):
        k0 = "s" * gained + "f" * (20 - gained)
        found = scored(
            tmp_path / f"{gained}.parquet",
            rows(NO_HISTORY, "f" * 20),
            rows("k0", k0),
            rows("k7", k0),
        )
        assert record(found, "lift", "k7")["retention"] == (1.0 if sure else None)


def test_pairs_are_of_the_lowest_seed_that_counts_on_both_sides(tmp_path: Path) -> None:
    found = scored(
        tmp_path / "a.parquet",
        # Seed 0 broke at k7 in episodes 0 to 2; in episode 3 no seed counts on both sides.
        rows("k0", "sssss", 0),
        rows("k0", "fsf-s", 1),
        rows("k7", "eeeef", 0),
        rows("k7", "sfsss", 1),
    )
    effect = record(found, "effects", "k7")
    # Episodes 0 and 2 are gained and 1 is lost with seed 1; 4 is lost with seed 0.
    assert (effect["n"], effect["pairs"]) == (5, 4)
    assert (effect["gained"], effect["lost"], effect["flips"], effect["p"]) == (2, 2, 1.0, 1.0)
    assert "In 1 row the test leaves out a part of the n episodes" in found.tables["effects"].note
    assert "leaves out" not in found.tables["lift"].note
    # Repeats, and fewer than ten episodes: no interval is made for that.
    assert effect["low"] is effect["high"] is None


def test_a_cell_is_complete_only_if_every_seed_is(tmp_path: Path) -> None:
    found = scored(
        tmp_path / "a.parquet",
        rows("k0", "ssf", 0),
        rows("k0", "sff", 1),
        rows("k7", "ssf", 0),
        rows("k7", "se-", 1),
    )
    assert [(c.condition, c.n, c.missing, c.complete, c.rank) for c in found.cells] == [
        ("k0", 3, 0, True, 1),
        ("k7", 3, 2, False, None),
    ]
    cell = record(found, "coverage", "k7")
    assert (cell["n"], cell["missing_episodes"], cell["error_episodes"]) == (
        3,
        "test 1-2",
        "test 1",
    )
    assert not record(found, "effects", "k7")["complete"]
    # Where seed 1 broke or is not there, nothing flips: one pair alone is left of three.
    assert (record(found, "noise", "k7")["pairs"], record(found, "noise", "k7")["flips"]) == (1, 0)


def test_repeats_are_the_two_lowest_seeds_that_count(tmp_path: Path) -> None:
    found = scored(
        tmp_path / "a.parquet", rows("k0", "ess", 0), rows("k0", "sfs", 1), rows("k0", "fss", 2)
    )
    noise = record(found, "noise", "k0")
    # Episode 0 flips from seed 1 to 2, episode 1 from seed 0 to 1.
    assert (noise["pairs"], noise["flips"], noise["rate"]) == (3, 2, 2 / 3)


def compared(tmp_path: Path, a: Sequence[Rollout], b: Sequence[Rollout]) -> Any:
    paths = [made.write_csv(tmp_path / f"{n}.csv", r) for n, r in (("a", a), ("b", b))]
    done = CliRunner().invoke(app, ["compare", *map(str, paths), "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    for note in found["notes"]:
        assert note in " ".join(done.stderr.split())
    return found


def test_two_runs_of_one_system_show_the_noise_floor(tmp_path: Path) -> None:
    found = compared(tmp_path, rows("k0", "ssff") + rows("k7", "ssss"), rows("k0", "sfsf"))
    low, high = wilson(2, 4)
    assert found["notes"] == [
        "my-memory ran in both, with the same model seeds, in tabletop. If nothing else differs, "
        f"this share of episodes flips by itself, which is the noise floor: k0 50.0% of 4 (95% "
        f"interval {100 * low:.1f} to {100 * high:.1f}).",
        "Only in a, and left out: of my-memory in tabletop 1 condition (k7).",
    ]
    assert found["rows"][0]["flips"] == 0.5


def test_runs_without_a_seed_in_common_are_paired_by_rank(tmp_path: Path) -> None:
    found = compared(tmp_path, rows("k0", "ssff", 3), rows("k0", "sfff", 7))
    assert "my-memory ran in both, with other model seeds" in found["notes"][0]
    overall = found["rows"][0]
    assert (overall["pairs"], overall["gained"], overall["lost"]) == (4, 0, 1)
    # With seed 7 on both sides, it is that seed: episode 0 is lost, and 1 gained.
    one = rows("k0", "ffff", 3) + rows("k0", "sf--", 7)
    overall = compared(tmp_path, one, rows("k0", "fsss", 7))["rows"][0]
    assert (overall["n"], overall["pairs"], overall["gained"], overall["lost"]) == (4, 2, 1, 1)


def test_compare_says_what_only_one_run_has(tmp_path: Path) -> None:
    base = [replace(r, system=made.BASE) for r in rows("k0", "ss")]
    a = [*rows("k0", "sssss"), *rows("k1", "sssss"), *rows("k3", "ss"), *base]
    b = [*rows("k0", "sse"), *rows("k1", "ss--s"), *rows("k7", "ss")]
    other = [replace(r, simulator="robomme", revision="cd" * 32) for r in b]
    notes = compared(tmp_path, a, [*b, *other])["notes"]
    assert notes[1:] == [
        "Only in a, and left out: 1 system (perceptual-framesamp-modul in tabletop); of my-memory "
        "in tabletop 1 condition (k3) and 3 episodes under k0 and 2 episodes under k1.",
        "Only in b, and left out: 1 system (my-memory in robomme); of my-memory in tabletop 1 "
        "condition (k7).",
    ]


def test_runs_over_other_histories_show_no_noise_floor(tmp_path: Path) -> None:
    changed = [replace(r, revision="cd" * 32) for r in rows("k0", "sf")]
    paths = [
        made.write_csv(tmp_path / f"{n}.csv", r)
        for n, r in (("a", rows("k0", "ss")), ("b", changed))
    ]
    (note,) = compare(*paths).notes
    assert "are of different splits" in note
