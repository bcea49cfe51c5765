"""One rollout: what the policy gets and when, and the row."""

import shutil
import threading
import time
import warnings
from collections.abc import Generator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises
from support.runs import EPISODE, roll, run, run_one
from support.worlds import Cheat, World

from robomme_interference_data import load_buffer_set
from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.errors import InvalidOptionError, PolicyError
from robomme_interference_data.evaluate.policies.builtin import Privileged
from robomme_interference_data.evaluate.rollout.rollout import read_ahead
from robomme_interference_data.evaluate.run.history import HistoryReader
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.ids import EpisodeId

pytestmark = pytest.mark.usefixtures("world")


# --- what the policy gets ----------------------------------------------------------------------


@pytest.mark.parametrize("chunk", [10, 500])
def test_the_history_is_the_buffer_in_chunks(chunk: int, tiny_buffers: Path) -> None:
    policy = Cheat()
    roll("k3", policy, history_chunk=chunk)
    buffer = load_buffer_set(tiny_buffers).load(EPISODE, "k3")
    assert len(buffer) == 48 + 3 * 32
    np.testing.assert_array_equal(np.stack(policy.states), buffer.states)
    sizes = [size for size, _ in policy.chunks]
    assert sum(sizes) == 144 and set(sizes[:-1]) <= {chunk} and sizes[-1] <= chunk
    assert {total for _, total in policy.chunks} == {144}


@pytest.mark.parametrize("times", [1, 3])
def test_each_live_observation_comes_once_in_chunks_of_16(times: int) -> None:
    """More than 16 actions are cut."""
    policy = Cheat()
    hold = policy.act
    policy.act = lambda o, g: np.tile(hold(o, g), (times, 1))  # type: ignore[method-assign]
    row = roll("no-history", policy)
    # The first one, then 16 and 16; the episode ends with the 40th step, in the third chunk.
    assert (row.steps, policy.live) == (40, [1, 16, 16])


def test_a_policy_may_get_only_the_observations_before_actions() -> None:
    policy, world = Cheat(), World()
    policy.every_frame = False
    roll("no-history", policy, simulator=world)
    assert policy.live == [1, 1, 1]
    assert world.drawn == 2  # after 16 and 32 steps; the 40th ends it


