"""One rollout: what the policy gets, when, and what is written of it."""

import threading
from pathlib import Path
from typing import Any

import factories
import numpy as np
import pytest
import rollout_doubles
from rollout_calls import EPISODE, config, roll
from rollout_doubles import Cheat, World

from robomme_interference_data import load_split
from robomme_interference_data.buffer import Buffer
from robomme_interference_data.errors import (
    HistoryTooLongError,
    PolicyError,
    RolloutError,
    SimulatorCrashError,
)
from robomme_interference_data.evaluate import systems
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.evaluate.policies.builtin import make_builtin
from robomme_interference_data.evaluate.retrieval import make_selector
from robomme_interference_data.evaluate.rollout import run_rollout
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.progress import BuildProgress
from robomme_interference_data.retrieval.commands import datasets_in
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.index import build_index
from robomme_interference_data.retrieval.selector import Selection
from robomme_interference_data.simulators.base import Status

pytestmark = pytest.mark.usefixtures("world")


class Patient(World):
    """Begins an episode in another process, and only when its history is being decoded."""

    remote = True
    decoding = threading.Event()

    def reset(self, episode_id: str, demonstration: bool = True) -> Any:
        assert self.decoding.wait(20)
        return super().reset(episode_id, demonstration)


def test_history_is_decoded_while_the_episode_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Buffer.stream

    def noted(*options: Any) -> Any:
        Patient.decoding.set()
        yield from stream(*options)

    monkeypatch.setattr(Buffer, "stream", noted)
    policy = Cheat()
    assert roll("k1", policy, simulator=Patient(), history_chunk=50).success
    assert policy.chunks == [(50, 68), (18, 68)]


class First:
    """A retrieval step that chooses the first so many frames."""

    name, camera = "first", "front"

    def __init__(self, frames: int):
        self.frames = frames

    def select(self, buffer: Buffer, image: np.ndarray) -> Selection:
        return Selection(0, self.frames, None, 1.0, 0.0, 0.0)  # type: ignore[arg-type]


def test_what_retrieval_chose_keeps_the_position_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    # 4096 positions less 4060 steps leave 36 frames, of a buffer of 36 + 3 · 32.
    monkeypatch.setattr(systems, "MAX_STEPS", 4060)
    settings = config(system="retrieval-framesamp-modul")
    parts: Any = {"simulator": World(), "split": load_split(settings.split)}
    item = WorkItem("k3", EPISODE)
    row = run_rollout(settings, item, policy=Cheat(), selector=First(36), **parts)  # type: ignore[arg-type]
    assert row.history_frames == 36
    with pytest.raises(HistoryTooLongError, match="37 history frames and 4060 steps"):
        run_rollout(settings, item, policy=Cheat(), selector=First(37), **parts)  # type: ignore[arg-type]


def test_retrieval_hands_over_what_its_rule_chose_of_its_cameras_frames(tmp_path: Path) -> None:
    split = factories.copy_of_split(tmp_path / "split")
    build_index(datasets_in(split), Thumbnail(), BuildProgress(quiet=True), camera="wrist")
    settings = config(
        split=str(split), retrieval="thumbnail", retrieval_rule="last/0.5", retrieval_camera="wrist"
    )
    selector, policy = make_selector(settings), Cheat()
    assert selector is not None
    loaded = load_split(split)
    chosen = selector.select(loaded.load(EPISODE, 3), loaded.load(EPISODE, 3).query_frame("wrist"))
    assert chosen.start > 36 and chosen.stop == 36 + 3 * 32  # nothing of the lesson
    row = run_rollout(
        settings,
        WorkItem("k3", EPISODE),
        simulator=World(),
        policy=policy,
        split=loaded,
        selector=selector,
    )
    frames = chosen.stop - chosen.start
    assert policy.chunks == [(frames, frames)]
    assert row.retrieval_model == "thumbnail@wrist/last/0.5"
    assert (row.retrieval_start, row.retrieval_stop) == (chosen.start, chosen.stop)
    assert (row.lesson_share, row.retrieval_selected_lesson_fraction) == (0.0, 0.0)


