"""What lesson length, goal and live observation reveal of the answer, by hand."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data import load_buffer_set
from robomme_interference_data.evaluate.shortcuts import (
    Cues,
    Shortcut,
    by_group,
    by_nearest,
    cues_of,
    shortcuts,
)
from robomme_interference_data.schema.records import EvidenceSpan


def lesson(texts: Sequence[str], length: int, goal: str = "goal", shade: int | None = None) -> Cues:
    """A lesson; its view has one bright half, or none is stored."""
    spans = tuple(EvidenceSpan(part, text, part, part + 1) for part, text in enumerate(texts))
    view = None
    if shade is not None:
        view = np.zeros((16, 16, 3), np.uint8)
        view[:, :8] = shade
    return Cues("MoveCube", spans, length, goal, view)


def test_each_cue_reveals_what_it_reveals() -> None:
    episodes = [
        lesson(["push"], 150, "move the red cube", 10),
        lesson(["push"], 160, "move the blue cube", 200),
        lesson(["grasp"], 230, "move the red cube", 190),
        lesson(["grasp"], 240, "move the blue cube", 20),
    ]
    # Lengths reveal all; with the goals the other one always has the other value; so have views.
    assert [*shortcuts(episodes)] == [Shortcut("MoveCube", "0", 4, 2, 4, 0, 0)]


def test_counts_and_later_parts_are_measured_where_they_exist() -> None:
    episodes = [lesson("a", 10), lesson("ab", 20), lesson("ac", 21), lesson("ab", 30)]
    count, part = shortcuts(episodes)  # the first part is the same in all: nothing to reveal
    assert count == Shortcut("MoveCube", "count", 4, 3, 3, 3, None)
    # The nearest of 20 is 21 and the reverse; 30 is as near to none but 21.
    assert part == Shortcut("MoveCube", "1", 3, 2, 0, 1, None)


def test_a_tie_counts_for_the_first() -> None:
    assert by_nearest(np.array([[0.0], [1.0], [2.0]]), ["a", "a", "b"]) == 2  # 1 is as near to 2
    assert by_nearest(np.array([[0.0], [1.0], [2.0]]), ["b", "a", "a"]) == 1
    assert by_group([0, 0, 0, 1], ["a", "b", "b", "a"]) == 0
    assert by_group([0, 0, 0], ["b", "b", "b"]) == 3


@given(st.lists(st.sampled_from("abc"), min_size=2, max_size=12), st.randoms())
def test_a_cue_that_is_the_answer_reveals_it(values: list[str], random: object) -> None:
    shared = sum(values.count(one) > 1 for one in values)  # others have no fellow to learn from
    features = np.array([[ord(one)] for one in values], np.float64)
    assert by_nearest(features, values) == shared
    assert by_group(values, values) >= shared


def test_the_cues_of_a_buffer_set(tiny_buffers: Path) -> None:
    buffer_set = load_buffer_set(tiny_buffers)
    cues = cues_of(buffer_set)
    assert len(cues) == len(buffer_set.episode_ids)
    assert {one.length for one in cues} == {48}
    view = cues[0].view
    assert view is not None
    assert (view == buffer_set.query(buffer_set.episode_ids[0]).frame()).all()
