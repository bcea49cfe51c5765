"""Draws of `HistoryDataset`, the same in all processes, and what other processes find."""

import copy
import os
import pickle
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.buffer_sets import GOLDEN, build, copy_buffer_set, plan_again
from support.hub import BUFFER_SET, push_buffer_set
from support.hub_server import HubServer
from support.messages import raises
from support.own_dataset import BuffersDataset
from support.retrieval import make_index

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.errors import HashMismatchError
from robomme_interference_data.training import HistoryDataset, resize
from robomme_interference_data.training.draws import Weights

Make = Callable[..., HistoryDataset]


@pytest.mark.slow
def test_items_are_a_function_of_seed_epoch_and_index(make: Make) -> None:
    def drawn(data: HistoryDataset, workers: int = 0) -> list[str]:
        loader = torch.utils.data.DataLoader(data, 64, num_workers=workers)
        return [name for batch in loader for name in batch["condition"]]

    data = make({"k0": 1, "k3": 1})
    first = drawn(data)
    assert {*first} == {"k0", "k3"} and first == drawn(data, 2) == drawn(make({"k0": 1, "k3": 1}))
    assert [data[index]["condition"] for index in (5, 0, 5)] == [first[5], first[0], first[5]]
    assert drawn(make({"k0": 1, "k3": 1}, seed=1)) != first
    shuffled = torch.randperm(20)
    assert data[[*shuffled]]["condition"] == [first[index] for index in shuffled]
    data.set_epoch(1)
    second = drawn(data)
    assert second != first and second == drawn(data, 2)
    assert pickle.loads(pickle.dumps(data))[7]["condition"] == second[7]


def test_a_running_loader_sees_the_epoch(make: Make) -> None:
    data = make({"k0": 1, "k3": 1}, chunk=0)
    loader = torch.utils.data.DataLoader(data, num_workers=1, persistent_workers=True)
    seen = []
    for epoch in range(8):
        data.set_epoch(epoch)
        seen.append([batch["condition"][0] for batch in loader])
        assert seen[-1] == [data[number]["condition"] for number in range(3)]
    assert len({*map(tuple, seen)}) > 1


@given(st.lists(st.sampled_from([1, 2, 5]), min_size=1, max_size=4), st.integers(0, 9))
def test_weights_are_probabilities(weights: list[int], seed: int) -> None:
    names = [f"k{number}" for number in range(len(weights))]
    drawing = Weights.parse("conditions", dict(zip(names, weights, strict=True)))
    counts = Counter(drawing.draw(seed, number) for number in range(2000))
    for name, weight in zip(names, weights, strict=True):
        share = weight / sum(weights)
        assert abs(counts[name] / 2000 - share) < 6 * (share * (1 - share) / 2000) ** 0.5 + 1e-9


def test_a_redrawn_memory_has_places_for_the_longest_history(make: Make) -> None:
    """A lesson of 48 frames and up to five units of 32, before the current frame."""
    data = make({"k5": 1, "before-k2": 1}, redraw=True, chunk=0, memory="full")
    assert data.memory_frames == 48 + 5 * 32
    for item in (data[index] for index in range(3)):
        used = 48 + 32 * {"k5": 5, "before-k2": 2}[item["condition"]]
        assert int(item["position"]) == used == int((~item["memory.is_pad"]).sum())


def test_sessions_drawn_anew_keep_the_rules(make: Make, buffers: Path) -> None:
    """Conditions need not be planned; units are of other families and of the allowed episodes."""
    data = make(["k5"], redraw=True, unit_episodes="0", chunk=0, memory="window:400")
    lesson, drawn = 48, set()
    units = load_buffer_set(buffers).datasets["distractors"]
    by_frame = {}
    for record in units.records():
        [frame] = units.iter_frames(record.episode_index, "front", 0, 1)
        by_frame[resize(frame[None].copy(), 16).tobytes()] = record.episode_id
    for epoch in range(3):
        data.set_epoch(epoch)
        for number, query in enumerate(data.episode_ids):
            images = data[number]["memory.images.front"]
            starts = [images[lesson + 32 * place].numpy().tobytes() for place in range(5)]
            sources = [by_frame[start] for start in starts]
            assert len({*sources}) == 5 and {one.index for one in sources} == {0}
            assert query.family not in {one.family for one in sources}
            drawn.add((number, tuple(sources)))
    assert len(drawn) > 3  # other draws in other epochs


# --- other processes ---------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"redraw": True, "retrieval": "thumbnail"}])
def test_spawned_workers_open_the_same_items(options: dict[str, Any], make: Make) -> None:
    data = make({"k1": 1, "k3": 1}, chunk=0, **options)
    data.set_epoch(1)
    loader = torch.utils.data.DataLoader(
        data, num_workers=1, batch_size=None, multiprocessing_context="spawn"
    )
    for index, item in enumerate(loader):
        assert item["condition"] == data[index]["condition"]
        for name in ("position", "memory.position", "memory.images.front"):
            assert torch.equal(item[name], data[index][name])