def test_a_cache_that_cannot_be_written_costs_no_rollout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "cache"
    blocked.write_text("a file where the folder should be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    with warnings.catch_warnings(record=True) as messages:
        warnings.simplefilter("always")
        result = run(tmp_path / "run", conditions=("k0", "k1"), cache=True)
    assert result.counts["success"] == 4
    assert [str(blocked) in str(one.message) for one in messages] == [True]  # once


@pytest.mark.parametrize(
    ("option", "memory", "kept"),
    [
        ("memory=window", "window:32", 0.5),
        ("memory=framesamp:32", "framesamp:32", 1),
        # Of 48 frames 38 and 28: the answer is shown in frames 0 to 3, and in 31 to 38.
        ("memory=window:3@1", "window:3@1", 0.5),
    ],
)
def test_a_policy_of_the_user_declares_its_memory(
    tmp_path: Path, option: str, memory: str, kept: float
) -> None:
    policy = "python:support.own_policies:Remembering"
    (row,) = run_one(
        tmp_path / "run", policy=policy, policy_options=(option,), conditions=("k0",)
    ).rows
    assert (row.memory, row.evidence_kept) == (memory, kept)


@pytest.mark.parametrize(
    ("memory", "kept"), [("window:32", 0.5), ("framesamp:32", 1), (None, None)]
)
def test_evidence_kept_if_the_memory_is_known(memory: str | None, kept: float | None) -> None:
    """MoveCube's lesson of 48 frames shows the answer in frames 0 to 3, and in 31 to 38."""
    facts = SystemFacts(memory=memory)
    assert roll("k0", Cheat(), facts=facts).evidence_kept == kept
    assert roll("no-history", Cheat(), facts=facts).evidence_kept is None


def test_only_a_privileged_policy_gets_the_evidence() -> None:
    policy = Cheat()
    roll("k0", policy)
    assert policy.info.evidence is None and policy.info.simulator is None
    policy = Cheat()
    policy.privileged = True
    roll("k0", policy)
    assert [(one.start, one.stop) for one in policy.info.evidence or ()] == [(0, 4), (31, 39)]


# --- retrieval ---------------------------------------------------------------------------------


class Chooses:
    """A retrieval step that always selects these frames."""

    camera = "front"

    def __init__(self, *frames: int):
        self.chosen = np.array(frames)

    def select(self, buffer: Buffer, image: np.ndarray) -> Any:
        return self.chosen


def test_the_policy_and_the_video_get_the_retrieved_frames() -> None:
    policy, shown = Cheat(), []
    clip = SimpleNamespace(begin=lambda *given: shown.append(given[2]), step=lambda *_: None)
    row = roll("k3", policy, selector=Chooses(*range(40, 60)), clip=clip)
    assert policy.chunks == [(20, 20)] and shown == [[*range(40, 60)]]
    assert (row.retrieval_start, row.retrieval_stop) == (40, 60)
    # 20 frames and the live one are all in the sample; 8 of them are of the 48 frames' lesson.
    assert (row.history_frames, row.lesson_frames, row.lesson_share) == (20, 8, 8 / 21)
    assert row.retrieval_selected_lesson_fraction == 8 / 21
    assert row.retrieval_selected_filler_fraction == 12 / 21
    assert row.retrieval_selected_query_fraction == 1 / 21
    empty = roll("no-history", Cheat(), selector=Chooses())
    assert empty.retrieval_start is None


def test_retrieved_frames_keep_the_position_limit() -> None:
    system = "retrieval-framesamp-modul"  # 4096 positions less 1300 steps
    with raises(InvalidOptionError):
        roll("k7", Cheat(), selector=Chooses(*range(2797)), system=system)


# --- the row -----------------------------------------------------------------------------------


def test_the_row_states_what_the_policy_got(tiny_buffers: Path) -> None:
    row, buffer_set = roll("k3", Cheat()), load_buffer_set(tiny_buffers)
    manifest = buffer_set.manifest(EPISODE, "k3")
    assert row.key == (
        *("mine", "support.worlds:World", "buffer_set", buffer_set.revision),
        *("MoveCube", "k3", "test", 0, "none", None, 0, 1),
    )
    assert (row.seed, row.goal) == (manifest.seed, manifest.goal)
    assert (row.history_frames, row.lesson_frames) == (144, 48)
    # An even 32-sample of 0 … 144 has index j·144 // 31: those under 48 are j = 0 … 10.
    assert row.lesson_share == 11 / 32 == manifest.lesson_share
    assert row.wall_s is not None and row.wall_s >= (row.reset_s or 0) + (row.policy_s or 0) - 0.01


def test_the_oracle_gets_the_simulator_and_a_rollout_times_out(trouble: Path) -> None:
    assert roll("k1", Privileged("oracle")).status == "success"
    (trouble / "MoveCube-0").write_text("endless")
    row = roll("no-history", Cheat())
    assert (row.status, row.success, row.steps) == ("timeout", False, 1300)


@pytest.mark.parametrize(
    "actions",
    [np.zeros((0, 8)), np.zeros(8), np.zeros((16, 7)), np.full((16, 8), np.nan), "up", [[1], []]],
)
def test_invalid_actions_are_errors(actions: Any) -> None:
    policy = Cheat()
    policy.act = lambda observation, goal: actions  # type: ignore[method-assign]
    with raises(PolicyError):
        roll("k0", policy)


# --- reading ahead -----------------------------------------------------------------------------


def counting(stop: int, made: list[Any], breaks_at: int | None = None) -> Generator[int]:
    """Count to a number, and record each item, its thread, and the end."""
    try:
        for number in range(stop):
            if number == breaks_at:
                raise OSError("the disk is gone")
            made.append((number, threading.get_ident()))
            yield number
    finally:
        made.append("closed")


@given(stop=st.integers(0, 12), depth=st.integers(1, 5))
def test_all_items_in_order(stop: int, depth: int) -> None:
    made: list[Any] = []
    with read_ahead(counting(stop, made), depth) as items:
        assert list(items) == list(range(stop))
    assert made[-1] == "closed" and len(made) == stop + 1


def test_only_the_first_items_are_read_ahead_in_a_thread() -> None:
    made: list[Any] = []
    with pytest.raises(KeyboardInterrupt), read_ahead(counting(10, made), 3) as items:
        for count in (3, 4):
            until = time.monotonic() + 20
            while len(made) < count and time.monotonic() < until:
                time.sleep(0.001)
            time.sleep(0.05)  # one more would be made by now
            assert [number for number, _ in made] == list(range(count))
            assert next(items) == count - 3
        raise KeyboardInterrupt
    assert made[-1] == "closed" and len(made) <= 6  # a stream that is left is closed
    assert len({thread for _, thread in made[:4]} - {threading.get_ident()}) == 1


def test_an_error_is_raised_in_place_of_its_item() -> None:
    with read_ahead(counting(5, [], breaks_at=2), 4) as items:
        assert [next(items), next(items)] == [0, 1]
        with raises(OSError):
            next(items)


# --- damaged history ---------------------------------------------------------------------------


def test_damaged_history_is_an_error_that_names_the_file(
    tmp_path: Path, tiny_buffers: Path
) -> None:
    """The videos of two lessons are exchanged; only rollouts with their history break."""
    root = shutil.copytree(tiny_buffers, tmp_path / "buffer_set")
    dataset = load_buffer_set(root).datasets["demonstrations"]
    episodes = [EpisodeId(name, "test", 0) for name in ("MoveCube", "VideoRepick")]
    names = [dataset.files_of(dataset.index_of(one), ["front"])[1] for one in episodes]
    one, other = (root / "demonstrations" / name for name in names)
    one.rename(tmp_path / "kept")
    other.rename(one)
    (tmp_path / "kept").rename(other)
    for row in run(tmp_path / "run", buffer_set=root, conditions=("no-history", "k0", "k1")).rows:
        assert (row.status == "error") == (row.condition != "no-history"), row.error
        if row.error:
            name = names[row.family == "VideoRepick"]
            assert name in row.error and "SHA-256" in row.error


@pytest.mark.parametrize("given", [range(144), range(40, 60), [0, 47, 48, 143]])
@pytest.mark.parametrize("size", [10, 64])
def test_the_reader_returns_the_frames_of_the_buffer(
    tiny_buffers: Path, given: list[int], size: int
) -> None:
    buffer_set = load_buffer_set(tiny_buffers)
    buffer, reader = buffer_set.load(EPISODE, "k3"), HistoryReader(buffer_set.datasets)
    for _ in range(2):  # whole sessions at first, then the given frames alone
        chunks = list(reader.stream(buffer, size, ("front",), given))
        assert np.concatenate([one.indices for one in chunks]).tolist() == list(given)
        frames = np.concatenate([one.frames["front"] for one in chunks])
        assert np.array_equal(frames, buffer.frames("front")[list(given)])
        assert all(0 < len(one) <= size for one in chunks)
