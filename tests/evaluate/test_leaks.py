"""Only the history tells the answer: a cheat would find whatever else did."""

from typing import Any

import pytest
from support.runs import EPISODE, roll
from support.worlds import Cheat

from robomme_interference_data import load_buffer
from robomme_interference_data.data.buffer_set import BufferSet

pytestmark = pytest.mark.usefixtures("world")


def test_with_the_lesson_the_cheat_succeeds_at_once() -> None:
    policy = Cheat()
    row = roll("k0", policy)
    assert (row.status, row.success, row.steps) == ("success", True, 1)
    assert policy.info.simulator is None  # only privileged policies get it


def test_without_history_even_a_cheat_sees_nothing_of_the_demonstration() -> None:
    for check in (False, True):  # also where the simulator is asked for the demonstration
        row = roll("no-history", Cheat(), check_lesson=check)
        assert (row.status, row.success, row.steps) == ("fail", False, 40)
        assert (row.history_frames, row.lesson_frames, row.lesson_share) == (0, 0, None)


def test_a_buffer_that_is_not_empty_is_found_too(
    monkeypatch: pytest.MonkeyPatch, tiny_buffers: Any
) -> None:
    lesson = load_buffer(EPISODE, "k0", buffer_set=tiny_buffers)
    monkeypatch.setattr(BufferSet, "load", lambda *_, **__: lesson)
    assert roll("no-history", Cheat()).status == "success"
