"""Kinds of conditions beyond the paper's: what is compared with what, and what came of it."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import scoring as made
from support.scoring import BASE, OWN, RETRIEVAL, record, records

from robomme_interference_data.evaluate.score.comparisons.contrast import COMPARISONS, comparable
from robomme_interference_data.evaluate.score.plots.curves import Data
from robomme_interference_data.evaluate.score.plots.figures import draw_figure, draw_figures
from robomme_interference_data.evaluate.score.report.headline import headline
from robomme_interference_data.evaluate.score.report.page import write_report
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.evidence_kept import ceiling_of
from robomme_interference_data.schema.conditions import KINDS, NO_HISTORY, in_order, parse_condition
from robomme_interference_data.stats.intervals import newcombe_paired, wilson
from robomme_interference_data.stats.significance import mcnemar
from robomme_interference_data.viz.figure import open_figure

GOLDEN = made.ROOT / "tests" / "golden" / "score-kinds"
BEYOND = ("interference", "access", "ceiling")

REPLAY, RECALL = "replay-framesamp", "recall-framesamp"
OUTCOMES = {  # of MoveCube 0 to 5
    (REPLAY, NO_HISTORY): "sfffff",
    (REPLAY, "k0"): "sssssf",
    (REPLAY, "k3"): "ssffff",
    (REPLAY, "before-k3"): "sffffs",
    (REPLAY, "held-k3"): "ssssff",
    (REPLAY, "held-k7"): "ssssff",
    (REPLAY, "absent-k3"): "ffffff",
    (REPLAY, "stale-k0"): "ssffff",
    (REPLAY, "misled-k0"): "ffffff",
    (RECALL, "k0"): "ssssss",
    (RECALL, "k3"): "ssssff",
}
KEPT = {  # thirds of the evidence
    (REPLAY, "k0"): (3, 3, 3, 3, 3, 3),
    (REPLAY, "k3"): (3, 3, 3, 1, 2, 0),
}


def scored(path: Path, outcomes: Mapping[tuple[str, str], str] = OUTCOMES, **more: Any) -> Score:
    rows = [
        replace(row, evidence_kept=KEPT[cell][row.episode] / 3)
        if (cell := (row.system, row.condition)) in KEPT
        else row
        for row in made.cells(outcomes)
    ]
    return made.score(made.write_parquet(path / "a.parquet", made.changed(rows, **more)))


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Score:
    return scored(tmp_path_factory.mktemp("rows"))


# --- which interference hurts ------------------------------------------------------------------


def test_conditions_stand_in_the_order_of_the_registry(small: Score) -> None:
    assert [column.name for column in small.grids[0].columns] == [
        *("system", NO_HISTORY, "k0", "k3", "before-k3", "held-k3", "held-k7", "absent-k3"),
        *("stale-k0", "misled-k0"),
    ]


def test_kinds_are_compared_at_equal_n_where_both_are_there(small: Score) -> None:
    found = [
        (r["system"], r["condition"], r["against_condition"], r["asks"])
        for r in records(small, "interference")
    ]
    # held-k7 has no k7 beside it; the paper's own comparisons are in tables of their own.
    assert found == [
        (REPLAY, "k3", "held-k3", "content beyond dilution"),
        (REPLAY, "before-k3", "k3", "order"),
        (REPLAY, "absent-k3", NO_HISTORY, "false memory"),
        (REPLAY, "stale-k0", "k0", "updating"),
        (REPLAY, "misled-k0", NO_HISTORY, "belief"),
    ]
    assert [r["condition"] for r in records(small, "lift")] == ["k0", "k3"]
    assert [r["condition"] for r in records(small, "effects", system=REPLAY)] == ["k3"]
    assert record(small, "decay", system=REPLAY)["conditions"] == "k0 k3"


def test_interference_by_hand(small: Score) -> None:
    updating = record(small, "interference", condition="stale-k0")
    # Episodes 2, 3 and 4 are lost: p = 2 · 1/2³. Both succeed in 0 and 1, neither in 5.
    assert (updating["n"], updating["rate"], updating["against_rate"]) == (6, 2 / 6, 5 / 6)
    assert updating["difference"] == pytest.approx(-3 / 6)
    assert (updating["gained"], updating["lost"], updating["p"]) == (0, 3, 0.25)
    assert (updating["low"], updating["high"]) == newcombe_paired(2, 0, 3, 1)
    assert updating["p_holm"] == 1.0  # five tests: 5 · 0.25 is above one
    order = record(small, "interference", condition="before-k3")
    assert (order["difference"], order["gained"], order["lost"], order["p"]) == (0.0, 1, 1, 1.0)


def test_holm_is_within_the_table(tmp_path: Path) -> None:
    k0, stale = "s" * 10, "f" * 10
    found = scored(tmp_path, {(OWN, "k0"): k0, (OWN, "stale-k0"): stale, (OWN, "k7"): stale})
    p, _ = mcnemar(0, 10)
    for table in ("interference", "effects"):
        one = record(found, table)
        assert (one["p"], one["p_holm"]) == (p, p)


def test_behind_retrieval_the_floor_is_the_base_without_history(tmp_path: Path) -> None:
    outcomes = {(BASE, NO_HISTORY): "sfff", (RETRIEVAL, "absent-k1"): "ssff"}
    found = record(scored(tmp_path, outcomes), "interference")
    assert (found["against_system"], found["against_condition"]) == (BASE, NO_HISTORY)
    assert (found["gained"], found["lost"]) == (1, 0)


NAMES = [kind.pattern.replace("<n>", n) for kind in KINDS.values() for n in "013" if kind.counted]


@given(st.sets(st.sampled_from([NO_HISTORY, *NAMES])), st.booleans())
def test_whatever_is_compared_differs_in_kind_alone(names: set[str], floor: bool) -> None:
    own = [one.name for one in in_order(names)] if names else []
    found = dict(comparable(OWN, own, (BASE, NO_HISTORY) if floor else None))
    assert [*found] == [name for name in own if name in found]  # in the order of tables
    for name, (system, against) in found.items():
        one, other = parse_condition(name), parse_condition(against)
        assert COMPARISONS[one.kind.name].reference == other.kind.name
        if other.kind.counted:
            assert (system, one.k) == (OWN, other.k) and against in names
    # And whatever could be compared is.
    for name in own:
        one = parse_condition(name)
        question = COMPARISONS.get(one.kind.name)
        partner = question and KINDS[question.reference].pattern.replace("<n>", str(one.k))
        there = partner in names or (floor and partner == NO_HISTORY)
        assert (name in found) == there


def test_every_kind_of_the_registry_is_asked_about() -> None:
    # held is what k is compared with, no-history what absent and misled are.
    assert {*KINDS} - {*COMPARISONS} == {NO_HISTORY, "held"}
    assert {question.reference for question in COMPARISONS.values()} <= {*KINDS}


# --- access against use ------------------------------------------------------------------------


def test_success_where_all_some_or_none_of_the_evidence_was_kept(small: Score) -> None:
    access = [tuple(r.values())[1:] for r in records(small, "access")]
    # Of k3, episodes 0, 1 and 2 kept all, 3 and 4 a part, 5 nothing: "ss f", "ff", "f".
    assert access == [
        (REPLAY, "k0", "all", 6, 5 / 6, *wilson(5, 6)),
        (REPLAY, "k3", "all", 3, 2 / 3, *wilson(2, 3)),
        (REPLAY, "k3", "some", 2, 0.0, *wilson(0, 2)),
        (REPLAY, "k3", "none", 1, 0.0, *wilson(0, 1)),
    ]


def test_errors_do_not_count_and_repeats_count_as_their_mean(tmp_path: Path) -> None:
    rows = made.cells({(OWN, "k0"): "sse"}) + made.cells({(OWN, "k0"): "fs-"}, seed=1)
    path = made.write_csv(tmp_path / "a.csv", made.changed(rows, evidence_kept=1.0))
    access = record(made.score(path), "access")
    assert (access["kept"], access["n"], access["rate"]) == ("all", 2, (0.5 + 1) / 2)


@pytest.mark.parametrize("value", ["1.5", "-0.1", "much", "inf"])
def test_what_is_no_share_is_a_bad_row(tmp_path: Path, value: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(
        "system,family,condition,episode,status,success,evidence_kept\n"
        f"mine,MoveCube,k0,0,success,1,\nmine,MoveCube,k0,1,success,1,{value}\n"
    )
    found = made.score(path, lenient=True)
    assert found.rows.refused == 1
    assert f"line 3: evidence_kept '{value}'; expected a fraction" in found.rows.refusals[0]
    assert "access" not in found.tables  # of the sound row nothing is known


@pytest.mark.parametrize(
    ("system", "ceiling"),
    [
        ("replay-framesamp", "recall-framesamp"),
        ("replay-full", "recall-full"),
        ("retrieval-replay-window", "retrieval-recall-window"),
        ("retrieval-replay-window-joined", "retrieval-recall-window-joined"),
        ("retrieval-recall-window-joined", None),
        ("perceptual-framesamp-context", "recall-framesamp"),
        ("retrieval-framesamp-modul", "retrieval-recall-framesamp"),
        ("perceptual-tokendrop-modul", None),  # it keeps parts of frames
        ("oracle", None),
        ("recall-framesamp", None),
        ("mine", None),
    ],
)
def test_a_ceiling_keeps_the_same_frames(system: str, ceiling: str | None) -> None:
    assert ceiling_of(system) == ceiling


def test_the_gap_to_the_ceiling_is_paired(small: Score) -> None:
    k0, k3 = records(small, "ceiling")
    assert {(r["system"], r["against_system"]) for r in (k0, k3)} == {(REPLAY, RECALL)}
    compared = [(r["condition"], r["against_condition"]) for r in (k0, k3)]
    assert compared == [("k0", "k0"), ("k3", "k3")]
    assert (k0["difference"], k0["lost"], k0["n"]) == (pytest.approx(-1 / 6), 1, 6)
    assert (k3["difference"], k3["lost"], k3["n"]) == (pytest.approx(-2 / 6), 2, 6)


def test_a_ceiling_is_behind_the_same_retrieval_step(tmp_path: Path) -> None:
    own, ceiling = "retrieval-replay-full", "retrieval-recall-full"
    rows = made.cells({(own, "k0"): "sf", (ceiling, "k0"): "ss", ("replay-full", "k0"): "sf"})

    def steps(*names: str | None) -> Score:
        of = dict(zip((own, ceiling), names, strict=True))
        given = [replace(row, retrieval_model=of.get(row.system)) for row in rows]
        return made.score(made.write_parquet(tmp_path / "a.parquet", given))

    assert record(steps("siglip", "siglip"), "ceiling")["system"] == own
    found = steps("siglip", "thumbnail")
    assert "ceiling" not in found.tables
    (note,) = found.notes
    assert "other retrieval steps, siglip and thumbnail" in note
    assert record(found, "effects")["against_system"] == "replay-full"  # that one has none


def test_a_ceiling_changes_nothing_of_the_other_tables(tmp_path: Path, small: Score) -> None:
    without = {cell: text for cell, text in OUTCOMES.items() if cell[0] == REPLAY}
    found = scored(tmp_path, without)
    assert "ceiling" not in found.tables
    for table in ("lift", "effects", "interference", "decay"):
        both = [records(score, table, system=REPLAY) for score in (small, found)]
        for one in (*both[0], *both[1]):
            one.pop("p_holm", None)  # of all tests of the table, the ceiling's own among them
        assert both[0] == both[1]


# --- figures and report ------------------------------------------------------------------------


def shown(kind: str, data: Data) -> tuple[list[str], list[list[str]]] | None:
    """The titles of a figure's panels, and the labels under the last and beside the first."""
    with open_figure() as figure:
        if not draw_figure(kind, figure, data):
            return None
        panels = [axes for axes in figure.axes if axes.axison]
        labels = [panels[-1].get_xticklabels(), panels[0].get_yticklabels()]
        texts = [[text.get_text() for text in axis] for axis in labels]
        return [axes.get_title() for axes in panels], texts


