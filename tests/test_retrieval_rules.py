"""Cutting and choosing against values worked out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.retrieval.segment import (
    adaptive_threshold,
    adjacent_cosines,
    cosines,
    segments,
    typical_cosine,
)
from robomme_interference_data.retrieval.select import METHODS, choose

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


@pytest.mark.parametrize("block", [1, 2, 7, 100])
def test_cosines_do_not_depend_on_the_block(block: int) -> None:
    assert adjacent_cosines(HISTORY, block).tolist() == adjacent_cosines(HISTORY).tolist()
    assert cosines(HISTORY, X, block).tolist() == cosines(HISTORY, X).tolist()


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


def test_the_adaptive_threshold() -> None:
    assert adaptive_threshold(0) == 0.5
    # What would give the paper's threshold.
    assert adaptive_threshold(0.846) == pytest.approx(0.923)
    with pytest.raises(InvalidOptionError):
        adaptive_threshold(1.5)


def test_what_unrelated_frames_share() -> None:
    # Frames of one episode are not compared: X with X and Y with Y would give a median of 1.
    assert typical_cosine([np.stack([X] * 9), np.stack([Y] * 9)]) == 0
    # Pairs of episodes: X and MIXED 0.6, X and Y 0, MIXED and Y 0.8. Their median is 0.6, however
    # long an episode is.
    for length in (1, 5, 5000):
        episodes = [X[None], np.stack([Y] * length), MIXED[None]]
        assert typical_cosine(episodes) == pytest.approx(0.6, abs=1e-3)
    # Of 3,000 episodes 1,024 are compared, a frame each: the middle of 1, Y of X Y X.
    assert typical_cosine([X[None], *[np.stack([X, Y, X])] * 2999]) == 1
    assert typical_cosine([HISTORY]) == 0


@pytest.mark.parametrize(
    ("method", "query", "span"),
    [
        ("max", X, (0, 4)),
        ("max", Y, (4, 9)),
        ("max", MIXED, (11, 15)),
        ("max", Z, (0, 4)),  # Z's own segment is too short; the others tie at 0
        ("mean", Y, (4, 9)),
        ("last", X, (11, 15)),
        ("oracle", Y, (0, 4)),
    ],
)
def test_choosing(method: str, query: np.ndarray, span: tuple[int, int]) -> None:
    choice = choose(HISTORY, query, threshold=0.5, method=method, lesson=(0, 4))
    assert choice.span == span
    assert choice.segments == SPANS
    assert choice.frames.tolist() == list(range(*span))
    assert (choice.scores[2] is None) and (method != "max" or choice.scores[1] is not None)


def test_max_and_mean_differ() -> None:
    # Cosines with X: 1, 0.6, 0.6, 0.6 (mean 0.7), then 0.8 four times. All adjacent ones but the
    # one between the parts, 0, are at least 0.6.
    other = np.array([0.8, -0.6, 0], np.float16)
    history = np.stack([X, MIXED, MIXED, MIXED, *[other] * 4])
    by_max, by_mean = (choose(history, X, threshold=0.5, method=m) for m in ("max", "mean"))
    assert by_max.segments == ((0, 4), (4, 8))
    assert (by_max.span, by_mean.span) == ((0, 4), (4, 8))
    assert by_max.scores == pytest.approx([1, 0.8], abs=1e-3)
    assert by_mean.scores == pytest.approx([0.7, 0.8], abs=1e-3)


def test_short_segments_count_if_there_are_no_others() -> None:
    assert choose(np.stack([X, Y, Z]), Y, threshold=0.5).span == (1, 2)


def test_single_frames_are_no_span() -> None:
    choice = choose(np.tile(HISTORY, (4, 1)), Y, threshold=0.5, method="top32")
    # 20 frames of Y, then the first 12 of the 16 MIXED.
    expected = [i for i in range(60) if i % 15 in range(4, 9)]
    expected += [i for i in range(60) if i % 15 >= 11][:12]
    assert choice.frames.tolist() == sorted(expected)
    with pytest.raises(InvalidOptionError, match="single frames"):
        _ = choice.span


@given(st.text(max_size=5), st.sampled_from(sorted(METHODS)))
def test_the_same_input_gives_the_same_choice(lot: str, method: str) -> None:
    options = {"threshold": 0.5, "method": method, "lesson": (0, 4), "lot": lot}
    first, second = (choose(HISTORY, X, **options) for _ in range(2))  # type: ignore[arg-type]
    assert first.frames.tolist() == second.frames.tolist()
    if method == "random":
        assert first.span in (SPANS[0], SPANS[1], SPANS[3])


def test_refusals() -> None:
    with pytest.raises(UnknownNameError, match="'maximum'"):
        choose(HISTORY, X, threshold=0.5, method="maximum")
    with pytest.raises(InvalidOptionError, match="empty"):
        choose(HISTORY[:0], X, threshold=0.5)
    with pytest.raises(InvalidOptionError, match="lesson"):
        choose(HISTORY, X, threshold=0.5, method="oracle")