@pytest.mark.parametrize("chunk", [1, 10, 64, 500])
def test_the_history_is_the_buffer_in_chunks(chunk: int) -> None:
    policy = Cheat()
    roll("k3", policy, history_chunk=chunk)
    buffer = load_split(factories.split()).load(EPISODE, 3)
    assert len(buffer) == 36 + 3 * 32
    np.testing.assert_array_equal(np.stack(policy.states), buffer.states)
    sizes = [size for size, _ in policy.chunks]
    assert sum(sizes) == 132 and set(sizes[:-1]) <= {chunk} and sizes[-1] <= chunk
    assert {total for _, total in policy.chunks} == {132}


def test_live_observations_come_once_each_in_chunks_of_16() -> None:
    policy = Cheat()
    row = roll("no-history", policy)
    # The first one, then 16 and 16; the episode ends with the 40th step, in the third chunk.
    assert (row.steps, policy.live) == (40, [1, 16, 16])


def test_a_policy_may_ask_for_the_deciding_observations_only() -> None:
    policy, world = Cheat(), World()
    policy.every_frame = False
    settings = config()
    run_rollout(
        settings,
        WorkItem("no-history", EPISODE),
        simulator=world,
        policy=policy,
        split=load_split(settings.split),
    )
    assert policy.live == [1, 1, 1]
    assert world.drawn == 2  # after 16 and 32 steps; the 40th ends it


def test_a_rollout_times_out_after_1300_steps() -> None:
    row = roll("no-history", Cheat(), EpisodeId("MoveCube", "test", 1))
    assert (row.status, row.success, row.steps) == ("timeout", False, 1300)


def test_the_row_says_what_was_given() -> None:
    row = roll("k3", Cheat())
    manifest = load_split(factories.split()).manifest(EPISODE, 3)
    assert row.key == (
        *("mine", "world", "split", load_split(factories.split()).revision),
        *("PatternLock", "k3", "test", 1, 0, 1),
    )
    assert (row.seed, row.difficulty, row.goal) == (
        manifest.seed,
        manifest.difficulty,
        manifest.goal,
    )
    assert (row.history_frames, row.lesson_frames) == (132, 36)
    # An even 32-sample of 0 … 132 has index j·132 // 31: those under 36 are j = 0 … 8.
    assert row.lesson_share == 9 / 32 == manifest.lesson_share
    assert row.wall_s is not None and row.wall_s >= (row.reset_s or 0) + (row.policy_s or 0) - 0.01


def test_the_oracle_gets_the_simulator_and_others_do_not() -> None:
    row = roll("k1", make_builtin("oracle"))
    assert row.status == "success"
    with pytest.raises(PolicyError, match="needs the simulator itself"):
        policy = make_builtin("oracle")
        policy.privileged = False
        roll("k1", policy)


def test_hold_does_nothing() -> None:
    assert roll("k0", make_builtin("hold")).status == "fail"


# --- policies and simulators that break --------------------------------------------------------


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((0, 8)), r"shape \(0, 8\); expected \(n, 8\)"),
        (np.zeros(8), r"shape \(8,\)"),
        (np.zeros((16, 7)), r"shape \(16, 7\)"),
        (np.full((16, 8), np.nan), "not finite numbers"),
    ],
)
def test_bad_actions_are_refused(actions: Any, message: str) -> None:
    policy = Cheat()
    policy.act = lambda observation, goal: actions  # type: ignore[method-assign]
    with pytest.raises(PolicyError, match=message):
        roll("k0", policy)


def test_more_than_16_actions_are_cut() -> None:
    policy = Cheat()
    hold = policy.act
    policy.act = lambda o, g: np.tile(hold(o, g), (3, 1))  # type: ignore[method-assign]
    roll("no-history", policy)
    assert policy.live == [1, 16, 16]


@pytest.mark.parametrize(
    ("trouble", "raised"), [("raise", SimulatorCrashError), ("error", RolloutError)]
)
def test_a_broken_simulator_is_an_error(
    trouble: str, raised: type[Exception], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(rollout_doubles.TROUBLE, str(tmp_path))
    (tmp_path / "PatternLock-1").write_text(trouble)
    with pytest.raises(raised):
        roll("no-history", Cheat())


def test_statuses_are_the_protocols() -> None:
    assert [str(status) for status in Status if status is not Status.ONGOING] == [
        *("success", "fail", "timeout", "error")
    ]
