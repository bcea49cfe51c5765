"""The share of the lesson in an even sample of the history."""

import csv
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robomme_interference_data.draw import even_sample, lesson_share


def test_even_sample_is_numpys_linspace() -> None:
    for history in range(400):
        frames = history + 1
        expected = (
            np.arange(frames) if frames < 32 else np.linspace(0, history, 32).astype(np.int64)
        )
        assert even_sample(history) == expected.tolist()


def test_lesson_share_is_that_of_numpys_linspace() -> None:
    for history in range(300):
        frames = history + 1
        indices = np.arange(frames) if frames < 32 else np.linspace(0, history, 32, dtype=int)
        for lesson in range(history + 1):
            assert lesson_share(lesson, history) == (indices < lesson).mean()


@pytest.mark.parametrize(
    ("lesson", "history", "share"),
    [
        (25, 25, 25 / 26),  # 26 frames, all taken; the last is the live observation
        (30, 30, 30 / 31),
        (31, 31, 31 / 32),
        (66, 66, 31 / 32),  # 67 frames, 32 taken: all but the live observation are lesson
        (1077, 1077, 31 / 32),
        (10, 20, 10 / 21),
        (0, 0, 0.0),  # the live observation alone
        (0, 32, 0.0),
        (66, 98, 21 / 32),  # ⌊j·98/31⌋ < 66 for j ≤ 20: 63.2 → 63, and 66.4 → 66
        (25, 249, 4 / 32),  # ⌊j·249/31⌋ < 25 for j ≤ 3: 24.1 → 24, and 32.1 → 32
        (750, 974, 24 / 32),  # ⌊j·974/31⌋ < 750 for j ≤ 23: 722.6 → 722, and 754.1 → 754
    ],
)
def test_lesson_share_by_hand(lesson: int, history: int, share: float) -> None:
    assert lesson_share(lesson, history) == share


@given(st.integers(0, 3000), st.integers(0, 3000), st.integers(2, 100))
@settings(max_examples=200)
def test_lesson_share_falls_with_history(lesson: int, more: int, samples: int) -> None:
    alone = lesson_share(lesson, lesson, samples)
    diluted = lesson_share(lesson, lesson + more, samples)
    assert 0 <= diluted <= alone <= 1
    # As many as the sample takes, the lesson takes its own part of, give or take one frame.
    frames = lesson + more + 1
    assert abs(diluted - lesson / frames) <= 1 / min(samples, frames) + 1e-9


def test_lesson_share_of_the_released_rollouts(shared_data: Path) -> None:
    """At k0 all released samples are lesson but for the live observation."""
    with (shared_data / "results" / "retrieval_rollouts.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["condition"] == "k0"]
    shares = Counter(float(row["retrieval_selected_lesson_fraction"]) for row in rows)
    # One PatternLock lesson has 25 frames, all others 31 or more.
    assert shares == {lesson_share(25, 25): 1, lesson_share(1077, 1077): 449}
    assert lesson_share(1077, 1077) == 0.96875
