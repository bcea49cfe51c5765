"""Evidence: its spans, where they lie in a buffer, and how much of it a sample holds."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buffer_sets import LESSON, QUERIES
from support.made_up import record
from support.messages import raises
from support.retrieval import remade

from robomme_interference_data import EpisodeId, SessionEntry, load_buffer, load_buffer_set
from robomme_interference_data.errors import FormatError
from robomme_interference_data.schema.codec import from_dict, to_dict
from robomme_interference_data.schema.evidence import (
    Evidence,
    evidence_among,
    known_parts,
    map_evidence,
    spans_of_parts,
    spans_of_texts,
)
from robomme_interference_data.schema.manifest import layout_sessions
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.schema.sampling import evidence_kept

ENTRY = SessionEntry(
    "lesson", "MoveCube", EpisodeId("MoveCube", "test", 0), "demonstrations", "r", 0, 0, 20, 1, "s"
)
FIRST, THEN = EvidenceSpan(0, "takes peg 2", 2, 10), EvidenceSpan(1, "from the left", 8, 20)


def placed(
    *entries: SessionEntry, spans: Sequence[EvidenceSpan] = (FIRST, THEN)
) -> tuple[Evidence, ...]:
    known = {"demonstrations": spans}
    found = map_evidence(layout_sessions(entries), lambda entry: known.get(entry.dataset))
    assert found is not None
    return found


def places(evidence: Sequence[Evidence]) -> list[tuple[int, int, int]]:
    return [(one.span.part, one.start, one.stop) for one in evidence]


# --- spans ---------------------------------------------------------------------------------------


def test_spans_of_parts_are_the_frames_that_show_each() -> None:
    shown = [(), (0,), (0, 1), (1,), (), (1,)]
    assert spans_of_parts(shown, ("takes it", "turns it")) == (
        EvidenceSpan(0, "takes it", 1, 3),
        EvidenceSpan(1, "turns it", 2, 4),
        EvidenceSpan(1, "turns it", 5, 6),
    )


def test_a_run_of_equal_texts_is_a_part() -> None:
    texts = ["", "pick up the peg", "pick up the peg ", "static", "hook it", "pick up the peg"]
    assert spans_of_texts(texts) == (
        EvidenceSpan(0, "pick up the peg", 1, 3),
        EvidenceSpan(1, "hook it", 4, 5),
        EvidenceSpan(2, "pick up the peg", 5, 6),
    )
    assert spans_of_texts(["static"] * 3) is None  # says nothing of the answer
    assert spans_of_texts([]) is None


@pytest.mark.parametrize(
    "span",
    [(-1, "a", 0, 1), (1 << 20, "a", 0, 1), (0, "", 0, 1), (0, "a" * 2000, 0, 1), (0, "a", 3, 3)],
)
def test_what_is_no_span(span: tuple[int, str, int, int]) -> None:
    with raises(FormatError):
        EvidenceSpan(*span)


def test_a_record_keeps_its_evidence_inside_the_lesson() -> None:
    known = record("demonstrations", "MoveCube/test/0", evidence=(FIRST, THEN))  # of 20 frames
    assert from_dict(type(known), to_dict(known), "here") == known
    unknown = record("demonstrations", "MoveCube/test/0")
    assert from_dict(type(known), to_dict(unknown), "here").evidence is None
    with raises(FormatError):
        record("demonstrations", "MoveCube/test/0", evidence=(EvidenceSpan(0, "a", 20, 21),))
    with raises(FormatError):
        record("distractors", "MoveCube/train/0", evidence=())


# --- in a buffer ---------------------------------------------------------------------------------


def test_evidence_lies_where_its_frames_do() -> None:
    unit = replace(ENTRY, role="distractor", dataset="distractors", stop=5)
    first, second = replace(ENTRY, stop=9), replace(ENTRY, start=9)
    held = replace(ENTRY, role="filler", start=19, repeat=32)
    assert places(placed(ENTRY)) == [(0, 2, 10), (1, 8, 20)]
    assert places(placed(unit, ENTRY)) == [(0, 7, 15), (1, 13, 25)]
    halves = placed(first, unit, second)  # the second half is frames 14 to 24
    assert places(halves) == [(0, 2, 9), (1, 8, 9), (0, 14, 15), (1, 14, 25)]
    assert [one.session.start for one in halves] == [0, 0, 14, 14]
    assert places(placed(ENTRY, held)) == [(0, 2, 10), (1, 8, 20), (1, 20, 52)]
    assert placed(unit) == ()


@pytest.mark.parametrize("role", ["lesson", "contradiction"])
def test_evidence_of_a_lesson_may_be_unknown(role: str) -> None:
    unknown = replace(ENTRY, role=role, dataset="contradictions")
    known = {"demonstrations": (FIRST,)}
    sessions = layout_sessions([ENTRY, unknown])
    assert map_evidence(sessions, lambda entry: known.get(entry.dataset)) is None


def test_evidence_of_a_buffer(tiny_buffers: Path) -> None:
    """The source `sample`: VideoRepick's gripper turns after 20 steps."""
    opened = load_buffer_set(tiny_buffers)
    [lesson] = opened.manifest(QUERIES[0], "k0").sessions
    whole = load_buffer(QUERIES[0], "k3", buffer_set=tiny_buffers)
    assert whole.evidence is not None
    assert [(one.span.text, one.start, one.stop) for one in whole.evidence] == [
        ("leaves the left edge", 0, 4),
        ("turns at the right edge", 16, 24),
    ]
    parts = replace(lesson, stop=20), replace(lesson, start=20)
    parted = remade(tiny_buffers, (parts[1], parts[0]))
    assert parted.evidence is not None
    turned = LESSON - 20
    assert places(parted.evidence) == [(1, 0, 4), (0, turned, turned + 4), (1, turned + 16, LESSON)]
    nothing = load_buffer(QUERIES[0], "no-history", buffer_set=tiny_buffers)
    assert nothing.evidence == ()


