"""Which frames of a video file belong to which episode, and when that is not certain."""

from itertools import accumulate, pairwise
from math import nan
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.storage.lerobot.location import (
    VideoSpan,
    nearest_frame,
    span_problems,
)

LENGTHS = (30, 40, 37)


def spans(
    starts: list[float], stops: list[float] | None = None, lengths: tuple[int, ...] = LENGTHS
) -> list[VideoSpan]:
    ends = [nan] * len(starts) if stops is None else stops
    rows = zip(lengths, starts, ends, strict=False)
    return [VideoSpan(number, *row) for number, row in enumerate(rows)]


@pytest.mark.parametrize(
    ("position", "frame"),
    [
        (0.0, 0),
        (0.49, 0),
        (0.5, -1),
        (1.5, -1),
        (0.51, 1),
        (29.9999, 30),
        (-0.49, 0),
        (-0.5, -1),
        (nan, -1),
        (2.0**50, -1),
    ],
)
def test_the_nearest_frame_within_half_a_frame(position: float, frame: int) -> None:
    assert nearest_frame(position) == frame


EVERY = [0, 1, 2]


@pytest.mark.parametrize(
    ("given_spans", "first", "count", "wrong"),
    [
        # As LeRobot writes them.
        (spans([0, 30, 70]), 0, 107, []),
        (spans([0, 30.4, 69.6]), 0, 107, []),
        # In another order than that of their numbers.
        (spans([77, 37, 0]), 0, 107, []),
        # An episode before, or between them, is no longer in the table; or the last one, if its
        # end covers the rest.
        (spans([50, 80, 120]), 0, 157, []),
        (spans([0, 50, 90]), 0, 127, []),
        (spans([0, 30, 70], [30, 70, 110]), 0, 110, []),
        (spans([0, 30, 70], [30, 70, 107]), 0, 110, EVERY),
        # The video has a frame more after each episode, and the table knows: its starts count
        # frames of the video.
        (spans([0, 31, 72]), 0, 110, []),
        (spans([0, 31, 72], [31, 72, 110]), 0, 110, []),
        # It does not know: its starts count rows.
        (spans([0, 30, 70]), 0, 110, EVERY),
        (spans([0], None, (30,)), 0, 31, [0]),
        (spans([0, 70], None, (30, 37)), 0, 110, [0, 1]),
        # Frames are missing.
        (spans([0, 30, 70]), 0, 106, EVERY),
        (spans([0, 30, 70]), 0, 0, EVERY),
        # The video begins one frame late, or where the table says so.
        (spans([0, 30, 70]), 1, 107, EVERY),
        (spans([0, 30, 70]), 1, 106, EVERY),
        (spans([1, 31, 71]), 1, 107, []),
        (spans([0, 30, 70]), 15, 107, EVERY),
        # Starts drift: only episodes off by half a frame or more are uncertain.
        (spans([0, 30.4, 70.6]), 0, 107, [2]),
        (spans([0, 31.2, 71.2]), 0, 107, [1, 2]),
        (spans([0, 30, 1070]), 0, 107, [2]),
        (spans([0, 30.5, 70]), 0, 107, [1]),
        # The table does not state a start.
        (spans([0, nan, 70]), 0, 107, [1]),
        (spans([0, nan, 70]), 0, 108, EVERY),
        # Episodes that share frames.
        (spans([0, 29, 69]), 0, 106, EVERY),
        (spans([0, 0, 0]), 0, 40, EVERY),
        (spans([0, 0, 70]), 0, 107, [1]),
    ],
)
def test_what_the_table_explains(
    given_spans: list[VideoSpan], first: int, count: int, wrong: list[int]
) -> None:
    problems = span_problems(given_spans, first, count)
    assert sorted(problems) == wrong
    assert all(f"episode {number}" in problem for number, problem in problems.items())


@given(st.data())
def test_what_is_accepted_is_where_the_recorder_wrote_it(data: st.DataObject) -> None:
    """Each episode is written after the one before it, and the table is wrong by some frames."""
    lengths = data.draw(st.lists(st.integers(7, 12), min_size=1, max_size=5))
    starts = [*accumulate(lengths, initial=0)]
    errors = data.draw(st.lists(st.floats(-3, 3), min_size=len(lengths), max_size=len(lengths)))
    stated = [VideoSpan(n, length, starts[n] + errors[n], nan) for n, length in enumerate(lengths)]
    problems = span_problems(stated, 0, starts[-1])
    for span, true in zip(stated, starts, strict=False):
        assert (span.episode in problems) == (span.first != true)


@given(st.lists(st.tuples(st.integers(1, 9), st.integers(0, 3)), min_size=1, max_size=6), st.data())
def test_accepted_spans_are_inside_and_apart(parts: Any, data: st.DataObject) -> None:
    starts = [*accumulate((length + gap for length, gap in parts), initial=0)]
    first, count = data.draw(st.integers(0, 2)), data.draw(st.integers(0, 60))
    stated = [VideoSpan(n, parts[n][0], starts[n], starts[n + 1]) for n in range(len(parts))]
    if not span_problems(stated, first, count):
        assert stated[0].first >= first
        assert stated[-1].first + stated[-1].length <= first + count
        for before, after in pairwise(stated):
            assert before.first + before.length <= after.first
