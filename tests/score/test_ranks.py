"""Systems against each other: the best, all pairs, ranks, and which of them falls more."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import scoring as made
from support.scoring import BASE, OWN, RETRIEVAL, cells, record, records

from robomme_interference_data.evaluate.score.tables.comparison import corrected
from robomme_interference_data.stats.intervals import newcombe, newcombe_paired
from robomme_interference_data.stats.significance import holm, two_proportions


def scored(tmp_path: Path, outcomes: dict[tuple[str, str], str]) -> made.Score:
    return made.score(made.write_csv(tmp_path / "a.csv", cells(outcomes)), draws=2000)


def first(won: int, of: int = 24) -> str:
    return "s" * won + "f" * (of - won)


def test_equal_rates_lead_by_the_order_of_tables(tmp_path: Path) -> None:
    found = scored(tmp_path, {(OWN, "k0"): "sf", (BASE, "k0"): "fs"})
    assert record(found, "main", system=OWN)["best_system"] == BASE
    assert {r["rank"] for r in records(found, "main")} == {1}
    assert {r["best"] for r in records(found, "main")} == {True}


def test_systems_of_other_histories_are_not_paired(tmp_path: Path) -> None:
    lines = [f"{OWN},MoveCube,k0,{e},{e},easy,{'fail' if e else 'success'},{int(not e)},9"
             for e in range(10)]  # fmt: skip
    unpinned = made.released(tmp_path / "a.csv", lines)
    pinned = made.changed(
        cells({(BASE, "k0"): first(8, 10)}), simulator="robomme", difficulty="easy"
    )
    found = made.score(unpinned, made.write_csv(tmp_path / "b.csv", pinned))
    row = record(found, "main", system=OWN)
    assert row["p_holm"] == two_proportions(1, 10, 8, 10)
    ends = (row["difference_low"], row["difference_high"])
    assert ends == pytest.approx(newcombe(1, 10, 8, 10))
    pair = record(found, "matrix")
    assert (pair["gained"], pair["lost"], pair["p"]) == (None, None, row["p_holm"])
    assert "two proportions" in found.tables["matrix"].note
    assert [r["best"] for r in records(found, "main")] == [True, False]


def test_two_systems_without_a_revision_are_not_paired(tmp_path: Path) -> None:
    lines = [
        f"{name},MoveCube,{k},{e},{e},easy,{'success' if e < won else 'fail'},{int(e < won)},9"
        for name, won in (("one", 9), ("two", 2))
        for k in ("k0", "k7")
        for e in range(10)
    ]
    found = made.score(made.released(tmp_path / "a.csv", lines))
    assert {r["gained"] for r in records(found, "matrix")} == {None}
    # The conditions of one system have the same demonstrations, and are paired.
    assert {r["lost"] for r in records(found, "effects")} == {0}


def test_ranks_follow_from_the_significant_pairs(tmp_path: Path) -> None:
    rates = {"one": 12, "two": 11, "three": 6, "four": 2}
    found = scored(tmp_path, {(name, "k0"): first(won) for name, won in rates.items()})
    ranks = {
        r["system"]: (r["rank"], r["rank_low"], r["rank_high"]) for r in records(found, "main")
    }
    # As in test_cells: one and two are better than four, and no other pair differs.
    assert ranks == {"one": (1, 1, 3), "two": (2, 1, 3), "three": (3, 1, 4), "four": (4, 3, 4)}
    # Against the best, p is corrected over all six pairs too, and the intervals for all six.
    row = record(found, "main", system="four")
    assert row["p_holm"] == 6 * 2 / 2**10
    bounds = newcombe_paired(2, 10, 0, 12, 1 - 0.05 / 6)
    assert (row["difference_low"], row["difference_high"]) == pytest.approx(
        (-bounds[1], -bounds[0])
    )


def test_which_system_falls_faster(tmp_path: Path) -> None:
    rates = {
        (BASE, "k0"): 30,
        (BASE, "k7"): 14,
        (RETRIEVAL, "k0"): 30,
        (RETRIEVAL, "k7"): 28,
        (OWN, "k0"): 12,
        (OWN, "k1"): 12,
        (OWN, "k7"): 11,
        ("oracle", "k0"): 30,
        ("oracle", "k7"): 30,
    }
    given = {cell: first(won, 30) for cell, won in rates.items()}
    found = scored(tmp_path, given)
    against = [(r["system"], r["against_system"]) for r in records(found, "interaction")]
    # Each pair once, and no reference.
    assert against == [(BASE, RETRIEVAL), (BASE, OWN), (RETRIEVAL, OWN)]
    row = record(found, "interaction", system=BASE, against_system=RETRIEVAL)
    # From k0 to k7 the sessions double three times: slopes of −16/30/3 and −2/30/3.
    assert (row["conditions"], row["n"], row["slope"]) == ("k0 k7", 30, pytest.approx(-16 / 90))
    assert row["difference"] == pytest.approx(-14 / 90)
    # Fourteen fall with the base alone: 2/2¹⁴, and no draw of 2,000 but the observed one.
    assert (row["gained"], row["lost"]) == (0, 14)
    # Corrected among three slopes and, of three systems, k7 against k0.
    assert row["p"] <= 3 / 2001 and row["primary"]
    falls = [r for r in records(found, "effects", effect="sessions") if r["primary"]]
    assert [(r["system"], r["condition"]) for r in falls] == [
        (name, "k7") for name in (BASE, RETRIEVAL, OWN)
    ]
    tests = [*records(found, "interaction"), *falls]
    ps = sorted(r["p"] for r in tests)
    assert row["p_holm"] == pytest.approx((len(tests) - ps.index(row["p"])) * row["p"])
    assert row["low"] < row["difference"] < row["high"] < 0
    assert row["joint_low"] < row["low"] and row["high"] < row["joint_high"]
    own = record(found, "interaction", system=RETRIEVAL, against_system=OWN)
    assert own["conditions"] == "k0 k7" and own["low"] is None  # three episodes differ


@given(st.lists(st.tuples(st.floats(0, 1), st.sampled_from("abc")), max_size=9))
def test_groups_are_corrected_apart(tests: list[tuple[float, str]]) -> None:
    found = corrected([p for p, _ in tests], [group for _, group in tests])
    for group in "abc":
        own = [p for p, name in tests if name == group]
        assert [p for p, (_, name) in zip(found, tests, strict=True) if name == group] == holm(own)
