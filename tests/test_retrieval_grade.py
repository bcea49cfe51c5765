"""Rules, grades, cells and calibration against values worked out by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.constants import PAPER_ENCODER
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.stats import wilson
from robomme_interference_data.retrieval.calibrate import (
    calibrate,
    fit,
    lowest_inside,
    steps,
    true_cuts,
)
from robomme_interference_data.retrieval.encoders import encoder_name, published_threshold
from robomme_interference_data.retrieval.grade import (
    ALL,
    Cell,
    Grade,
    Measured,
    TrueSession,
    cells,
    grade,
)
from robomme_interference_data.retrieval.report import cell_table, shown_table, verdict
from robomme_interference_data.retrieval.segment import Span
from robomme_interference_data.retrieval.select import METHODS, Rule, parse_rules

SESSIONS = ((0, 6), (6, 11), (11, 15))


def made(
    episode: str = "MoveCube/test/0",
    k: int = 2,
    *,
    cuts: dict[int, float],
    high: dict[int, float],
    sessions: tuple[Span, ...] = SESSIONS,
    inside: float = 1.0,
    typical: float = 0.0,
    units: tuple[str, ...] = (),
) -> Measured:
    """A buffer whose adjacent cosines are `inside` but before `cuts`, and 0 with the query.

    The sessions behind the lesson are those `units`, or else its own.
    """
    frames = sessions[-1][1]
    adjacent, alike = np.full(frames - 1, inside, np.float32), np.zeros(frames, np.float32)
    for place, value in cuts.items():
        adjacent[place - 1] = value
    for place, value in high.items():
        alike[place] = value
    names = [episode, *(units or (f"Other/train/{episode} {n}" for n in range(len(sessions) - 1)))]
    true = tuple(
        TrueSession(span, name.partition("/")[0], name)
        for span, name in zip(sessions, names, strict=True)
    )
    return Measured(EpisodeId.parse(episode), k, true, sessions[0], adjacent, alike, typical)


# --- rules -----------------------------------------------------------------------------------


@given(
    st.sampled_from(sorted(METHODS)),
    st.one_of(st.none(), st.just("adaptive"), st.floats(-1, 1)),
)
def test_rules_are_read_as_they_are_written(method: str, cut: float | None) -> None:
    rule = Rule(method, cut)
    assert Rule.parse(str(rule)) == rule


def test_the_cut_is_the_encoders_own_unless_given() -> None:
    assert str(Rule().settled(0.923)) == "max/0.923"
    assert str(Rule().settled(None)) == "max/adaptive"
    assert str(Rule("mean", 0.5).settled(0.923)) == "mean/0.5"
    assert str(Rule("max", 0.9234567)) == "max/0.9234567"  # not the same as max/0.923457
    assert str(Rule("max", -1)) == "max/-1"
    assert Rule("max", 0.923).threshold(0.1) == 0.923
    assert Rule("max", "adaptive").threshold(0.5) == 0.75
    with pytest.raises(InvalidOptionError, match="not settled"):
        Rule().threshold(0.5)


def test_all_rules() -> None:
    own = [f"{method}/0.923" for method in METHODS]
    assert [str(rule) for rule in parse_rules(["all"], 0.923)] == [*own, "max/adaptive"]
    adaptive = [f"{method}/adaptive" for method in METHODS]  # max/adaptive once
    assert [str(rule) for rule in parse_rules(["all", "max"], None)] == adaptive


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [
        ("maximum", UnknownNameError, "'maximum'"),
        ("max/high", InvalidOptionError, "cuts at 'high'"),
        ("max/", InvalidOptionError, "cuts at ''"),
        ("max/1.5", InvalidOptionError, "1.5 is no cosine"),
        ("max/nan", InvalidOptionError, "nan is no cosine"),
    ],
)
def test_rules_that_are_none(text: str, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        Rule.parse(text)


def test_names_of_encoders() -> None:
    assert encoder_name(f"siglip:{PAPER_ENCODER}") == encoder_name("siglip") == "siglip"
    assert published_threshold(f"siglip:{PAPER_ENCODER}") == 0.923
    # At a revision it is the same model, and the revision is kept for loading it.
    assert published_threshold(f"siglip:{PAPER_ENCODER}@main") == 0.923
    assert encoder_name(f"siglip:{PAPER_ENCODER}@main") == f"siglip:{PAPER_ENCODER}@main"
    assert published_threshold("siglip:google/siglip2-base-patch16-224") is None
    assert published_threshold("thumbnail") is None


# --- grades ----------------------------------------------------------------------------------


def test_a_grade_by_hand() -> None:
    # Found: 0 to 3, 4 to 8 (closest, 0.9), 9 and 10 (too short), 11 to 14. The lesson is 0 to 5:
    # two of the five chosen frames, two of its six.
    one = made(cuts={4: 0.1, 9: 0.1, 11: 0.1}, high={1: 0.8, 7: 0.9, 9: 0.95})
    found = grade(one, Rule("max", 0.5))
    assert found == Grade(
        rule="max/0.5",
        threshold=0.5,
        episode_id=one.episode_id,
        k=2,
        history_frames=15,
        segments=4,
        start=4,
        stop=9,
        chosen_frames=5,
        purity=2 / 5,
        coverage=2 / 6,
        false_sessions=1,
        true_cuts=2,  # before 6 and before 11; found are those before 4, 9 and 11
        found_cuts=1,
        false_cuts=2,
    )
    assert found.hit
    last = grade(one, Rule("last", 0.5))
    assert (last.start, last.stop, last.purity, last.coverage) == (11, 15, 0, 0)
    assert (last.hit, last.false_sessions) == (False, 1)
    everything = grade(one, Rule("max", -1))
    assert (everything.purity, everything.coverage) == (6 / 15, 1)
    assert (everything.false_sessions, everything.segments) == (2, 1)
    truth = grade(one, Rule("oracle", 0.5))
    assert (truth.start, truth.stop, truth.purity, truth.coverage) == (0, 6, 1, 1)


def test_single_frames_are_graded_too() -> None:
    sessions = ((0, 20), (20, 52), (52, 84))
    high = {n: 0.9 for n in range(10)} | {n: 0.8 for n in range(60, 82)}
    found = grade(made(cuts={}, high=high, sessions=sessions), Rule("top32", 0.5))
    assert (found.start, found.stop, found.chosen_frames) == (0, 82, 32)
    assert (found.purity, found.coverage, found.false_sessions) == (10 / 32, 10 / 20, 1)


def test_cells_by_hand() -> None:
    good = made("MoveCube/test/0", cuts={6: 0.1}, high={1: 1})
    poor = made("MoveCube/test/1", cuts={4: 0.1, 9: 0.1, 11: 0.1}, high={7: 1})
    lost = made("InsertPeg/test/0", cuts={6: 0.1}, high={12: 1})
    alone = made("MoveCube/test/0", 0, cuts={}, high={1: 1}, sessions=((0, 6),))
    measured = [alone, good, poor, lost]
    found = list(cells([grade(one, Rule("max", 0.5)) for one in measured]))
    assert [(c.family, c.k, c.episodes) for c in found] == [
        ("MoveCube", 0, 1),
        ("MoveCube", 2, 2),
        ("InsertPeg", 2, 1),
        (ALL, 0, 1),
        (ALL, 2, 3),
    ]
    single, both, missed, _, everything = found
    assert (single.purity.value, single.passed) == (1, True)
    assert math.isnan(single.purity.low)  # nothing to draw from
    assert both.purity.value == pytest.approx((1 + 2 / 5) / 2)
    assert both.coverage.value == pytest.approx((1 + 2 / 6) / 2)
    # Of two queries, draws are both of one, both of the other, or one of each.
    assert both.purity.low == pytest.approx(0.4) and both.purity.high == pytest.approx(1)
    assert (both.hit.value, both.hit.low, both.hit.high) == (1, *wilson(2, 2))
    assert (missed.hit.value, missed.purity.value, missed.false_sessions.value) == (0, 0, 2)
    assert everything.hit.value == pytest.approx(2 / 3)
    assert (everything.hit.low, everything.hit.high) == wilson(2, 3)
    assert everything.false_sessions.value == pytest.approx((0 + 1 + 2) / 3)
    assert not both.passed
    # MoveCube's two queries have two borders each; `good` finds the one before 6, `poor` one and
    # two false ones; `alone` has none to find.
    assert (both.true_cuts, both.found_cuts, both.false_cuts) == (4, 2, 2)
    assert (single.true_cuts, single.found_cuts, single.false_cuts) == (0, 0, 0)
    assert verdict(found).endswith("pass: max/0.5: 1 of 3")


def test_the_pass_mark() -> None:
    from robomme_interference_data.stats import Interval

    def cell(purity: float, coverage: float) -> Cell:
        values = [Interval(value, 0, 1) for value in (1, purity, coverage, 0)]
        return Cell("max", "MoveCube", 7, 50, *values, 0, 0, 0)

    assert cell(0.9, 0.9).passed and cell(1, 0.95).passed
    assert not cell(0.89, 1).passed and not cell(1, 0.8999).passed


def test_tables() -> None:
    measured = [made(f"MoveCube/test/{n}", cuts={6: 0.1}, high={n + 4: 1}) for n in range(3)]
    found = list(cells([grade(one, Rule("max", 0.5)) for one in measured]))
    lines = shown_table(found, "Title").text().splitlines()
    # The closest frame is in the lesson twice; the third time it is in the other nine.
    assert lines[0] == "Title"
    assert lines[2].split() == [
        *("family", "k", "queries", "hit", "purity", "coverage", "false", "sessions"),
        *("cuts", "found", "false", "cuts", "pass"),
    ]
    assert lines[4].startswith("MoveCube  k2        3  66.7% (20.8 to 93.9)  66.7% (0.0 to 100.0)")
    # Of three times two borders the one before 6 is found each time.
    assert lines[4].split()[-6:] == ["0.67", "3", "of", "6", "0", "no"]
    assert lines[5].startswith("all       k2        3")
    record = cell_table(found, "Title").records()[0]
    assert record["family"] == "MoveCube" and record["purity"] == pytest.approx(2 / 3)
    assert record["pass"] is False
    assert (record["true_cuts"], record["found_cuts"], record["false_cuts"]) == (6, 3, 0)
    two = [grade(one, rule) for rule in (Rule("max", 0.5), Rule("last", 0.5)) for one in measured]
    lines = shown_table(list(cells(two)), "Title").text().splitlines()
    assert [line.split()[0] for line in lines[4:6]] == ["max/0.5", "last/0.5"]


# --- calibration -----------------------------------------------------------------------------


def three() -> list[Measured]:
    """Cuts of 0, 0.4 and 0.2 (each family's own), lessons with 0.9, 0.7 and 0.8 at lowest.

    Units of one frame: nothing is inside them.
    """
    made_of = (("MoveCube", 0.0, 0.9), ("InsertPeg", 0.4, 0.7), ("RouteStick", 0.2, 0.8))
    return [
        made(f"{family}/test/0", k, cuts={6: cut, 3: low}, high={1: 1}, sessions=((0, 6), (6, 7)))
        for family, cut, low in made_of
        for k in (1, 2)  # nested: each cut returns
    ]


def test_the_released_rule_by_hand() -> None:
    # 99th percentile of 0, 0.2, 0.4: 0.2 + 0.98 · 0.2 = 0.396. 1st of 0.7, 0.8, 0.9: 0.7 + 0.02 ·
    # 0.1 = 0.702. Midway: 0.549.
    assert fit(three()) == pytest.approx((0.549, 0.396, 0.702), abs=1e-6)
    found = calibrate(three(), [0.3, 0.549, 0.95])
    assert found.cuts == pytest.approx((0, 0.2, 0.4)) and len(found.lowest) == 3
    # Without InsertPeg: 0.2 − 0.01 · 0.2 = 0.198 and 0.8 + 0.01 · 0.1 = 0.801.
    held_out = {one.family: one for one in found.held_out}
    assert held_out["InsertPeg"].threshold == pytest.approx((0.198 + 0.801) / 2, abs=1e-6)
    # That misses its cut of 0.4? No: it is below 0.4995.
    assert (held_out["InsertPeg"].purity, held_out["InsertPeg"].coverage) == (1, 1)
    sweep = {(point.threshold, point.k): point for point in found.sweep}
    assert len(sweep) == 6
    # At 0.3 InsertPeg is not cut: 6 of 7 frames are lesson. At 0.95 lessons fall into 3 and 3.
    assert sweep[0.3, 1].purity == pytest.approx((1 + 1 + 6 / 7) / 3)
    assert (sweep[0.549, 2].purity, sweep[0.549, 2].coverage) == (1, 1)
    # All three parts are too short, so all may be chosen: the first half is.
    assert (sweep[0.95, 2].purity, sweep[0.95, 2].coverage) == (1, 0.5)


def test_every_session_counts_and_each_once() -> None:
    # MoveCube's lesson, then units A and B; InsertPeg's lesson, then the same A and B.
    units = ("RouteStick/train/0", "PatternLock/train/0")
    one = made(cuts={3: 0.9, 6: 0.1, 8: 0.5, 11: 0.2, 13: 0.6}, high={}, units=units)
    other = made(
        "InsertPeg/test/0", cuts={3: 0.8, 6: 0.3, 8: 0.5, 11: 0.2, 13: 0.6}, high={}, units=units
    )
    assert lowest_inside([one, other]) == pytest.approx([0.5, 0.6, 0.8, 0.9])
    assert true_cuts([one, other]) == pytest.approx([0.1, 0.2, 0.3])  # A to B once
    # Without RouteStick, A's 0.5 goes, and every cut: A is on one side of each.
    assert lowest_inside([one, other], without="RouteStick") == pytest.approx([0.6, 0.8, 0.9])
    assert true_cuts([one, other], without="RouteStick") == []
    # Without PatternLock, B's 0.6 goes, and the cut from A to B.
    assert true_cuts([one, other], without="PatternLock") == pytest.approx([0.1, 0.3])
    # Without MoveCube: its query goes as a whole. 99th percentile of 0.2, 0.3: 0.299; 1st of 0.5,
    # 0.6, 0.8: 0.502.
    fitted = fit([one, other], without="MoveCube")
    assert fitted == pytest.approx(((0.299 + 0.502) / 2, 0.299, 0.502), abs=1e-6)


def test_nothing_to_fit() -> None:
    alone = made(k=0, cuts={}, high={}, sessions=((0, 6),))
    with pytest.raises(InvalidOptionError, match="1 buffers without any cut between sessions"):
        fit([alone])
    short = made(cuts={}, high={}, sessions=((0, 1), (1, 2)))
    with pytest.raises(InvalidOptionError, match="without any session of two frames"):
        fit([short])
    assert calibrate(three()[:2], [0.5]).held_out == ()  # one family


def test_steps() -> None:
    found = steps(0.80, 0.99)
    assert len(found) == 20
    assert found[:2] == [0.80, 0.81] and found[-1] == 0.99
    assert steps(0.5, 0.5) == [0.5]
    for first, last in ((0.9, 0.8), (-2, 0), (0, 2)):
        with pytest.raises(InvalidOptionError, match="a sweep from"):
            steps(first, last)