def test_kinds_stand_in_panels_of_their_own(small: Score) -> None:
    data = Data(small, "tabletop")
    found = shown("kinds", data)
    assert found is not None
    kinds = ["k", "before", "held", "absent", "stale", "misled"]
    assert found[0] == [KINDS[name].pattern for name in kinds]
    assert found[1][0] == ["none", "k0", "k3", "k7"]
    # The other figures show the paper's conditions alone; the heatmap all.
    families, heatmap = shown("families", data), shown("heatmap", data)
    assert families is not None and families[0] == ["MoveCube"]
    assert families[1][0] == ["none", "k0", "k3"]
    assert heatmap is not None and heatmap[1][0][:4] == ["none", "k0", "k3", "before-k3"]


def test_places_on_the_axis_are_those_of_a_logarithm(tmp_path: Path) -> None:
    ks = ["k0", "k1", "k3", "k15", "k63"]
    data = Data(scored(tmp_path, {(OWN, c): "sf" for c in (NO_HISTORY, *ks)}), "tabletop")
    first = data.x("k0")
    assert [data.x(c) - first for c in ks] == pytest.approx([0, 1, 2, 4, 6])
    assert first - data.x(NO_HISTORY) == pytest.approx(1.3)  # another kind: with a gap


def test_what_hurts_is_shown_at_the_number_that_most_are_asked_at(small: Score) -> None:
    found = shown("interference", Data(small, "tabletop"))
    assert found is not None
    assert found[0] == ["Replay-FrameSamp"]  # of the ceiling nothing is asked
    assert [label.split("\n")[1] for label in found[1][1]] == [
        *("k3 − k0", "k3 − held-k3", "before-k3 − k3", f"absent-k3 − {NO_HISTORY}"),
        *("stale-k0 − k0", f"misled-k0 − {NO_HISTORY}"),
    ]


