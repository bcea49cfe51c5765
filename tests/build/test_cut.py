"""Which frames of an episode a dataset stores, and which episodes, in which order."""

from collections.abc import Generator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.build_dataset.config import list_episodes
from robomme_interference_data.build_dataset.cut import CUTS, NothingToStore
from robomme_interference_data.build_dataset.sources import Frame, SourceEpisode
from robomme_interference_data.errors import SourceError
from robomme_interference_data.ids import EpisodeId

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


# --- episodes ------------------------------------------------------------------------------------


class Listed:
    """A source that lists episodes and has nothing to read."""

    def __init__(self, *names: str):
        self.names = names

    def episodes(self) -> list[SourceEpisode]:
        return [SourceEpisode(EpisodeId.parse(name)) for name in self.names]


def listed(*sources: Any) -> list[tuple[int, str]]:
    return [(number, str(one.id)) for number, one in list_episodes(sources)]


def test_canonical_order_and_source_numbers() -> None:
    one = Listed("PatternLock/train/2", "MoveCube/train/10", "Aaa/train/0")
    two = Listed("MoveCube/train/9", "MoveCube/test/0", "MoveCube/val/3")
    assert listed(one, two) == [
        (1, "MoveCube/train/9"),
        (0, "MoveCube/train/10"),
        (1, "MoveCube/val/3"),
        (1, "MoveCube/test/0"),
        (0, "PatternLock/train/2"),
        (0, "Aaa/train/0"),
    ]


PARTS = st.sampled_from(["MoveCube", "InsertPeg", "Zzz"]), st.sampled_from(["train", "val", "test"])


@given(st.sets(st.builds("{}/{}/{}".format, *PARTS, st.integers(0, 30)), min_size=1), st.data())
def test_order_of_episodes_and_sources_does_not_matter(names: set[str], data: Any) -> None:
    shuffled = data.draw(st.permutations(sorted(names)))
    cut = data.draw(st.integers(0, len(shuffled)))
    parts = (shuffled[:cut], shuffled[cut:])
    plain = [name for _, name in listed(Listed(*sorted(names)))]
    for chosen in (parts, parts[::-1]):
        found = listed(*(Listed(*part) for part in chosen))
        assert [name for _, name in found] == plain
        assert all(name in chosen[number] for number, name in found)
