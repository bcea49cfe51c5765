"""Items of `HistoryDataset`: frames of the right history, draws, and what it refuses."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.buffer_sets import GOLDEN, QUERIES, copy_buffer_set, plan_again
from support.messages import raises
from support.tabletop import TABLETOP
from torch.utils.data import default_collate

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.constants import EXECUTIONS, MANIFESTS, STATE
from robomme_interference_data.data.questions import read_questions
from robomme_interference_data.errors import InvalidOptionError, MissingFileError, UnknownNameError
from robomme_interference_data.retrieval.measure import measure
from robomme_interference_data.retrieval.select import choose
from robomme_interference_data.retrieval.selector import Selector
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.schema.shifts import SHIFTS
from robomme_interference_data.training import HistoryDataset, resize

LIVE = 260 - 48
"""Frames of a sample episode after its lesson."""

Make = Callable[..., HistoryDataset]


# --- what an item holds ------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("memory", ["framesamp:8", "window:2@2.5", "full"])
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


def with_questions(cache: Path) -> HistoryDataset:
    return HistoryDataset(
        TABLETOP,
        ["k0"],
        split="test",
        image_size=8,
        chunk=0,
        questions=True,
        cache=cache,
        quiet=True,
    )


@pytest.mark.slow
def test_questions_as_tensors(tmp_path: Path) -> None:
    data = with_questions(tmp_path)
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


@pytest.mark.parametrize("memory", ["framesamp:8", "window:2@2.5", "full"])
def test_a_batch_is_the_collated_items(memory: str, make: Make) -> None:
    data = make({"no-history": 1, "k0": 1, "k3": 1}, memory=memory)
    indices = [5, 0, 5, 2 * LIVE, LIVE - 1, *range(90, 99), -1]
    collated = default_collate([data[index] for index in indices])
    assert {*collated["condition"]} == {"no-history", "k0", "k3"}
    same(data[indices], collated)
    with raises(IndexError):
        data[[0, 3 * LIVE]]


def test_loaders_get_whole_batches(make: Make) -> None:
    data = make({"no-history": 1, "k0": 1, "k3": 1}, memory="framesamp:8")
    indices = [5, 0, 5, 2 * LIVE, LIVE - 1, *range(90, 99), -1]
    for workers in (0, 2):
        loader = torch.utils.data.DataLoader(data, 6, sampler=indices, num_workers=workers)
        for number, batch in enumerate(loader):
            same(batch, data[indices[6 * number : 6 * number + 6]])
    part = torch.utils.data.Subset(data, indices)
    [batch] = torch.utils.data.DataLoader(part, len(indices))
    same(batch, data[indices])
    # A collation of one's own gets items, as many as it likes.
    own = torch.utils.data.DataLoader(data, 4, sampler=indices, collate_fn=list)
    items = [item for batch in own for item in batch]
    same(default_collate(items[:3]), data[indices[:3]])
    assert len(items) == len(indices) and items[-1]["index"] == len(data) - 1


def test_kinds_of_indices(make: Make) -> None:
    data = make({"k0": 1, "k3": 1}, chunk=0)
    whole = data[[0, 1, 2]]
    several = (slice(None), (0, 1, 2), np.arange(3), torch.arange(3), range(3), data[:]["index"])
    for index in several:
        same(data[index], whole)
    for index in (2, -1, np.int64(2), np.array(2), torch.tensor(2)):
        assert data[index]["episode_id"] == whole["episode_id"][2]
    same(data[::2], data[[0, 2]])
    same(data[torch.tensor([1])], data[[1]])
    for wrong in ([], [0.5], 0.5, torch.tensor([True, False, True]), [[0]], "1", 3, -4):
        with raises(IndexError):
            data[wrong]


def test_episodes_of_one_split(make: Make, buffers: Path) -> None:
    """The golden buffer set has test episodes; no other is trained on unless it is named."""
    assert {one.split for one in make(["k0"]).episode_ids} == {"test"}
    for split in ("train", "trian"):
        with raises(InvalidOptionError) as raised:
            HistoryDataset(buffers, ["k0"], **({} if split == "train" else {"split": split}))
        assert raised.value.option == "split" and "'test'" in str(raised.value)


@pytest.mark.slow
def test_a_batch_of_questions_and_shifts(make: Make, tmp_path: Path) -> None:
    asked = with_questions(tmp_path)
    shifted = make(["k0"], chunk=0, shifts={"none": 1, str(SHIFTS[2]): 1}, seed=3)
    assert len({shifted[index]["shift"] for index in range(3)}) == 2
    for data in (asked, shifted):
        every = [*range(len(data))]
        same(data[every], default_collate([data[index] for index in every]))


def test_values_of_all_moments(make: Make) -> None:
    data = make(["k0"])
    batch = data[[0, LIVE, 3 * LIVE - 1]]
    assert data.values("action").shape == (3 * LIVE, 8)
    for name in ("observation.state", "frame_index", "episode_id"):
        np.testing.assert_array_equal(data.values(name)[[0, LIVE, -1]], np.asarray(batch[name]))
    np.testing.assert_array_equal(data.values("action")[[0, LIVE, -1]], batch["action"][:, 0])
    with raises(UnknownNameError):
        make(["k0"], chunk=0).values("action")


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
    assert HistoryDataset(tiny_buffers, ["k0"], split="test", chunk=0, cache=tmp_path, quiet=True)[
        0
    ]


@pytest.mark.slow
def test_manifests_planned_before_the_executions(executed_buffers: Path, tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "buffers", executed_buffers)
    shutil.copytree(GOLDEN / MANIFESTS, root / MANIFESTS, dirs_exist_ok=True)
    with pytest.raises(MissingFileError) as caught:
        HistoryDataset(root, ["k0"], split="test", cache=tmp_path)
    assert str(caught.value.command).endswith("--only manifests")
    plan_again(root)
    assert len(HistoryDataset(root, ["k0"], split="test", cache=tmp_path, quiet=True)) == 3 * LIVE