# --- kept ----------------------------------------------------------------------------------------


def test_evidence_kept_by_hand() -> None:
    evidence = placed(ENTRY)
    assert evidence_kept(evidence, [1]) == 0
    assert evidence_kept(evidence, [1, 2]) == 0.5
    assert evidence_kept(evidence, [9]) == 1
    assert evidence_kept((), [9]) is None
    halves = placed(replace(ENTRY, stop=9), replace(ENTRY, start=9))
    assert evidence_kept(halves, [3]) == 0.5  # a span in two halves counts once
    wrong = replace(ENTRY, role="contradiction")
    assert evidence_kept(placed(wrong, ENTRY), range(20)) == 0  # the lesson begins at 20
    assert evidence_kept(placed(wrong), range(20)) is None


def test_evidence_among_some_frames_has_its_places_among_them() -> None:
    evidence = placed(ENTRY)
    assert places(evidence_among(evidence, range(5, 20))) == [(0, 0, 5), (1, 3, 15)]
    assert places(evidence_among(evidence, range(20))) == places(evidence)
    assert places(evidence_among(evidence, [0, 1, 8, 12, 30])) == [(0, 2, 3), (1, 2, 4)]
    assert evidence_among(evidence, [0, 1]) == ()


# --- known ---------------------------------------------------------------------------------------


def test_known_are_the_parts_of_which_a_frame_is_kept() -> None:
    evidence = placed(ENTRY)
    assert known_parts(evidence, [1]) == {}
    assert known_parts(evidence, [7]) == {0: "takes peg 2"}
    assert known_parts(evidence, [9]) == {1: "from the left", 0: "takes peg 2"}


def test_of_two_lessons_the_last_counts_unless_the_goal_asks_for_the_first() -> None:
    other = replace(FIRST, text="takes peg 1")
    sessions = layout_sessions([replace(ENTRY, dataset="other"), ENTRY])
    found = map_evidence(sessions, lambda entry: [other if entry.dataset == "other" else FIRST])
    assert known_parts(found or (), range(60)) == {0: FIRST.text}
    assert known_parts(found or (), range(60), first_counts=True) == {0: "takes peg 1"}


def test_a_part_may_need_several_frames() -> None:
    evidence = placed(replace(ENTRY, stop=9), replace(ENTRY, start=9))  # one span in two halves
    first = [
        frame for one in evidence if one.span.part == 0 for frame in range(one.start, one.stop)
    ]
    for count in range(len(first) + 1):
        assert (0 in known_parts(evidence, first[:count], 3)) == (count >= 3)
    assert known_parts(evidence, first[:-1], len(first)) == {}
    assert known_parts(evidence, first, len(first)) == {0: "takes peg 2"}


def test_of_two_lessons_the_newer_one_counts() -> None:
    wrong = replace(ENTRY, role="contradiction", dataset="contradictions")
    spans = {"demonstrations": (FIRST,), "contradictions": (replace(FIRST, text="peg 1"), THEN)}
    for order, text in (([wrong, ENTRY], "takes peg 2"), ([ENTRY, wrong], "peg 1")):
        found = map_evidence(layout_sessions(order), lambda entry: spans[entry.dataset])
        assert known_parts(found or (), range(40)) == {0: text, 1: "from the left"}


@given(st.sets(st.integers(0, 39)), st.sets(st.integers(0, 39)))
def test_more_frames_tell_more(some: set[int], more: set[int]) -> None:
    evidence = placed(ENTRY, replace(ENTRY, role="filler", start=19, repeat=20))
    fewer, all_known = known_parts(evidence, some), known_parts(evidence, some | more)
    assert fewer.items() <= all_known.items()
    assert (evidence_kept(evidence, some) or 0) <= (evidence_kept(evidence, some | more) or 0)
    assert (evidence_kept(evidence, some) == 1) == (len(fewer) == 2)
