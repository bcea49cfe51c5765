"""Cutting and choosing against values worked out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises
from support.retrieval import embedded, made

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.retrieval.methods import METHODS
from robomme_interference_data.retrieval.segment import (
    adjacent_cosines,
    cosines,
    segments,
    typical_cosine,
)
from robomme_interference_data.retrieval.select import Rule, choose, parse_rules

X, Y, Z = np.eye(3, dtype=np.float16)
MIXED = np.array([0.6, 0.8, 0], np.float16)  # cosine 0.6 with X, 0.8 with Y
# Segments: 4 of X, 5 of Y, 2 of Z (too short), 4 of MIXED.
HISTORY = np.stack([X] * 4 + [Y] * 5 + [Z] * 2 + [MIXED] * 4)
SPANS = ((0, 4), (4, 9), (9, 11), (11, 15))


def test_cosines() -> None:
    expected = [1, 1, 1, 0, 1, 1, 1, 1, 0, 1, 0, *[1] * 3]
    # MIXED has length 1 but for what float16 keeps of 0.6 and 0.8.
    assert adjacent_cosines(HISTORY) == pytest.approx(expected, abs=1e-3)
    assert cosines(HISTORY, X)[[0, 4, 9]].tolist() == [1, 0, 0]
    assert cosines(HISTORY, X)[11] == pytest.approx(0.6, abs=1e-3)
    assert len(adjacent_cosines(HISTORY[:1])) == len(adjacent_cosines(HISTORY[:0])) == 0


def test_a_cut_is_below_the_threshold() -> None:
    adjacent = np.array([0.95, 0.923, 0.9229, 1.0], np.float32)
    assert segments(adjacent, float(np.float32(0.923))) == ((0, 3), (3, 5))
    assert segments(np.empty(0, np.float32), 0.923) == ((0, 1),)


@given(st.lists(st.floats(-1, 1, width=32), max_size=40), st.floats(-1, 1))
def test_segments_are_all_frames_in_order(values: list[float], threshold: float) -> None:
    adjacent = np.array(values, np.float32)
    spans = segments(adjacent, threshold)
    assert [i for start, stop in spans for i in range(start, stop)] == list(range(len(values) + 1))
    assert len(spans) == 1 + int((adjacent < threshold).sum())


def test_what_unrelated_frames_share() -> None:
    def typical(*episodes: np.ndarray) -> float:
        return typical_cosine(len(episodes), lambda number: episodes[number])

    # Frames of one episode are not compared: X with X and Y with Y would give a median of 1.
    assert typical(np.stack([X] * 9), np.stack([Y] * 9)) == 0
    # Pairs of episodes: X and MIXED 0.6, X and Y 0, MIXED and Y 0.8. Their median is 0.6, however
    # long an episode is.
    for length in (1, 5, 5000):
        found = typical(X[None], np.stack([Y] * length), MIXED[None])
        assert found == pytest.approx(0.6, abs=1e-3)
    # Of 3,000 episodes 1,024 are compared, a frame each: the middle of 1, Y of X Y X.
    assert typical(X[None], *[np.stack([X, Y, X])] * 2999) == 1
    assert typical(HISTORY) == 0


@given(
    st.sampled_from(sorted(METHODS)),
    st.one_of(st.just("adaptive"), st.floats(-1, 1)),
    st.integers(1, 1 << 18),  # no history has more frames
)
def test_rules_are_read_as_they_are_written(name: str, threshold: float, frames: int) -> None:
    method = METHODS[name]
    number: float | None = threshold if method.sides else frames if method.frames else None
    rule = Rule(name, number)
    assert Rule.parse(str(rule)) == rule
    assert Rule.parse(str(Rule(name))) == Rule.parse(name) == Rule(name)


def test_the_cut_is_the_encoders_own_unless_given() -> None:
    assert str(Rule.parse("max", 0.923)) == "max/0.923"
    assert str(Rule.parse("max")) == "max/adaptive"
    assert str(Rule.parse("mean/0.5", 0.923)) == "mean/0.5"
    assert str(Rule.parse("max/0.9234567")) == "max/0.9234567"  # not the same as max/0.923457
    # 0.846 is what would give the paper's threshold.
    assert Rule("max", 0.923).cosine(0.1) == 0.923
    assert Rule("max", "adaptive").cosine(0.0) == 0.5
    assert Rule("max", "adaptive").cosine(0.846) == pytest.approx(0.923)


def test_all_rules() -> None:
    own = ("max", "latest", "joined", "mean", "last", "random")
    others = {"changes/adaptive", "window/128", "windows3/128", "top/32", "oracle"}
    published = [str(rule) for rule in parse_rules(["all"], 0.923)]
    assert published[-1] == "max/adaptive"
    assert {*published[:-1]} == {f"{name}/0.923" for name in own} | others
    adaptive = [str(rule) for rule in parse_rules(["all", "max"], None)]  # max/adaptive once
    assert len(adaptive) == len(METHODS)
    assert {*adaptive} == {f"{name}/adaptive" for name in own} | others


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("maximum", UnknownNameError),
        ("max/high", InvalidOptionError),
        ("max/1.5", InvalidOptionError),
        ("window/adaptive", InvalidOptionError),
        ("window/0", InvalidOptionError),
        ("windows3/2.5", InvalidOptionError),
        ("oracle/0.5", InvalidOptionError),
    ],
)
def test_rules_that_are_none(text: str, error: type[Exception]) -> None:
    with raises(error):
        Rule.parse(text)


@pytest.mark.parametrize(
    ("method", "query", "span"),
    [
        ("max", X, (0, 4)),
        ("max", Y, (4, 9)),
        ("max", MIXED, (11, 15)),
        ("max", Z, (0, 4)),  # Z's own segment is too short; the others tie at 0
        ("mean", Y, (4, 9)),
        ("last", X, (11, 15)),
    ],
)
def test_choosing(method: str, query: np.ndarray, span: tuple[int, int]) -> None:
    choice = choose(embedded(HISTORY, query, lesson=(0, 4)), Rule(method, 0.5))
    assert choice.spans == (span,)
    assert choice.segments == SPANS
    assert choice.frames.tolist() == list(range(*span))
    assert SPANS[2] not in choice.scores and (method != "max" or SPANS[1] in choice.scores)


def test_max_and_mean_differ() -> None:
    # Cosines with X: 1, 0.6, 0.6, 0.6 (mean 0.7), then 0.8 four times. All adjacent ones but the
    # one between the parts, 0, are at least 0.6.
    other = np.array([0.8, -0.6, 0], np.float16)
    measured = embedded(np.stack([X, MIXED, MIXED, MIXED, *[other] * 4]), X)
    by_max, by_mean = (choose(measured, Rule(method, 0.5)) for method in ("max", "mean"))
    assert by_max.segments == ((0, 4), (4, 8))
    assert (by_max.spans, by_mean.spans) == (((0, 4),), ((4, 8),))
    assert by_max.scores == pytest.approx({(0, 4): 1, (4, 8): 0.8}, abs=1e-3)
    assert by_mean.scores == pytest.approx({(0, 4): 0.7, (4, 8): 0.8}, abs=1e-3)


def test_of_equally_close_segments_latest_takes_the_last() -> None:
    twice = np.concatenate([HISTORY, HISTORY])
    assert choose(embedded(twice, Y), Rule("max", 0.5)).spans == ((4, 9),)
    assert choose(embedded(twice, Y), Rule("latest", 0.5)).spans == ((19, 24),)


def test_joined_takes_every_part_of_the_session() -> None:
    # Adjacent cosines of the first segment: 1, 1, 0.8; the lowest decile of three is the lowest.
    first = np.stack([X, X, X, MIXED * [4 / 3, 3 / 4, 1]])  # the last is (0.8, 0.6, 0)
    other = np.stack([MIXED * [1, -1, 1]] * 4)  # (0.6, −0.8, 0): cosines 0.6 and 0 with the first
    second = np.stack([Y, MIXED, MIXED, MIXED])  # (0.6, 0.8, 0) and (0.8, 0.6, 0) have 0.96
    history = np.concatenate([first, other, second, np.stack([Z] * 4)]).astype(np.float16)
    choice = choose(embedded(history, X), Rule("joined", 0.5))
    assert choice.segments == ((0, 4), (4, 8), (8, 12), (12, 16))
    assert choice.spans == ((0, 4), (8, 12))
    assert choice.scores[0, 4] == 1
    # Frames that follow are equal here, and (0.8, 0.6, 0) is no part of what is seen.
    alone = choose(embedded(history, Z), Rule("joined", 0.5))
    assert alone.spans == ((12, 16),)
    single = choose(embedded(np.stack([X, Y, Z]), Y), Rule("joined", 0.5))
    assert single.spans == ((1, 2),)


def test_single_frames() -> None:
    choice = choose(embedded(np.tile(HISTORY, (4, 1)), Y), Rule("top"))
    # 20 frames of Y, then the first 12 of the 16 MIXED.
    expected = [i for i in range(60) if i % 15 in range(4, 9)]
    expected += [i for i in range(60) if i % 15 >= 11][:12]
    assert choice.frames.tolist() == sorted(expected)
    assert choice.spans[:2] == ((4, 9), (11, 15))


@pytest.mark.parametrize(
    ("lessons", "span"),
    [((1,), (6, 11)), ((0, 2), (0, 6)), ((2,), (11, 15))],
    ids=["second", "in parts", "last"],
)
def test_the_oracle_takes_the_first_part_wherever_it_lies(
    lessons: tuple[int, ...], span: tuple[int, int]
) -> None:
    measured = made(cuts={4: 0.1}, high={1: 1}, lessons=lessons)
    choice = choose(measured, Rule("oracle"))
    assert choice.spans == (span,)
    assert (choice.segments, choice.threshold) == ((), None)  # it does not cut


def test_lots_are_those_of_the_rule() -> None:
    # SHA-256 of "robomme-interference random\nMoveCube/test/<n> k2", modulo three segments.
    found = [
        choose(made(f"MoveCube/test/{n}", cuts={6: 0, 11: 0}, high={}), Rule("random", 0.5))
        for n in range(6)
    ]
    assert [one.segments.index(*one.spans) for one in found] == [0, 2, 2, 0, 0, 2]


def test_refusals() -> None:
    with raises(InvalidOptionError):
        choose(embedded(HISTORY[:0], X), Rule())
    absent = made(cuts={}, high={1: 1}, lessons=())
    with raises(InvalidOptionError):
        choose(absent, Rule("oracle"))
    assert choose(absent, Rule("max")).spans == ((0, 15),)
