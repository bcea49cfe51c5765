"""Epochs of loaders: with the sampler each has draws of its own; without one, repeats warn."""

import warnings
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from accelerate import Accelerator
from accelerate.data_loader import prepare_data_loader
from support.messages import raises
from torch.utils.data import DataLoader

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.training import HistoryDataset, HistorySampler

Make = Callable[..., HistoryDataset]
Draws = dict[int, str]

CONDITIONS = {"k0": 1, "k3": 1}


@pytest.fixture(scope="module")
def data(make: Make) -> HistoryDataset:
    return make(CONDITIONS, families=["MoveCube"], memory="framesamp:3", image_size=4)


def drawn(loader: Any) -> list[tuple[int, str]]:
    """The items of an iteration in order, with their conditions."""
    return [
        pair
        for batch in loader
        for pair in zip(batch["index"].tolist(), batch["condition"], strict=True)
    ]


def expected(data: HistoryDataset, epoch: int) -> Draws:
    data.set_epoch(epoch)
    batch = data[:]
    return dict(zip(batch["index"].tolist(), batch["condition"], strict=True))


@pytest.mark.parametrize(("workers", "persistent"), [(0, False), (2, False), (2, True)])
def test_each_epoch_has_its_own_order_and_draws(
    workers: int, persistent: bool, data: HistoryDataset
) -> None:
    loader = DataLoader(
        data, 50, sampler=HistorySampler(data), num_workers=workers, persistent_workers=persistent
    )
    with warnings.catch_warnings(action="error", category=UserWarning):
        epochs = [drawn(loader) for _ in range(3)]
    for number, epoch in enumerate(epochs):
        assert dict(epoch) == expected(data, number) and len(epoch) == len(data)
    assert len({tuple(index for index, _ in epoch) for epoch in epochs}) == 3
    assert dict(epochs[0]) != dict(epochs[1])


def test_an_epoch_resumes_inside(data: HistoryDataset) -> None:
    sampler = HistorySampler(data, seed=7)
    epochs = [drawn(DataLoader(data, 50, sampler=sampler)) for _ in range(2)]
    again = HistorySampler(data, seed=7)
    again.load_state_dict({"epoch": 1, "start_index": 100})
    assert drawn(DataLoader(data, 50, sampler=again)) == epochs[1][100:]
    assert again.state_dict() == sampler.state_dict() == {"epoch": 2, "start_index": 0}
    assert [*HistorySampler(data, seed=8)] != [index for index, _ in epochs[0]]


def test_weights_by_hand(data: HistoryDataset) -> None:
    """No items but those of a few moments, one of them three times as often as another."""
    weights = np.where(data.values("frame_index") < 2, 0.0, 1.0)
    weights[10:], weights[5] = 0, 3
    sampler = HistorySampler(data, weights)
    counts = Counter(index for _ in range(20) for index in sampler)
    assert {*counts} == {*range(2, 10)} and counts.total() == 20 * len(data) == 4240
    assert abs(counts[5] / 4240 - 3 / 10) < 6 * (0.3 * 0.7 / 4240) ** 0.5
    assert abs(counts[2] / 4240 - 1 / 10) < 6 * (0.1 * 0.9 / 4240) ** 0.5


@pytest.mark.parametrize("weights", [[1.0], [-1, 2], [0, 0], [float("nan"), 1]])
def test_bad_weights(weights: list[float], data: HistoryDataset) -> None:
    given = weights if len(weights) == 1 else np.resize(weights, len(data))
    with raises(InvalidOptionError):
        HistorySampler(data, given)


def test_accelerate_begins_each_epoch(data: HistoryDataset) -> None:
    """Also one that resumes: accelerate counts epochs from 0, the sampler has its own."""
    sampler = HistorySampler(data)
    sampler.load_state_dict({"epoch": 4, "start_index": 0})
    loader = Accelerator(cpu=True).prepare(DataLoader(data, 50, sampler=sampler))
    epochs = [drawn(loader) for _ in range(2)]
    assert [dict(epoch) for epoch in epochs] == [expected(data, 4), expected(data, 5)]


def test_accelerate_divides_an_epoch_among_ranks(data: HistoryDataset) -> None:
    """No item is taken twice, and its condition is the one that it has without ranks."""
    epochs: list[list[list[tuple[int, str]]]] = []
    for rank in range(2):
        loader = DataLoader(data, len(data) // 4, sampler=HistorySampler(data))
        share = prepare_data_loader(
            loader, num_processes=2, process_index=rank, put_on_device=False
        )
        epochs.append([drawn(share) for _ in range(2)])
    for number, (first, second) in enumerate(zip(*epochs, strict=True)):
        assert len(first) == len(second) == len(data) // 2
        assert dict(first) | dict(second) == expected(data, number)


def test_items_taken_again_warn_once(make: Make, data: HistoryDataset) -> None:
    data.set_epoch(0)
    loader = DataLoader(data, 50, shuffle=True)
    with warnings.catch_warnings(action="error", category=UserWarning):
        drawn(loader)
    with pytest.warns(UserWarning, match="HistorySampler"):
        drawn(loader)
    with warnings.catch_warnings(action="error", category=UserWarning):
        drawn(loader)
        for epoch in range(3):
            data.set_epoch(epoch)
            drawn(loader)
        # With one condition, all epochs are the same.
        one = make(["k0"], chunk=0)
        for _ in range(5):
            drawn(DataLoader(one, 3))


def test_a_rank_takes_its_share(data: HistoryDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "4")
    data.set_epoch(0)
    share = DataLoader(data, 50, sampler=range(0, len(data), 4))
    drawn(share)
    with pytest.warns(UserWarning, match="again"):
        drawn(share)


def test_workers_count_together(data: HistoryDataset) -> None:
    def warnings_are_errors(worker: int) -> None:
        warnings.simplefilter("error", UserWarning)

    data.set_epoch(0)
    loader = DataLoader(data, 50, num_workers=2, worker_init_fn=warnings_are_errors)
    drawn(loader)
    with pytest.raises(UserWarning, match="HistorySampler"):
        drawn(loader)
