"""The order of items in an epoch, and the epoch that all draws depend on."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Sampler

from robomme_interference_data.errors import InvalidOptionError

from .draws import number_from

if TYPE_CHECKING:
    from .history_dataset import HistoryDataset


class HistorySampler(Sampler[int]):
    """The items of an epoch in an order that is drawn: `DataLoader(data, 64, sampler=…)`.

    Each iteration is the next epoch, also for the draws of the dataset: it sets `data.epoch`. The
    order follows from `seed` and the epoch, so that all ranks have the same one, to be divided
    among them by accelerate.

    Args:
        data: The dataset.
        weights: Weight of each item, `(len(data),)`, 0 or more, such as from `data.values`: as many
            items as there are, drawn with these weights, may repeat. None for each item once.
        seed: Seed of the order.

    Raises:
        InvalidOptionError: The weights are not one finite number from 0 for each item, or all 0.
    """

    def __init__(
        self,
        data: "HistoryDataset",
        weights: "Sequence[float] | NDArray[np.floating] | torch.Tensor | None" = None,
        *,
        seed: int = 0,
    ):
        self._data, self._seed = data, seed
        self._epoch, self._start = 0, 0
        self._sums: NDArray[np.float64] | None = None
        if weights is not None:
            given = np.asarray(weights, np.float64)
            if given.shape != (len(data),) or not (
                np.isfinite(given).all() and given.min() >= 0 and given.any()
            ):
                raise InvalidOptionError.expected(
                    "weights",
                    f"of shape {given.shape}",
                    f"{len(data)} finite numbers from 0, one for each item, and not only zeros",
                )
            self._sums = np.cumsum(given) / given.sum()

    def __len__(self) -> int:
        """Return the number of items of an epoch."""
        return len(self._data)

    def __iter__(self) -> Iterator[int]:
        epoch, start = self._epoch, self._start
        self._epoch, self._start = epoch + 1, 0
        self._data.set_epoch(epoch)
        return iter(self._order(epoch)[start:])

    def state_dict(self) -> dict[str, int]:
        """Return the epoch of the next iteration, and how many of its items it leaves out."""
        return {"epoch": self._epoch, "start_index": self._start}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Let the next iteration begin inside an epoch, to resume; see `state_dict`."""
        self._epoch, self._start = state["epoch"], state["start_index"]

    def _order(self, epoch: int) -> list[int]:
        """Return the items of an epoch."""
        # A generator of PyTorch takes 63 bits.
        seed = number_from("order", self._seed, epoch) >> 1
        generator = torch.Generator().manual_seed(seed)
        if self._sums is None:
            order: list[int] = torch.randperm(len(self), generator=generator).tolist()
            return order
        lots = torch.rand(len(self), dtype=torch.float64, generator=generator).numpy()
        # Rounding may leave the last sum just below 1; items of weight 0 after it stay out.
        last = int(self._sums.searchsorted(self._sums[-1]))
        return np.minimum(self._sums.searchsorted(lots, "right"), last).tolist()
