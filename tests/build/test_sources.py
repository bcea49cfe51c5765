"""Opening sources by name, what all of them share, and the made-up sample."""

import hashlib
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.build_dataset.sources import KINDS, Recording, open_source
from robomme_interference_data.build_dataset.sources.base import compose, demonstration_length
from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import InvalidIdError, InvalidOptionError, SourceError


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("", None),
        ("frames", None),
        ("frames:", None),
        ("robome-h5:recordings", "'robomme-h5'"),
        ("tabletop:fast", None),
        ("recordings/", None),
    ],
)
def test_what_is_no_source_lists_all_kinds(text: str, hint: str | None) -> None:
    with pytest.raises(InvalidOptionError, match=f"--source {text!r} is not one of") as caught:
        open_source(text)
    assert all(usage in caught.value.message for usage, _ in KINDS.values())
    assert hint is None or hint in str(caught.value.hint)


def test_the_docs_know_all_kinds() -> None:
    table = (Path(__file__).parents[2] / "docs" / "sources.md").read_text()
    for usage, _ in KINDS.values():
        assert "| `" + usage.replace(" or ", "` or `") in table


@pytest.mark.parametrize("kind", ["frames", "robomme-h5"])
def test_a_folder_that_does_not_exist(kind: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidOptionError, match="missing does not exist"):
        open_source(f"{kind}:{tmp_path / 'missing'}")


@given(st.integers(0, 30), st.integers(0, 30))
def test_a_demonstration_comes_first_and_in_one_piece(lesson: int, rest: int) -> None:
    flags = [True] * lesson + [False] * rest
    assert demonstration_length(flags, "it") == lesson
    if rest:
        with pytest.raises(SourceError, match=f"it is true in {lesson + 1} frames, not all"):
            demonstration_length([*flags, True], "it")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"goals": ()}, "the goal is missing"),
        ({"goals": ("do it", " ")}, "the goal is 'do it' and ' '"),
        ({"difficulty": "esy"}, "'esy'; expected one of easy, medium, hard.*\n.*'easy'"),
    ],
)
def test_recordings_check_themselves(values: dict[str, Any], message: str) -> None:
    known = {"goals": ("do it",), "seed": None, "difficulty": None, "simulator": None}
    frames = compose({}, np.zeros((0, 1), np.float32), None, None)
    with pytest.raises(SourceError, match=message):
        Recording(**(known | values), exact=True, frames=frames)


# --- the sample ----------------------------------------------------------------------------------

SAMPLE = SampleSource(("VideoRepick", "Drawer"), size=32)


def test_the_sample() -> None:
    seen: set[bytes] = set()
    lengths = {}
    for episode in SAMPLE.episodes():
        recording = SAMPLE.read(episode, None)
        frames = list(recording.frames)
        name, shown = str(episode.id), [frame.is_demonstration for frame in frames]
        lengths[name] = (len(frames), shown.index(False))
        goal = f"watch the video carefully, then do the {episode.id.family} task again"
        seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4])
        difficulty = ("easy", "medium", "hard")[episode.id.index]
        told = (recording.goals, recording.seed, recording.difficulty, recording.simulator)
        assert told == ((goal,), seed, difficulty, "sample")
        for one, other in pairwise(frames):  # an action is the state that follows
            assert one.action is not None
            assert np.array_equal(one.action, other.state)
        views = {frame.images[camera].tobytes() for frame in frames[::8] for camera in frame.images}
        assert not views & seen, "two episodes have a frame in common"
        seen |= views
    assert lengths == {
        "VideoRepick/train/0": (260, 48),
        "VideoRepick/train/1": (200, 64),  # too short for a unit
        "VideoRepick/train/2": (260, 48),
        "VideoRepick/test/0": (260, 48),
        "Drawer/train/0": (260, 48),
        "Drawer/train/1": (260, 64),
        "Drawer/train/2": (260, 48),
        "Drawer/test/0": (260, 48),
    }


def test_families_of_the_sample() -> None:
    assert {one.id.family for one in open_source("sample").episodes()} == set(FAMILIES)
    one, other = (open_source(f"sample:{names}").episodes() for names in ("A,B", "B,A"))
    assert [episode.id for episode in one] == [episode.id for episode in other]
    # Another order makes other episodes, so the key tells it.
    assert all(a.key != b.key for a, b in zip(one, other, strict=True))
    with pytest.raises(InvalidIdError):
        open_source("sample:9lives").episodes()
