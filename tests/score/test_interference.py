"""Kinds of conditions beyond the paper's: what is compared with what, and what came of it."""

from dataclasses import replace
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st
from support import scoring as made
from support.scoring import BASE, OWN, RETRIEVAL, record

from robomme_interference_data.evaluate.score.plots.data import Data
from robomme_interference_data.evaluate.score.plots.figures import draw_figure
from robomme_interference_data.evaluate.score.report.headline import headline
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.contrast import COMPARISONS, comparable
from robomme_interference_data.schema.conditions import KINDS, NO_HISTORY, in_order, parse_condition
from robomme_interference_data.viz.figure import open_figure

# --- which interference hurts ------------------------------------------------------------------


def test_behind_retrieval_the_floor_is_the_base_without_history(tmp_path: Path) -> None:
    outcomes = {(BASE, NO_HISTORY): "sfff", (RETRIEVAL, "absent-k1"): "ssff"}
    found = record(made.kinds(tmp_path, outcomes), "effects", effect="interference")
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


# --- the ceiling -------------------------------------------------------------------------------


def test_a_ceiling_is_behind_the_same_retrieval_step(tmp_path: Path) -> None:
    own, ceiling = "retrieval-replay-full", "retrieval-recall-full"
    rows = made.cells({(own, "k0"): "sf", (ceiling, "k0"): "ss", ("replay-full", "k0"): "sf"})

    def steps(*names: str | None) -> Score:
        of = dict(zip((own, ceiling), names, strict=True))
        given = [replace(row, retrieval=of.get(row.system)) for row in rows]
        return made.score(made.write_parquet(tmp_path / "a.parquet", given))

    same = record(steps("siglip", "siglip"), "effects", effect="ideal observer")
    assert same["system"] == own
    found = steps("siglip", "thumbnail")
    assert made.records(found, "effects", effect="ideal observer") == []
    (note,) = found.notes
    assert "retrieval steps differ: siglip and thumbnail" in note
    assert record(found, "effects")["against_system"] == "replay-full"  # that one has none


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


def test_kinds_stand_in_panels_of_their_own(kinds: Score) -> None:
    data = Data(kinds, "tabletop")
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


def test_what_hurts_is_shown_at_the_number_that_most_are_asked_at(kinds: Score) -> None:
    found = shown("interference", Data(kinds, "tabletop"))
    assert found is not None
    assert found[0] == ["Replay-FrameSamp"]  # of the ceiling nothing is asked
    assert [label.split("\n")[1] for label in found[1][1]] == [
        *("k3 − k0", "k3 − held-k3", "before-k3 − k3", f"absent-k3 − {NO_HISTORY}"),
        *("stale-k0 − k0", f"misled-k0 − {NO_HISTORY}"),
    ]


def test_the_headline_is_of_the_papers_conditions(kinds: Score) -> None:
    rates, falls, *_ = headline(kinds, "tabletop")
    # From k0 to k3, not to the stale lesson that is compared with k0 too.
    for sentence in (rates, falls):
        assert "k3" in sentence.text and "stale" not in sentence.text
