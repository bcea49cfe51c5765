"""The epoch of a dataset, in the process that trains and in those of its loaders."""

import os
import warnings

import torch


class Epoch:
    """The epoch that draws depend on, and how many items loaders have taken since it was set.

    Both are in memory that all processes share: those of a loader have copies of the dataset.

    Attributes:
        items: Items of an epoch.
        draws: Whether an item is another one in another epoch.
    """

    def __init__(self, items: int, *, draws: bool):
        self.items, self.draws = items, draws
        self._shared = torch.zeros(2, dtype=torch.int64).share_memory_()  # type: ignore[no-untyped-call]

    @property
    def number(self) -> int:
        """The epoch, from 0."""
        return int(self._shared[0])

    def set(self, number: int) -> None:
        """Begin an epoch."""
        self._shared[0], self._shared[1] = number, 0

    def count(self, taken: int) -> None:
        """Count items that a loader takes; warn when it takes those of an epoch a second time."""
        before = int(self._shared[1])
        self._shared[1] += taken
        ranks = int(os.environ.get("WORLD_SIZE", "1"))  # set by torchrun and accelerate
        # Half an epoch more: a last batch or rank may be filled up with items that repeat.
        limit = 1.5 * self.items / ranks
        if self.draws and before <= limit < before + taken:
            warnings.warn(
                f"A loader takes the items of epoch {self.number} again, with the same conditions. "
                "Give it sampler=HistorySampler(data), or call data.set_epoch(epoch) before each "
                "epoch.",
                stacklevel=3,
            )
