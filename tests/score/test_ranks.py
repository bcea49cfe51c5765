"""Systems against each other: the best, all pairs, ranks, and which of them falls more."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import scoring as made
from support.scoring import BASE, OWN, RETRIEVAL, cells, record, records

from robomme_interference_data.evaluate.score.comparisons.tables import corrected
from robomme_interference_data.stats.intervals import mover_interval, newcombe, newcombe_paired
from robomme_interference_data.stats.significance import holm, mcnemar, sign_flip, two_proportions


def scored(tmp_path: Path, outcomes: dict[tuple[str, str], str]) -> made.Score:
    return made.score(made.write_csv(tmp_path / "a.csv", cells(outcomes)), draws=2000)


def first(won: int, of: int = 24) -> str:
    return "s" * won + "f" * (of - won)


def test_equal_rates_lead_by_the_order_of_tables(tmp_path: Path) -> None:
    found = scored(tmp_path, {(OWN, "k0"): "sf", (BASE, "k0"): "fs"})
    assert record(found, "systems")["against_system"] == BASE
    assert {r["rank"] for r in records(found, "ranks")} == {1}
    assert {r["best"] for r in records(found, "main")} == {True}


def test_systems_of_other_histories_are_not_paired(tmp_path: Path) -> None:
    lines = [f"{OWN},MoveCube,k0,{e},{e},easy,{'fail' if e else 'success'},{int(not e)},9"
             for e in range(10)]  # fmt: skip
    unpinned = made.released(tmp_path / "a.csv", lines)
    pinned = made.changed(
        cells({(BASE, "k0"): first(8, 10)}), simulator="robomme", difficulty="easy"
    )
    found = made.score(unpinned, made.write_csv(tmp_path / "b.csv", pinned))
    row = record(found, "systems")
    assert (row["system"], row["interval"], row["pairs"]) == (OWN, "unpaired", None)
    assert row["p"] == two_proportions(1, 10, 8, 10) and row["p_mid"] is None
    assert (row["low"], row["high"]) == pytest.approx(newcombe(1, 10, 8, 10))
    assert "two proportions" in found.tables["systems"].note
    assert [r["best"] for r in records(found, "main")] == [True, False]


def test_ranks_have_the_interval_of_the_draws(tmp_path: Path) -> None:
    # The first is never below the second, whatever is drawn; both always above the third.
    given = {("a", "k0"): "s" * 30, ("b", "k0"): first(27, 30), ("c", "k0"): first(2, 30)}
    found = scored(tmp_path, given)
    ranks = {
        r["system"]: (r["rank"], r["rank_low"], r["rank_high"]) for r in records(found, "ranks")
    }
    # The second ties with the first where none of its three failures is drawn: 0.9³⁰ = 4%.
    assert ranks == {"a": (1, 1, 1), "b": (2, 1, 2), "c": (3, 3, 3)}


def test_which_system_falls_more(tmp_path: Path) -> None:
    given = {
        (BASE, "k0"): first(10, 20),
        (BASE, "k7"): first(2, 20),
        (RETRIEVAL, "k0"): "f" + first(10, 19),
        (RETRIEVAL, "k7"): "f" + first(9, 19),
        (OWN, "k0"): first(12, 20),
        (OWN, "k1"): first(12, 20),
        (OWN, "k7"): first(11, 20),
    }
    found = scored(tmp_path, given)
    against = {(r["system"], r["against_system"]) for r in records(found, "interaction")}
    # The best at k0 is one's own; retrieval is also set against the system without.
    assert against == {(BASE, OWN), (RETRIEVAL, OWN), (RETRIEVAL, BASE)}
    row = record(found, "interaction", system=RETRIEVAL, against_system=BASE)
    assert (row["condition"], row["n"], row["change"], row["against_change"]) == (
        "k7",
        20,
        -0.05,
        -0.4,
    )
    # The base loses 2 to 9, retrieval 10 alone: eight are higher, one is lower.
    assert (row["difference"], row["gained"], row["lost"]) == (0.35, 8, 1)
    assert (
        (row["p"], row["p_mid"])
        == mcnemar(8, 1)
        == sign_flip(np.array([1.0] * 8 + [-1.0] + [0.0] * 11))
    )
    changes = newcombe_paired(9, 0, 1, 10), newcombe_paired(2, 0, 8, 10)
    # Of the changes: mean product 0, means −0.05 and −0.4.
    phi = -0.05 * 0.4 / math.sqrt(0.05 * 0.95 * 0.4 * 0.6)
    expected = mover_interval(-0.05, changes[0], -0.4, changes[1], phi, limit=2)
    assert (row["low"], row["high"]) == pytest.approx(expected)


@given(st.lists(st.tuples(st.floats(0, 1), st.sampled_from("abc")), max_size=9))
def test_groups_are_corrected_apart(tests: list[tuple[float, str]]) -> None:
    found = corrected([p for p, _ in tests], [group for _, group in tests])
    for group in "abc":
        own = [p for p, name in tests if name == group]
        assert [p for p, (_, name) in zip(found, tests, strict=True) if name == group] == holm(own)