def test_rows_of_the_papers_conditions_have_none_of_it(tmp_path: Path) -> None:
    found = made.score(made.write_parquet(tmp_path / "a.parquet", made.rows()))
    assert not {*BEYOND} & {*found.tables}
    data = Data(found, "tabletop")
    assert shown("kinds", data) is None and shown("interference", data) is None


def test_the_headline_begins_with_the_papers_conditions(small: Score, tmp_path: Path) -> None:
    falls, beyond, _ = headline(small, "tabletop").split(". ")
    # From k0 to k3, not to the stale lesson that is compared with k0 too.
    assert "(k3" in falls and "stale" not in falls
    # Of five comparisons the largest loss: 2 of 6 for 5 of 6. p is 0.25, five times that at most 1.
    assert "updating" in beyond and "stale-k0 against k0 \N{MINUS SIGN}50.0 points" in beyond
    assert beyond.endswith("McNemar p = 1, corrected for 5 comparisons)")
    gains = {
        cell: "ssssss" if cell[1] == "stale-k0" else OUTCOMES[REPLAY, "k0"] for cell in OUTCOMES
    }
    assert "beyond the paper" not in headline(scored(tmp_path, gains), "tabletop")


def test_the_report_shows_what_there_is(tmp_path: Path, small: Score) -> None:
    write_report(small, draw_figures(small, tmp_path / "figures"), tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    for name in BEYOND:
        assert f'id="table-{name}"' in text
    for name in ("kinds", "interference"):
        assert f'id="figure-{name}-tabletop"' in text


def test_tables_are_those_of_the_golden_files(small: Score) -> None:
    tables = [small.tables[name] for name in BEYOND]
    written = {f"{table.name}.csv": table.csv() for table in tables}
    written |= {f"{table.name}.md": table.markdown() for table in tables}
    golden = {path.name: path.read_text(encoding="utf-8") for path in GOLDEN.iterdir()}
    assert written == golden