def test_damaged_frames_of_the_cache_are_decoded_again(
    make: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When a process first opens them, whatever their size and time of writing."""
    expected = make(["k1"], cache=tmp_path)[0]
    names = [path.name for path in tmp_path.iterdir()]
    for path in map(tmp_path.joinpath, names):
        stat = path.stat()
        damaged = bytes(stat.st_size - 32) + path.read_bytes()[-32:]
        path.unlink()  # what the first dataset has open stays
        path.write_bytes(damaged)
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    monkeypatch.setattr("robomme_interference_data.storage.cache._checked", {})  # a new process
    found = make(["k1"], cache=tmp_path)[0]
    assert all(f"{name} is damaged" in caplog.text for name in names)
    for name in ("observation.images.front", "memory.images.front"):
        assert found[name].any() and torch.equal(found[name], expected[name])


def test_a_buffer_set_that_changed_is_an_error_of_its_items(
    executed_buffers: Path, tmp_path: Path
) -> None:
    """Whatever changed: planned buffers, episodes, chosen frames, or bytes."""
    root = copy_buffer_set(tmp_path / "buffers", executed_buffers)
    make_index(root)
    options: Any = {"split": "test", "chunk": 0, "cache": tmp_path / "cache", "quiet": True}
    data = HistoryDataset(root, ["k0"], **options)
    retrieving = HistoryDataset(root, ["k3"], retrieval="thumbnail", **options)
    same, retrieved = pickle.dumps(data), pickle.dumps(retrieving)
    for copied in (pickle.loads(same), copy.deepcopy(data)):
        assert copied[0]["episode_id"] == data[0]["episode_id"]
    assert torch.equal(
        pickle.loads(retrieved)[0]["memory.position"], retrieving[0]["memory.position"]
    )
    plan_again(root, ["no-history", "k0", "k3"])
    for pickled in (same, retrieved):
        with raises(HashMismatchError):
            pickle.loads(pickled)[0]


def test_a_buffer_set_that_grew_is_an_error_of_its_items(
    executed_buffers: Path, tmp_path: Path
) -> None:
    """One more test episode before the others: an index would mean another episode."""
    root = copy_buffer_set(tmp_path / "buffers")
    options: Any = {"split": "test", "chunk": 0, "cache": tmp_path / "cache", "quiet": True}
    data = HistoryDataset(root, ["k0"], **options)
    pickled = pickle.dumps(data)
    families = ("VideoRepick", "MoveCube", "PatternLock", "InsertPeg")
    build(root, "demonstrations", SampleSource(size=32), families=families, split="test")
    plan_again(root, ["k0"])
    grown = HistoryDataset(root, ["k0"], **options)
    assert grown[2]["episode_id"] != data[2]["episode_id"]
    with raises(HashMismatchError):
        pickle.loads(pickled)[2]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
def test_a_users_own_dataset_in_workers(method: str) -> None:
    data = BuffersDataset(GOLDEN)
    loader = torch.utils.data.DataLoader(
        data, batch_size=None, num_workers=1, multiprocessing_context=method
    )
    for index, states in enumerate(loader):
        assert torch.equal(states, data[index])


@pytest.mark.slow
def test_a_spawned_worker_reports_a_changed_set(executed_buffers: Path, tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "buffers", executed_buffers)
    data = HistoryDataset(root, ["k0"], split="test", chunk=0, cache=tmp_path / "cache", quiet=True)
    plan_again(root, ["k0", "k1"])
    loader = torch.utils.data.DataLoader(data, num_workers=1, multiprocessing_context="spawn")
    with pytest.raises(HashMismatchError) as raised:
        next(iter(loader))
    assert "was changed since the training began" in str(raised.value)


def test_only_the_sessions_in_use_are_stored(make: Make, tmp_path: Path) -> None:
    """A lesson of 48 frames, an execution of 212, and for k1 a unit of 32."""
    for condition, frames in (("k0", [48, 212]), ("k1", [32, 48, 212])):
        cache = tmp_path / condition
        make([condition], families=["MoveCube"], cache=cache)
        sizes = sorted(path.stat().st_size for path in cache.iterdir())
        assert sizes == [count * 3 * 16 * 16 + 32 for count in frames]


def test_units_that_may_not_be_drawn_are_not_stored(make: Make, buffers: Path, tmp_path: Path):
    """Three lessons, and the units of episodes 0."""
    make(["k5"], redraw=True, unit_episodes="0", chunk=0, memory="window:400", cache=tmp_path)
    units = load_buffer_set(buffers).datasets["distractors"].records()
    allowed = sum(record.episode_id.index == 0 for record in units)
    assert len([*tmp_path.iterdir()]) == 3 + allowed


def test_only_the_videos_in_use_are_downloaded(hub: HubServer, tmp_path: Path) -> None:
    push_buffer_set(hub, GOLDEN, tmp_path / "work")
    options: dict[str, Any] = {
        "split": "test",
        "chunk": 0,
        "cache": tmp_path / "cache",
        "quiet": True,
    }
    data = HistoryDataset(BUFFER_SET, ["k1"], families=["MoveCube"], **options)
    assert len(data) == 1
    videos = [path for path in hub.downloads() if path.startswith("videos/")]
    assert len(videos) == 2 and not any("wrist" in path for path in videos)
