"""What a policy receives in a rollout is, bit for bit, what an item of training holds."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.buffer_sets import copy_buffer_set, plan_again
from support.days import DATASETS, build_days
from support.retrieval import make_index
from support.runs import config
from support.worlds import BUFFER_SET

from robomme_interference_data import load_buffer_set
from robomme_interference_data.evaluate import Observation, Policy, RolloutInfo
from robomme_interference_data.evaluate.rollout.rollout import run_rollout
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.worker import RunContext
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.retrieval.selector import Selector
from robomme_interference_data.simulators.recordings import Recordings
from robomme_interference_data.training import HistoryDataset, Memory, resize

pytestmark = pytest.mark.slow

EPISODE = EpisodeId("MoveCube", "test", 0)
CAMERAS = ("front", "wrist")


@pytest.fixture(scope="module")
def buffers(executed_buffers: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = copy_buffer_set(tmp_path_factory.mktemp("same") / "buffers", executed_buffers)
    plan_again(root, ("no-history", "k0", "k3", "before-k3"))
    make_index(root)
    return root


class Watching(Policy):
    """Keeps everything, and notes what its memory rule selects at each action."""

    cameras = history_cameras = CAMERAS
    every_frame = True

    def __init__(self, memory: str):
        self.memory, self.moments = Memory.parse(memory), {}  # type: ignore[var-annotated]

    def reset(self, info: RolloutInfo) -> None:
        self.frames: dict[str, list[NDArray[Any]]] = {name: [] for name in CAMERAS}
        self.states: list[NDArray[Any]] = []
        self.history = info.history_frames

    def add_history(
        self, frames: Mapping[str, NDArray[np.uint8]], states: NDArray[np.float32], start: int
    ) -> None:
        self.observe(frames, states)

    def observe(self, frames: Mapping[str, NDArray[np.uint8]], states: NDArray[np.float32]) -> None:
        for name in CAMERAS:
            self.frames[name] += map(np.copy, frames[name])
        self.states += map(np.copy, states)

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        live = len(self.states) - 1
        kept = [*self.memory.earlier(live), live]
        frames = {name: np.stack([self.frames[name][at] for at in kept]) for name in CAMERAS}
        self.moments[live - self.history] = kept, frames, np.stack([self.states[at] for at in kept])
        return np.zeros((16, 8), np.float32)

    def metadata(self) -> dict[str, Any]:
        return {}


def compare(
    buffers: Path,
    episode: EpisodeId,
    condition: str,
    memory: str,
    retrieval: str | None,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> list[int]:
    """Compare what a policy receives with the items of training; return the moments it acted."""
    monkeypatch.setenv(BUFFER_SET, str(buffers))
    buffer_set, policy = load_buffer_set(buffers), Watching(memory)
    run_rollout(
        RunContext(config(), "mine", SystemFacts(), buffer_set.name, buffer_set.revision),
        WorkItem(condition, episode),
        simulator=Recordings(str(buffers), CAMERAS),
        policy=policy,
        buffer_set=buffer_set,
        selector=Selector(retrieval) if retrieval else None,
    )
    data = HistoryDataset(
        buffer_set,
        [condition],
        split="test",
        memory=memory,
        cameras=CAMERAS,
        image_size=24,
        retrieval=retrieval,
        cache=cache,
        quiet=True,
    )
    for moment, (kept, frames, states) in policy.moments.items():
        item, count = data[data.index_of(episode, moment)], len(kept) - 1
        assert (~item["memory.is_pad"]).sum() == count
        assert [*item["memory.position"][:count], item["position"]] == kept
        assert torch.equal(item["memory.state"][:count], torch.from_numpy(states[:-1]))
        assert torch.equal(item["observation.state"], torch.from_numpy(states[-1]))
        for name in CAMERAS:
            small = torch.from_numpy(resize(frames[name], 24))
            assert torch.equal(item[f"memory.images.{name}"][:count], small[:-1])
            assert torch.equal(item[f"observation.images.{name}"], small[-1])
    return [*policy.moments]


@pytest.mark.parametrize("memory", ["framesamp:8", "window:2@2.5", "full"])
@pytest.mark.parametrize(
    "condition, retrieval",
    [("no-history", None), ("k0", None), ("before-k3", None), ("before-k3", "thumbnail")],
)
def test_same_frames_states_and_positions(
    memory: str,
    condition: str,
    retrieval: str | None,
    buffers: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cache = tmp_path_factory.getbasetemp() / "store"
    moments = compare(buffers, EPISODE, condition, memory, retrieval, cache, monkeypatch)
    assert len(moments) == 14 and max(moments) == 208


def test_of_days(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root, query = tmp_path / "buffers", EpisodeId("VideoUnmask", "test", 1)
    build_days(root, "executions", numbers=(1,), cameras=CAMERAS)
    make_index(root, names=DATASETS)
    for condition, memory, retrieval in (
        ("day-k0", "framesamp:8", None),
        ("day-k2", "full", None),
        ("day-cut-k2", "window:2@2.5", None),
        ("day-k2", "full", "thumbnail"),
    ):
        cache = tmp_path / "store"
        assert compare(root, query, condition, memory, retrieval, cache, monkeypatch) == [0]
