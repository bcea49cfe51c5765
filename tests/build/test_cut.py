"""Which frames of an episode a dataset stores."""

from collections.abc import Generator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.build_dataset.cut import CUTS, NothingToStore
from robomme_interference_data.build_dataset.sources import Frame
from robomme_interference_data.errors import SourceError

DEMONSTRATIONS, DISTRACTORS = "demonstrations", "distractors"


def marks(lesson: int | None, length: int) -> Generator[Frame]:
    """Yield frames that only say their number, as state, and whether they are the lesson."""
    for step in range(length):
        shown = None if lesson is None else step < lesson
        yield Frame({}, np.array([step], np.float32), None, shown)


def steps(frames: Any) -> list[int]:
    return [int(frame.state[0]) for frame in frames]


def test_units_and_demonstrations() -> None:
    # fmt: off
    assert steps(CUTS[DISTRACTORS](marks(None, 249))) == [
        0, 8, 16, 24, 32, 40, 48, 56, 64, 72, 80, 88, 96, 104, 112, 120,
        128, 136, 144, 152, 160, 168, 176, 184, 192, 200, 208, 216, 224, 232, 240, 248,
    ]
    # fmt: on
    assert steps(CUTS[DEMONSTRATIONS](marks(3, 100))) == [0, 1, 2, 3]  # 3: the query frame


@given(lesson=st.none() | st.integers(0, 400), length=st.integers(0, 400))
def test_nothing_is_read_beyond_the_last_frame_that_is_needed(
    lesson: int | None, length: int
) -> None:
    for kind, needed in ((DISTRACTORS, 249), (DEMONSTRATIONS, (lesson or 0) + 1)):
        read = marks(lesson, length)
        try:
            found = steps(CUTS[kind](read))
        except (NothingToStore, SourceError):
            assert length < needed or not lesson
            continue
        assert found == list(range(0, needed, 8 if kind == DISTRACTORS else 1))
        assert steps(read) == list(range(needed, length))  # what is left


@pytest.mark.parametrize(
    ("kind", "lesson", "length", "reason"),
    [
        (DISTRACTORS, None, 248, "248 raw frames; a unit needs 249"),
        (DEMONSTRATIONS, 0, 100, "no demonstration frame"),
        (DEMONSTRATIONS, 100, 100, "no live observation after the demonstration"),
    ],
)
def test_nothing_to_store(kind: str, lesson: int | None, length: int, reason: str) -> None:
    with pytest.raises(NothingToStore, match=reason):
        list(CUTS[kind](marks(lesson, length)))
    with pytest.raises(SourceError, match=r"does not mark(.|\n)*build distractors"):
        list(CUTS[DEMONSTRATIONS](marks(None, 10)))
