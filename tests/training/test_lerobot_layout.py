"""The layout `lerobot`: names, statistics, and images that change alike."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from support.messages import raises

from robomme_interference_data import load_buffer_set
from robomme_interference_data.constants import ACTION, FRONT, STATE
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.training import HistoryDataset

Make = Callable[..., HistoryDataset]
MEMORY_IMAGES, MEMORY_STATE = "observation.memory.images.front", "observation.memory.state"


def test_what_a_policy_may_see_is_below_observation(make: Make) -> None:
    plain, named = make(["k3"]), make(["k3"], layout="lerobot")
    for index in (5, [5, 0]):
        before, after = plain[index], named[index]
        assert {*after} == {
            *(FRONT, STATE, "observation.position", MEMORY_IMAGES, MEMORY_STATE),
            *("observation.memory.position", "observation.memory.padding"),
            *(ACTION, "action_is_pad", "task", "index", "frame_index"),
            *(f"label.{name}" for name in ("evidence", "evidence_known", "condition", "shift")),
            "label.episode_id",
        }
        for name in (FRONT, STATE, ACTION, "index"):
            assert torch.equal(before[name], after[name])
        assert torch.equal(before["memory.images.front"], after[MEMORY_IMAGES])
        assert torch.equal(before["memory.is_pad"], after["observation.memory.padding"])
        assert torch.equal(before["position"], after["observation.position"])
        assert before["condition"] == after["label.condition"]
    loader = torch.utils.data.DataLoader(named, 3)
    assert next(iter(loader))[MEMORY_IMAGES].shape == (3, 31, 3, 16, 16)


def test_lerobots_processors_keep_the_memory_and_drop_the_labels(make: Make) -> None:
    converters = pytest.importorskip("lerobot.processor.converters")
    batch = make(["k3"], layout="lerobot")[[0, 5]]
    kept = converters.transition_to_batch(converters.batch_to_transition(batch))
    assert {name for name in batch if name not in kept} == {
        name for name in batch if name.startswith("label.") or name == "frame_index"
    }


def test_meta_describes_the_items(make: Make, buffers: Path) -> None:
    data = make(["k0", "k3"], layout="lerobot", memory="framesamp:4")
    meta, buffer_set = data.meta, load_buffer_set(buffers)
    assert {name: feature["shape"] for name, feature in meta.features.items()} == {
        **{FRONT: (16, 16, 3), MEMORY_IMAGES: (16, 16, 3)},
        **{STATE: (8,), MEMORY_STATE: (8,), ACTION: (8,)},
    }
    assert (meta.camera_keys, meta.fps) == ([FRONT, MEMORY_IMAGES], 10)
    assert (data.num_frames, data.num_episodes) == (len(data), 3)
    assert [*zip(meta.episodes["dataset_from_index"], meta.episodes["tasks"], strict=True)] == [
        (data.index_of(episode), [buffer_set.query(episode).goal]) for episode in data.episode_ids
    ]
    assert meta.total_frames == sum(meta.episodes["length"]) == len(data)
    # All states of the sessions of k3, which are those of k0 and more, and of the executions.
    sessions = {
        (session.dataset, session.episode_index, session.start, session.stop)
        for manifest in buffer_set.manifests(condition="k3")
        for session in manifest.sessions
    }
    states = [
        buffer_set.datasets[name].read_vectors(episode, STATE, start, stop)
        for name, episode, start, stop in sessions
    ]
    live = buffer_set.datasets["executions"]
    rows = [(record.episode_index, STATE, 0, record.length) for record in live.records()]
    expected = np.concatenate([*states, *(live.read_vectors(*row) for row in rows)])
    for name in (STATE, MEMORY_STATE):
        np.testing.assert_allclose(meta.stats[name]["mean"], expected.mean(0), rtol=1e-5)
        np.testing.assert_allclose(meta.stats[name]["std"], expected.std(0), rtol=1e-4)
        assert meta.stats[name]["count"] == len(expected)
    # All images have the same number of pixels, from 0 to 1.
    images = data.stored_values(FRONT, 256)
    for name in (FRONT, MEMORY_IMAGES):
        pixels = images[:, :, ::4, ::4].mean((0, 2, 3)) / 255
        np.testing.assert_allclose(meta.stats[name]["mean"].ravel(), pixels)
    # LeRobot replaces those of cameras one by one.
    assert meta.stats[FRONT] is not meta.stats[MEMORY_IMAGES]
    with raises(InvalidOptionError) as error:
        _ = make(["k0"], layout="lerobot", chunk=0).meta
    assert error.value.option == "chunk"
    with raises(InvalidOptionError) as error:
        make(["k0"], layout="lerobt")
    assert error.value.option == "layout"


def test_images_of_an_item_change_alike(make: Make) -> None:
    """Brightness drawn at random: the same for the memory and now, in every process, each epoch."""

    def darker(images: torch.Tensor) -> torch.Tensor:
        return images * torch.rand(())

    plain, changed = make(["k3"]), make(["k3"], image_transforms=darker)
    before, state = plain[[0, 5]], torch.get_rng_state()
    after = changed[[0, 5]]
    assert torch.equal(state, torch.get_rng_state())
    factors = []
    for place in range(2):
        now, memory = before[FRONT][place], before["memory.images.front"][place]
        factor = after[FRONT][place].sum() / now.sum()
        for found, given_ in ((after[FRONT], now), (after["memory.images.front"], memory)):
            assert (found[place] - given_ * factor).abs().max() < 2
        factors.append(round(factor.item(), 2))
    assert factors[0] != factors[1]
    assert torch.equal(changed[5][FRONT], after[FRONT][1])
    changed.set_epoch(1)
    assert not torch.equal(changed[5][FRONT], after[FRONT][1])
