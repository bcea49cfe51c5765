"""Grades and cells against values worked out by hand, wherever the lesson lies."""

from dataclasses import replace

import pytest
from support.retrieval import made

from robomme_interference_data.retrieval.grade import ALL, Grade, cells, grade, verdict
from robomme_interference_data.retrieval.select import Rule
from robomme_interference_data.schema.evidence import map_evidence
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.stats.intervals import wilson

MAX = Rule("max", 0.5)


def test_a_grade_by_hand() -> None:
    # Found: 0 to 3, 4 to 8 (closest, 0.9), 9 and 10 (too short), 11 to 14. The lesson is 0 to 5:
    # two of the five chosen frames, two of its six.
    one = made(cuts={4: 0.1, 9: 0.1, 11: 0.1}, high={1: 0.8, 7: 0.9, 9: 0.95})
    assert grade(one, MAX) == Grade(
        rule="max/0.5",
        threshold=0.5,
        episode_id=one.episode_id,
        condition="k2",
        ability=None,
        history_frames=15,
        segments=4,
        start=4,
        stop=9,
        chosen_frames=5,
        hit=True,
        purity=2 / 5,
        coverage=2 / 6,
        evidence_kept=None,
        false_sessions=1,
        true_cuts=2,  # before 6 and before 11; found are those before 4, 9 and 11
        found_cuts=1,
        false_cuts=2,
    )
    last = grade(one, Rule("last", 0.5))
    assert (last.start, last.stop, last.hit, last.purity, last.coverage) == (11, 15, False, 0, 0)


def test_evidence_counts_where_a_frame_of_it_was_chosen() -> None:
    one = made(cuts={4: 0.1, 9: 0.1, 11: 0.1}, high={7: 0.9})  # chosen are 4 to 8
    spans = (EvidenceSpan(0, "first", 0, 4), EvidenceSpan(1, "then", 3, 5))
    known = replace(one, evidence=map_evidence(one.sessions[:1], lambda entry: spans))
    grades = [grade(known, MAX), grade(one, MAX)]
    assert [found.evidence_kept for found in grades] == [0.5, None]
    [*_, both], [*_, none] = cells(grades), cells(grades[1:])
    assert (both.evidence_kept, none.evidence_kept) == (0.5, None)  # of those of which it is known


@pytest.mark.parametrize(
    ("lessons", "purity", "coverage", "false_sessions"),
    [((0,), 2 / 5, 2 / 6, 1), ((1,), 3 / 5, 3 / 5, 1), ((0, 1), 1, 5 / 11, 0), ((), 0, None, 2)],
    ids=["first", "second", "two parts", "absent"],
)
def test_the_lesson_may_lie_anywhere(
    lessons: tuple[int, ...], purity: float, coverage: float | None, false_sessions: int
) -> None:
    # Chosen are 4 to 8, of the sessions 0 to 5 and 6 to 10; the third is 11 to 14.
    one = made(cuts={4: 0.1, 9: 0.1, 11: 0.1}, high={7: 0.9}, lessons=lessons)
    found = grade(one, MAX)
    assert (found.start, found.stop) == (4, 9)
    assert (found.purity, found.coverage, found.hit) == (purity, coverage, purity > 0)
    assert found.false_sessions == false_sessions
    assert (found.true_cuts, found.found_cuts, found.false_cuts) == (2, 1, 2)


def test_single_frames_are_graded_too() -> None:
    spans = ((0, 20), (20, 52), (52, 84))
    high = {n: 0.9 for n in range(10)} | {n: 0.8 for n in range(60, 82)}
    found = grade(made(cuts={}, high=high, spans=spans), Rule("top"))
    assert (found.start, found.stop, found.chosen_frames) == (0, 82, 32)
    assert (found.purity, found.coverage, found.false_sessions) == (10 / 32, 10 / 20, 1)
    parted = grade(made(cuts={}, high=high, spans=spans, lessons=(0, 2)), Rule("top"))
    assert (parted.purity, parted.coverage, parted.false_sessions) == (1, 32 / 52, 0)


def four() -> list[Grade]:
    good = made("MoveCube/test/0", cuts={6: 0.1}, high={1: 1})
    poor = made("MoveCube/test/1", cuts={4: 0.1, 9: 0.1, 11: 0.1}, high={7: 1})
    lost = made("InsertPeg/test/0", cuts={6: 0.1}, high={12: 1})
    alone = made("MoveCube/test/0", "k0", cuts={}, high={1: 1}, spans=((0, 6),))
    return [grade(one, MAX) for one in (good, poor, lost, alone)]


def test_cells_by_hand() -> None:
    found = list(cells(four()))
    assert [(c.part, c.condition, c.queries) for c in found] == [
        ("MoveCube", "k0", 1),
        ("MoveCube", "k2", 2),
        ("InsertPeg", "k2", 1),
        (ALL, "k0", 1),
        (ALL, "k2", 3),
    ]
    single, both, missed, _, everything = found
    assert (single.purity, single.passed) == (1, True)
    assert single.purity_low is None  # nothing to draw from
    assert both.purity == pytest.approx((1 + 2 / 5) / 2)
    assert both.coverage == pytest.approx((1 + 2 / 6) / 2)
    # Of two queries, draws are both of one, both of the other, or one of each.
    assert both.purity_low == pytest.approx(0.4) and both.purity_high == pytest.approx(1)
    assert (both.hit, both.hit_low, both.hit_high) == (1, *wilson(2, 2))
    assert (missed.hit, missed.purity, missed.false_sessions) == (0, 0, 2)
    assert everything.hit == pytest.approx(2 / 3)
    assert (everything.hit_low, everything.hit_high) == wilson(2, 3)
    assert everything.false_sessions == pytest.approx((0 + 1 + 2) / 3)
    assert not both.passed
    # MoveCube's two queries have two borders each; `good` finds the one before 6, `poor` one and
    # two false ones; the one under k0 has none to find.
    assert (both.true_cuts, both.found_cuts, both.false_cuts) == (4, 2, 2)
    assert (single.true_cuts, single.found_cuts, single.false_cuts) == (0, 0, 0)
    assert verdict(found).endswith("pass: max/0.5: 1 of 3")


def test_abilities_have_cells_beside_families() -> None:
    needs = ("recall", "update", "recall", None)
    graded = [replace(one, ability=need) for one, need in zip(four(), needs, strict=True)]
    found = [(cell.part, cell.condition, cell.queries) for cell in cells(graded)]
    assert found[3:] == [("recall", "k2", 2), ("update", "k2", 1), (ALL, "k0", 1), (ALL, "k2", 3)]
    assert verdict([*cells(graded)]).endswith("pass: max/0.5: 1 of 3")


@pytest.mark.parametrize(("first", "passed"), [(1, True), (2, False)])
def test_the_pass_mark(first: int, passed: bool) -> None:
    # Chosen are `first` to 10; the lesson is 0 to 9. From 1 on, 9 of 10 frames are of the lesson,
    # and 9 of its 10 are chosen; from 2 on, 8 of 9, and 8 of 10.
    one = made(cuts={first: 0.1, 11: 0.1}, high={5: 1}, spans=((0, 10), (10, 20)))
    assert {cell.passed for cell in cells([grade(one, MAX)])} == {passed}
