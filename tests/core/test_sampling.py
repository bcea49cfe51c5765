"""Samples of a history, and how much of them is lesson, wherever the lesson stands."""

import csv
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data import EpisodeId, Session, SessionEntry
from robomme_interference_data.schema.sampling import (
    even_sample,
    lesson_frames,
    lesson_share,
    runs,
    spread,
)

NAME = EpisodeId("MoveCube", "test", 0)
ENTRY = SessionEntry("lesson", "MoveCube", NAME, "demonstrations", "r", 0, 0, 1, 1, "s")


def sessions(*lengths: int) -> list[Session]:
    """Sessions of so many frames; a negative length is one of another role."""
    found, start = [], 0
    for length in lengths:
        role = "lesson" if length > 0 else "distractor"
        found.append(Session(start, start + abs(length), replace(ENTRY, role=role)))
        start += abs(length)
    return found


def share(lesson: int, history: int) -> float:
    """The share of a lesson that comes first."""
    lengths = [length for length in (lesson, lesson - history) if length]
    return lesson_share(sessions(*lengths), range(history))


def test_even_sample_is_numpys_linspace() -> None:
    for history in range(400):
        frames = history + 1
        expected = (
            np.arange(frames) if frames < 32 else np.linspace(0, history, 32).astype(np.int64)
        )
        assert even_sample(history) == expected.tolist()


def test_a_lesson_that_comes_last_in_parts_or_not_at_all() -> None:
    # 98 frames: of the sample's 31 history frames 10 are before frame 32: ⌊j·98/31⌋ ≤ 31 for j ≤ 10
    assert even_sample(98)[10:12] == [31, 34]
    assert lesson_share(sessions(-32, 66), range(98)) == (31 - 11) / 32
    assert lesson_share(sessions(33, -32, 33), range(98)) == (11 + (31 - 21)) / 32
    assert lesson_share(sessions(-98), range(98)) == 0
    assert lesson_share([], ()) == 0


@given(st.lists(st.integers(-60, 60).filter(bool), max_size=6), st.data())
def test_lesson_share_is_what_counting_gives(lengths: list[int], data: st.DataObject) -> None:
    made = sessions(*lengths)
    total = sum(map(abs, lengths))
    frames = sorted(data.draw(st.sets(st.integers(0, total - 1)) if total else st.just(set())))
    lesson = [i for one in made if one.role == "lesson" for i in range(one.start, one.stop)]
    sample = even_sample(len(frames))
    expected = sum(frames[index] in lesson for index in sample[:-1]) / len(sample)
    assert lesson_share(made, frames) == pytest.approx(expected, abs=1e-12)
    assert lesson_frames(made, frames) == sum(i in lesson for i in frames)


@given(st.sets(st.integers(0, 60)))
def test_runs_are_all_frames_and_never_touch(frames: set[int]) -> None:
    found = runs(sorted(frames))
    assert [i for start, stop in found for i in range(start, stop)] == sorted(frames)
    assert all(one[1] < other[0] for one, other in pairwise(found))


@given(st.integers(0, 50), st.integers(1, 400), st.integers(1, 70))
def test_spread(start: int, frames: int, count: int) -> None:
    found = spread(start, start + frames, count)
    assert len(found) == min(count, frames)
    assert found == sorted(set(found))
    assert found[0] == start
    assert count == 1 or found[-1] == start + frames - 1


def test_lesson_share_of_the_released_rollouts(shared_data: Path) -> None:
    """At k0 all released samples are lesson but for the live observation."""
    with (shared_data / "results" / "retrieval_rollouts.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["condition"] == "k0"]
    shares = Counter(float(row["retrieval_selected_lesson_fraction"]) for row in rows)
    # One PatternLock lesson has 25 frames, all others 31 or more.
    assert shares == {share(25, 25): 1, share(1077, 1077): 449}
    assert share(1077, 1077) == 0.96875
