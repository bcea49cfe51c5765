"""Items of `HistoryDataset`: frames of the right history, draws, and what it refuses."""

import pickle
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.buffer_sets import GOLDEN, QUERIES, copy_buffer_set, plan_again
from support.hub import BUFFER_SET, push_buffer_set
from support.hub_server import HubServer
from support.messages import raises
from support.retrieval import make_index
from support.shifted import add_shifted
from support.tabletop import TABLETOP
from torch.utils.data import default_collate

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.constants import EXECUTIONS, MANIFESTS, STATE
from robomme_interference_data.data.questions import read_questions
from robomme_interference_data.errors import (
    HashMismatchError,
    InvalidOptionError,
    MissingFileError,
    UnknownNameError,
)
from robomme_interference_data.retrieval.select import choose, measure
from robomme_interference_data.retrieval.selector import Selector
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.schema.shifts import SHIFTS
from robomme_interference_data.training import HistoryDataset, resize
from robomme_interference_data.training.draws import Weights

LIVE = 260 - 48
"""Frames of a sample episode after its lesson."""

Make = Callable[..., HistoryDataset]


@pytest.fixture(scope="session")
def buffers(executed_buffers: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden buffer set with executions, shifted views, and an index."""
    root = copy_buffer_set(tmp_path_factory.mktemp("training") / "buffers", executed_buffers)
    add_shifted(root)
    make_index(root)
    return root


@pytest.fixture(scope="session")
def make(buffers: Path, tmp_path_factory: pytest.TempPathFactory) -> Make:
    """Make a dataset of that buffer set; the cache is shared."""
    store = tmp_path_factory.mktemp("cache")

    def call(conditions: Any = ("k3",), **options: Any) -> HistoryDataset:
        usual: dict[str, Any] = {"cache": store, "quiet": True, "image_size": 16}
        return HistoryDataset(buffers, conditions, **usual | options)

    return call


# --- what an item holds ------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("memory", ["framesamp:8", "window:5", "full"])
@pytest.mark.parametrize("condition", ["no-history", "k0", "k3"])
@pytest.mark.parametrize("moment", [0, 3, LIVE - 1])
def test_memory_is_of_the_buffer_and_the_execution(
    memory: str, condition: str, moment: int, make: Make, buffers: Path
) -> None:
    data = make([condition], memory=memory, cameras=("front", "wrist"))
    assert len(data) == 3 * LIVE
    item = data[data.index_of(QUERIES[1], moment)]
    buffer = load_buffer(QUERIES[1], condition, buffer_set=buffers)
    live = load_buffer_set(buffers).datasets[EXECUTIONS]
    number = live.index_of(buffer.episode_id)
    kept = list(Memory.parse(memory).earlier(len(buffer) + moment))
    assert int(item["position"]) == len(buffer) + moment and int(item["frame_index"]) == moment
    assert item["memory.position"][: len(kept)].tolist() == kept
    assert (~item["memory.is_pad"]).sum() == len(kept) <= data.memory_frames
    for camera in ("front", "wrist"):
        frames = [*buffer.frames(camera)]
        frames += [one.copy() for one in live.iter_frames(number, camera, 0, LIVE)]
        small = resize(np.stack(frames), 16)
        images = item[f"memory.images.{camera}"]
        np.testing.assert_array_equal(images[: len(kept)], small[kept])
        assert not images[len(kept) :].any()
        current = item[f"observation.images.{camera}"]
        np.testing.assert_array_equal(current, small[len(buffer) + moment])
    states = np.concatenate([buffer.states, live.read_vectors(number, STATE, 0, LIVE)])
    np.testing.assert_array_equal(item["memory.state"][: len(kept)], states[kept])
    np.testing.assert_array_equal(item["observation.state"], states[len(buffer) + moment])
    actions = live.read_vectors(number, "action", 0, LIVE)
    expected = actions[np.minimum(np.arange(moment, moment + 16), LIVE - 1)]
    np.testing.assert_array_equal(item["action"], expected)
    assert int(item["action_is_pad"].sum()) == max(0, moment + 16 - LIVE)
    assert item["task"] == buffer.goal and item["condition"] == condition


@pytest.mark.slow
def test_the_evidence_of_each_memory_frame(make: Make, buffers: Path) -> None:
    item = make(["k3"], memory="full")[0]
    buffer = load_buffer(QUERIES[0], "k3", buffer_set=buffers)
    assert buffer.evidence
    for one in buffer.evidence:
        shown = item["memory.evidence"][:, one.span.part]
        assert shown[one.start : one.stop].all()
    shown = sum(one.stop - one.start for one in buffer.evidence)
    assert int(item["memory.evidence"].sum()) == shown and bool(item["evidence_known"])


def test_without_actions_an_item_is_the_first_live_view(make: Make, buffers: Path) -> None:
    data = make(["k1"], chunk=0, image_size=None)
    assert len(data) == 3 and "action" not in data[0]
    for number, episode in enumerate(data.episode_ids):
        view = load_buffer_set(buffers).query(episode).frame()
        expected = view.transpose(2, 0, 1)
        np.testing.assert_array_equal(data[number]["observation.images.front"], expected)
    acting = make(["k1"], image_size=None)
    np.testing.assert_array_equal(
        data[2]["observation.images.front"],
        acting[acting.index_of(data.episode_ids[2])]["observation.images.front"],
    )


def test_a_retrieval_step_chooses_as_in_evaluation(make: Make, buffers: Path) -> None:
    item = make(["k3"], memory="full", retrieval="thumbnail", chunk=0)[1]
    buffer = load_buffer_set(buffers).load(item["episode_id"], "k3")
    chosen = Selector("thumbnail").select(buffer, buffer.query.frame())
    assert int(item["position"]) == len(chosen) < len(buffer)
    frames = resize(buffer.frames()[chosen], 16)
    np.testing.assert_array_equal(item["memory.images.front"][: len(chosen)], frames)
    other = make(["k3"], memory="full", retrieval="thumbnail", retrieval_rule="last", chunk=0)[1]
    rule = Selector("thumbnail", rule="last").rule
    last = choose(measure(buffer, "thumbnail"), rule).frames
    assert int(other["position"]) == len(last)


def test_views_under_shifts(make: Make, buffers: Path) -> None:
    """The sample's n-th shift divides its colors by 2 to the n."""
    data = make(["k0"], chunk=0, image_size=None, shifts={str(SHIFTS[2]): 1})
    view = load_buffer_set(buffers).query(QUERIES[0]).frame()
    item = data[data.index_of(QUERIES[0])]
    assert item["shift"] == str(SHIFTS[2])
    np.testing.assert_array_equal(item["observation.images.front"], view.transpose(2, 0, 1) >> 2)


@pytest.mark.slow
def test_questions_as_tensors(tmp_path: Path) -> None:
    options: dict[str, Any] = {"chunk": 0, "questions": True, "cache": tmp_path, "quiet": True}
    data = HistoryDataset(TABLETOP, ["k0"], image_size=8, **options)
    questions = read_questions(load_buffer_set(TABLETOP))
    for number, episode in enumerate(data.episode_ids):
        item, question = data[number], questions[episode]
        count = len(question.options)
        assert int(item["question.answer"]) == question.right
        assert item["question.option_is_pad"].tolist() == [
            place >= count for place in range(len(item["question.options"]))
        ]
        points = (~item["question.point_is_pad"]).sum(1)[:count].tolist()
        assert points == [len(one) for one in question.pixels]
        if question.pixels[0]:
            y, x = question.pixels[0][0]
            expected = [(y + 0.5) / 256, (x + 0.5) / 256]
            np.testing.assert_allclose(item["question.points"][0, 0], expected, rtol=1e-6)


def same(batch: dict[str, Any], collated: dict[str, Any]) -> None:
    """Check that two batches have the same entries; texts may be in tuples or lists."""
    assert batch.keys() == collated.keys()
    for name, values in batch.items():
        if isinstance(values, torch.Tensor):
            torch.testing.assert_close(values, collated[name], rtol=0, atol=0)
        elif name == "question.options":
            assert [*map(list, values)] == [*map(list, collated[name])]
        else:
            assert values == list(collated[name])


@pytest.mark.parametrize("memory", ["framesamp:8", "window:5", "full"])
def test_a_batch_is_the_collated_items(memory: str, make: Make) -> None:
    data = make({"no-history": 1, "k0": 1, "k3": 1}, memory=memory)
    indices = [5, 0, 5, 2 * LIVE, LIVE - 1, *range(90, 99), -1]
    collated = default_collate([data[index] for index in indices])
    assert {*collated["condition"]} == {"no-history", "k0", "k3"}
    same(data[indices], collated)
    sampler = torch.utils.data.BatchSampler(indices, 6, drop_last=False)
    loader = torch.utils.data.DataLoader(data, None, sampler=sampler, num_workers=2)
    for batch, chosen in zip(loader, sampler, strict=True):
        same(batch, data[chosen])
    with raises(IndexError):
        data[[0, 3 * LIVE]]


@pytest.mark.slow
def test_a_batch_of_questions_and_shifts(make: Make, tmp_path: Path) -> None:
    options: dict[str, Any] = {"chunk": 0, "questions": True, "cache": tmp_path, "quiet": True}
    asked = HistoryDataset(TABLETOP, ["k0"], image_size=8, **options)
    shifted = make(["k0"], chunk=0, shifts={"none": 1, str(SHIFTS[2]): 1}, seed=3)
    assert len({shifted[index]["shift"] for index in range(3)}) == 2
    for data in (asked, shifted):
        every = [*range(len(data))]
        same(data[every], default_collate([data[index] for index in every]))


# --- draws -------------------------------------------------------------------------------------


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
def test_spawned_workers_open_the_same_items(make: Make) -> None:
    data = make({"k0": 1, "k3": 1}, chunk=0)
    loader = torch.utils.data.DataLoader(
        data, num_workers=1, batch_size=None, multiprocessing_context="spawn"
    )
    for index, item in enumerate(loader):
        assert item["condition"] == data[index]["condition"]
        assert torch.equal(item["memory.images.front"], data[index]["memory.images.front"])


def test_a_buffer_set_that_changed_is_an_error_of_its_items(
    executed_buffers: Path, tmp_path: Path
) -> None:
    root = copy_buffer_set(tmp_path / "buffers", executed_buffers)
    data = HistoryDataset(root, ["k0"], chunk=0, cache=tmp_path / "cache", quiet=True)
    same = pickle.dumps(data)
    assert pickle.loads(same)[0]["episode_id"] == data[0]["episode_id"]
    plan_again(root, ["k0", "k1"])
    with raises(HashMismatchError):
        pickle.loads(same)[0]


@pytest.mark.slow
def test_a_spawned_worker_reports_a_changed_set(executed_buffers: Path, tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "buffers", executed_buffers)
    data = HistoryDataset(root, ["k0"], chunk=0, cache=tmp_path / "cache", quiet=True)
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


def test_only_the_videos_in_use_are_downloaded(hub: HubServer, tmp_path: Path) -> None:
    push_buffer_set(hub, GOLDEN, tmp_path / "work")
    options: dict[str, Any] = {"chunk": 0, "cache": tmp_path / "cache", "quiet": True}
    data = HistoryDataset(BUFFER_SET, ["k1"], families=["MoveCube"], **options)
    assert len(data) == 1
    videos = [path for path in hub.downloads() if path.startswith("videos/")]
    assert len(videos) == 2 and not any("wrist" in path for path in videos)


# --- what it refuses ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"conditions": {"k0": 0}}, InvalidOptionError),
        ({"conditions": {"k0": -1}}, InvalidOptionError),
        ({"conditions": {"k0": float("nan")}}, InvalidOptionError),
        ({"conditions": []}, InvalidOptionError),
        ({"conditions": ["k5"]}, UnknownNameError),
        ({"memory": "framesamp:1"}, InvalidOptionError),
        ({"memory": "full:9"}, InvalidOptionError),
        ({"memory": "sometimes"}, UnknownNameError),
        ({"cameras": ["side"]}, UnknownNameError),
        ({"cameras": "front"}, InvalidOptionError),
        ({"families": "MoveCube"}, InvalidOptionError),
        ({"image_size": 33}, InvalidOptionError),
        ({"image_size": 0}, InvalidOptionError),
        ({"chunk": -1}, InvalidOptionError),
        ({"families": ["RouteStick"]}, UnknownNameError),
        ({"episodes": "7"}, InvalidOptionError),
        ({"unit_episodes": "0"}, InvalidOptionError),
        ({"retrieval_rule": "mean"}, InvalidOptionError),
        ({"retrieval_camera": "wrist"}, InvalidOptionError),
        ({"shifts": {"light:1": 1}}, InvalidOptionError),
        ({"questions": True}, MissingFileError),
        ({"conditions": ["raw-k1"], "redraw": True}, MissingFileError),
        ({"memory": "full", "redraw": True}, InvalidOptionError),
        ({"cache": False}, InvalidOptionError),
    ],
)
def test_bad_input(options: dict[str, Any], error: type[Exception], make: Make) -> None:
    with raises(error):
        make(**options)


def test_a_buffer_set_without_executions(tiny_buffers: Path, tmp_path: Path) -> None:
    with raises(MissingFileError) as raised:
        HistoryDataset(tiny_buffers, ["k0"], cache=tmp_path)
    assert raised.value.command == f"build {tiny_buffers} --only executions --source KIND:PATH"
    assert HistoryDataset(tiny_buffers, ["k0"], chunk=0, cache=tmp_path, quiet=True)[0]


@pytest.mark.slow
def test_manifests_planned_before_the_executions(executed_buffers: Path, tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "buffers", executed_buffers)
    shutil.copytree(GOLDEN / MANIFESTS, root / MANIFESTS, dirs_exist_ok=True)
    with pytest.raises(MissingFileError) as caught:
        HistoryDataset(root, ["k0"], cache=tmp_path)
    assert str(caught.value.command).endswith("--only manifests")
    plan_again(root)
    assert len(HistoryDataset(root, ["k0"], cache=tmp_path, quiet=True)) == 3 * LIVE
