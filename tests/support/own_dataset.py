"""A user's own PyTorch dataset, in a module that the workers of a loader can import."""

from pathlib import Path

import numpy as np
import torch

from robomme_interference_data import load_buffer_set


class BuffersDataset(torch.utils.data.Dataset[torch.Tensor]):
    """The first states of the buffers of `k1`, and of one that was loaded before."""

    def __init__(self, root: Path):
        self.set = load_buffer_set(root)
        self.buffer = next(self.set.buffers(condition="k1"))
        self.keys = [(one.episode_id, one.condition) for one in self.set.manifests(condition="k1")]

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, index: int) -> torch.Tensor:
        states = self.set.load(*self.keys[index]).states[:4]
        return torch.from_numpy(np.stack([states, self.buffer.states[:4]]))
