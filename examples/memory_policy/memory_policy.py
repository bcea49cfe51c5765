"""The trained policy in rollouts: `evaluate --policy python:memory_policy:MemoryPolicy`.

PYTHONPATH=examples/memory_policy robomme-interference evaluate my-buffers \
      --policy python:memory_policy:MemoryPolicy --policy-option checkpoint=runs/acts \
      --system learned --out results/learned
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from command_line import default_device
from memory_model import load_checkpoint, on_device
from numpy.typing import NDArray

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate import Observation, Policy, RolloutInfo
from robomme_interference_data.storage.files import sha256_file
from robomme_interference_data.training import Memory, resize


class MemoryPolicy(Policy):
    """Keeps all frames, resized, and acts on those that its memory rule selects.

    Args:
        checkpoint: Folder of a run of `train.py --task act`.
        device: Device to compute on; None for a GPU if there is one.
    """

    every_frame = True  # in training, memory has every live frame

    def __init__(self, checkpoint: str, device: str | None = None):
        self._folder = Path(checkpoint)
        self._device = device or default_device()
        self._model = load_checkpoint(self._folder, self._device)
        self.config = self._model.config
        if self.config.task != "act":
            raise InvalidOptionError(f"{checkpoint} was trained to answer; expected --task act.")
        self.cameras = self.history_cameras = self.config.cameras
        self._memory = Memory.parse(self.config.memory)
        self.memory = str(self._memory)

    def reset(self, info: RolloutInfo) -> None:
        """Clear the memory."""
        self._frames: dict[str, list[NDArray[Any]]] = {name: [] for name in self.cameras}
        self._states: list[NDArray[Any]] = []

    def add_history(
        self,
        frames: Mapping[str, NDArray[np.uint8]],
        states: NDArray[np.float32],
        exec_start_idx: int,
    ) -> None:
        """Store frames; the memory rule selects from them when the policy acts."""
        self.observe(frames, states)

    def observe(self, frames: Mapping[str, NDArray[np.uint8]], states: NDArray[np.float32]) -> None:
        """Store live frames, which are history of later ones."""
        for name in self.cameras:
            self._frames[name].extend(resize(frames[name], self.config.image_size))
        self._states.extend(np.array(states))

    def batch(self, goal: str) -> dict[str, Any]:
        """Return a batch of one: what `HistoryDataset` gives here, without places for padding."""
        live = len(self._states) - 1
        kept = [*self._memory.earlier(live)]
        batch: dict[str, Any] = {"task": [goal], "position": torch.tensor([live])}
        batch["memory.position"] = torch.tensor([kept], dtype=torch.int64)
        batch["memory.is_pad"] = torch.zeros(1, len(kept), dtype=torch.bool)
        images = {f"images.{camera}": frames for camera, frames in self._frames.items()}
        for name, values in {"state": self._states, **images}.items():
            frames = torch.from_numpy(np.stack([values[at] for at in (*kept, live)]))
            batch[f"memory.{name}"] = frames[None, :-1]
            batch[f"observation.{name}"] = frames[-1:]
        return batch

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the next chunk of actions, `(chunk, A) float32`."""
        batch = on_device(self.batch(goal), self._device)
        with torch.inference_mode():
            actions: NDArray[np.float32] = self._model(batch)[0].cpu().numpy()
        if self.config.targets_are_states:
            actions[:, -1] = np.sign(actions[:, -1])  # the gripper closes or opens
        return actions

    def metadata(self) -> dict[str, Any]:
        """Return what identifies the policy."""
        weights = sha256_file(self._folder / "model.safetensors")
        return {
            "policy": "memory_policy",
            "weights_sha256": weights,
            "training_seed": self.config.seed,
            **vars(self.config),
        }
