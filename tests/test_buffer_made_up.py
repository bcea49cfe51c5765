"""Buffers by hand: what the format must carry for later splits, and their verification."""

from dataclasses import replace

import numpy as np
import pytest
from sample_buffers import (
    BUFFERS,
    EPISODE,
    buffer,
    by_hand,
    check,
    expected_frames,
    made_up,
    opened,
)

from robomme_interference_data.errors import HashMismatchError, TruncatedVideoError

NAMES = [
    "as planned",
    "nothing",
    "lesson last",
    "lesson in the middle",
    "lesson absent",
    "lesson in two parts",
    "parts overlap",
    "the same unit twice",
    "held frame",
    "every frame held",
    "only a held frame",
    "contradiction",
    "single frames",
]


@pytest.mark.parametrize("name", NAMES)
def test_made_up_buffers(name: str) -> None:
    entries = made_up(name)
    made = by_hand(*entries, threads=3)
    check(made, entries)
    made.verify()
    assert [session.entry for session in made.sessions] == entries
    for index in range(0, len(made), 5):
        np.testing.assert_array_equal(made.frame(index), expected_frames(entries, "front")[index])


def test_sixty_three_distractors() -> None:
    entries = made_up("many")
    made = by_hand(*entries)
    assert len(made) == 36 + 63 * 32
    np.testing.assert_array_equal(made.frames("wrist"), expected_frames(entries, "wrist"))


def test_a_span_that_the_episode_does_not_have() -> None:
    lesson = opened().manifest(EPISODE, 3).sessions[0]
    made = by_hand(replace(lesson, stop=40))  # 37 frames are stored
    for use in (
        made.frames,
        made.verify,
        lambda: made.states,
        lambda: list(made.stream(16)),
    ):
        with pytest.raises(TruncatedVideoError, match="VideoUnmask/test/1 has 37 stored frames"):
            use()


# --- verification ----------------------------------------------------------------------------


def test_verify_accepts_the_split() -> None:
    for episode, k in BUFFERS[-6:]:
        buffer(k, episode).verify()


@pytest.mark.parametrize("place", [0, 1, 3])
def test_verify_names_the_session(place: int) -> None:
    entries = list(opened().manifest(EPISODE, 3).sessions)
    entries[place] = replace(entries[place], sha256="0" * 64)
    with pytest.raises(HashMismatchError) as caught:
        by_hand(*entries).verify()
    entry = entries[place]
    assert f"{EPISODE} at k=3: {entry.role} {entry.source} " in caught.value.message
    assert f"frames 0 to {entry.stop - 1}" in caught.value.message
    # The data is as the dataset recorded it, so the manifest is what differs.
    assert caught.value.message.endswith("differing: the manifest itself")
    assert "robomme-interference verify SPLIT" in str(caught.value.hint)


def test_verify_notices_other_frames_under_the_same_digest() -> None:
    lesson, first, *_ = opened().manifest(EPISODE, 3).sessions
    with pytest.raises(HashMismatchError):
        by_hand(lesson, replace(first, start=1)).verify()
    with pytest.raises(HashMismatchError):
        by_hand(lesson, replace(first, episode_index=first.episode_index ^ 1)).verify()
