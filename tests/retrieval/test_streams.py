"""Rules that need no cuts, on streams without any: values by hand, and properties."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.retrieval import embedded, made, sessions_of

from robomme_interference_data.retrieval.grade import grade
from robomme_interference_data.retrieval.methods import METHODS, best_window, best_windows
from robomme_interference_data.retrieval.segment import adjacent_cosines, segments, side_cosines
from robomme_interference_data.retrieval.select import Rule, choose

X, Y, Z = np.eye(3, dtype=np.float32)
SESSIONS = (60, 80, 60)
FADE = 20


def stream(*colors: np.ndarray, frames: Sequence[int] = SESSIONS, fade: int = FADE) -> np.ndarray:
    """Sessions that fade into each other: no two adjacent frames differ much."""
    parts = []
    for number, (color, length) in enumerate(zip(colors, frames, strict=True)):
        parts.append(np.repeat(color[None], length, axis=0))
        if number + 1 < len(colors):
            share = (np.arange(1, fade + 1) / (fade + 1))[:, None]
            parts.append((1 - share) * color + share * colors[number + 1])
    rows = np.concatenate(parts)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


# --- windows -----------------------------------------------------------------------------------


def test_the_window_around_the_closest_frame_by_hand() -> None:
    #                 0    1    2    3    4    5    6    7
    alike = np.array([0.0, 0.6, 0.5, 0.9, 0.1, 0.0, 0.8, 0.8], np.float32)
    # Those of 3 frames with frame 3: 1 to 3 has mean 2/3, 2 to 4 has 0.5, 3 to 5 has 1/3. The one
    # with the highest mean of all, 5 to 7, does not hold it.
    assert best_window(alike, 3, (0, 8)) == (1, 4)
    assert best_window(alike, 1, (0, 8)) == (3, 4)
    assert best_window(alike, 3, (4, 8)) == (5, 8)  # frame 6, and 4 to 6 has 0.3
    assert best_window(alike, 8, (0, 8)) == best_window(alike, 99, (0, 8)) == (0, 8)
    # All equal: the earliest frame, and the earliest window.
    assert best_window(np.ones(9, np.float32), 4, (0, 9)) == (0, 4)


def test_several_windows_by_hand() -> None:
    alike = np.array([0.0, 0.6, 0.5, 0.9, 0.1, 0.0, 0.8, 0.7, 0.2], np.float32)
    # 2 to 3 (mean 0.7), then 6 and 7 (0.75) among 4 to 8, then 0 and 1.
    assert best_windows(alike, 2, 1) == [(2, 4)]
    assert best_windows(alike, 2, 2) == [(2, 4), (6, 8)]
    assert best_windows(alike, 2, 3) == [(0, 2), (2, 4), (6, 8)]
    # Frames 4 and 5 are left, then 8 alone, then nothing.
    assert best_windows(alike, 2, 9) == [(0, 2), (2, 4), (4, 6), (6, 8), (8, 9)]
    measured = made(cuts={}, high={3: 0.9, 12: 0.8})
    choice = choose(measured, Rule("windows3", 2))
    # After 2 to 3 and 11 to 12 all frames that are left are equally far: the first two.
    assert choice.spans == ((0, 4), (11, 13))  # adjoining windows are one span
    assert (choice.segments, choice.threshold, dict(choice.scores)) == ((), None, {})


SOME_ALIKE = st.lists(st.integers(-10, 10), min_size=1, max_size=40).map(
    lambda values: np.array(values, np.float32) / 10
)


@given(SOME_ALIKE, st.integers(1, 50), st.integers(1, 5))
def test_windows_are_disjoint_and_inside(alike: np.ndarray, frames: int, count: int) -> None:
    windows = best_windows(alike, frames, count)
    taken = [frame for span in windows for frame in range(*span)]
    assert taken == sorted(set(taken)) and set(taken) <= set(range(len(alike)))
    assert int(np.argmax(alike)) in taken
    assert all(stop - start <= frames for start, stop in windows)
    more = best_windows(alike, frames, count + 1)
    assert set(windows) <= set(more)


@given(SOME_ALIKE, st.integers(1, 50))
def test_no_window_around_the_closest_frame_is_better(alike: np.ndarray, frames: int) -> None:
    start, stop = best_window(alike, frames, (0, len(alike)))
    assert stop - start == min(frames, len(alike))
    closest = int(np.argmax(alike))
    others = [
        alike[first : first + stop - start].mean()
        for first in range(len(alike) - (stop - start) + 1)
        if first <= closest < first + stop - start
    ]
    assert alike[start:stop].mean() == pytest.approx(max(others), abs=1e-5)


# --- changes -----------------------------------------------------------------------------------


def test_both_sides_of_a_border_by_hand() -> None:
    rows = np.stack([X, X, Y, Y, Y])
    assert side_cosines(rows, 1).tolist() == adjacent_cosines(rows).tolist() == [1, 0, 1, 1]
    # Means of two: X against Y, 0; (X + Y) / 2 against Y, 1 / √2. At the ends a side is too short.
    assert side_cosines(rows, 2) == pytest.approx([1, 0, 0.5**0.5, 1], abs=1e-6)
    assert side_cosines(rows, 3).tolist() == [1] * 4
    assert side_cosines(np.stack([X, -X, Y, Y]), 2)[1] == 0  # a mean is zero
    assert side_cosines(rows[:1], 1).tolist() == side_cosines(rows[:0], 1).tolist() == []


def test_only_the_lowest_of_near_borders_is_cut() -> None:
    borders = np.array([0.9, 0.4, 0.2, 0.3, 0.2, 0.9, 0.1], np.float32)
    assert segments(borders, 0.5, 1) == ((0, 2), (2, 3), (3, 4), (4, 5), (5, 7), (7, 8))
    # Of the two 0.2 the first; 0.1 is too far from it.
    assert segments(borders, 0.5, 3) == ((0, 3), (3, 7), (7, 8))
    assert segments(borders, 0.15, 3) == ((0, 7), (7, 8))


@given(st.lists(st.floats(-1, 1, width=32), max_size=60), st.floats(-1, 1), st.integers(1, 20))
def test_cuts_keep_their_distance(values: list[float], threshold: float, width: int) -> None:
    borders = np.array(values, np.float32)
    spans = segments(borders, threshold, width)
    assert [i for start, stop in spans for i in range(start, stop)] == list(range(len(values) + 1))
    starts = [start for start, _ in spans[1:]]
    assert set(starts) <= {start for start, _ in segments(borders, threshold)}
    assert all(b - a >= width for a, b in pairwise(starts))


def test_a_stream_without_drops() -> None:
    history = stream(X, Y, Z)
    assert adjacent_cosines(history).min() > 0.99
    measured = embedded(history, Y)
    assert choose(measured, Rule("max")).spans == ((0, 240),)  # one segment: everything
    # The means of 32 frames differ most in the middle of each fade, frames 60 to 79 and 160 to 179.
    changes = choose(measured, Rule("changes"))
    assert changes.segments == ((0, 70), (70, 170), (170, 240))
    assert changes.spans == ((70, 170),)
    assert choose(measured, Rule("window", 40)).spans == ((80, 120),)


def test_a_long_stream_is_cut_at_each_fade() -> None:
    rng = np.random.default_rng(0)
    sessions = 40
    colors = np.eye(8, dtype=np.float32)[np.arange(sessions) % 8]
    history = stream(*colors, frames=[480] * sessions)
    history += rng.normal(scale=0.02, size=history.shape)
    history /= np.linalg.norm(history, axis=1, keepdims=True)
    assert len(history) == 480 * sessions + FADE * (sessions - 1)  # 19,980 frames
    choice = choose(embedded(history, history[5000]), Rule("changes"))
    middles = [480 * n + FADE * (n - 1) + FADE // 2 for n in range(1, sessions)]
    found = [start for start, _ in choice.segments[1:]]
    assert len(found) == len(middles)
    assert np.abs(np.array(found) - middles).max() <= 2


# --- all methods -------------------------------------------------------------------------------


@settings(max_examples=25)
@given(st.data(), st.sampled_from(sorted(METHODS)), st.integers(1, 40))
def test_what_any_method_chooses(data: st.DataObject, name: str, length: int) -> None:
    rows = np.array(
        data.draw(st.lists(st.integers(0, 2), min_size=length, max_size=length)), dtype=int
    )
    history = np.eye(3, dtype=np.float32)[rows]
    measured = embedded(history, X, lesson=(0, (length + 1) // 2))
    choice = choose(measured, Rule(name))
    taken = choice.frames.tolist()
    assert taken == sorted(set(taken)) and set(taken) <= set(range(length)) and taken
    # Sorted and disjoint, with a gap between two.
    assert all(a[1] < b[0] for a, b in pairwise(choice.spans))
    if name != "oracle":
        # The true borders are only for grading: any others give the same choice.
        moved = sessions_of(["MoveCube/test/0"], [(0, length)], [])
        assert choose(replace(measured, sessions=moved), Rule(name)).spans == choice.spans
    graded = grade(measured, choice.rule)
    assert graded.chosen_frames == len(taken)
    assert (graded.threshold is None) == (METHODS[name].sides is None) == (graded.segments == 0)


@pytest.mark.parametrize("name", sorted({*METHODS} - {"last", "random", "oracle"}))
def test_the_order_of_distractors_does_not_matter(name: str) -> None:
    # Sessions of 40 frames, of which the second is what the first live observation shows.
    colors = np.eye(6, dtype=np.float32)
    # The window is as long as a session; three of 13 frames are in it, too.
    rule = Rule(name, {"window": 40, "windows3": 13, "top": 40}.get(name))
    for order in ((1, 0, 2, 3, 4, 5), (5, 0, 3, 1, 4, 2)):
        measured = embedded(np.repeat(colors[[*order]], 40, axis=0), colors[0])
        [(start, stop)] = choose(measured, rule).spans
        assert (start, stop) == (40, 79 if name == "windows3" else 80)
