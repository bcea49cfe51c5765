"""What a LeRobot policy gets of a rollout: its last observations, or one with a memory."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from robomme_interference_data.constants import CAMERA_PREFIX, STATE
from robomme_interference_data.schema.memory_features import (
    MEMORY_PADDING,
    MEMORY_POSITION,
    POSITION,
    in_memory,
)
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.storage.resize import resize


class Observations(Protocol):
    """Frames of a rollout, which become observations as LeRobot's processors take them."""

    def clear(self) -> None:
        """Forget everything, when a rollout begins."""

    def add(self, frames: Mapping[str, NDArray[np.uint8]], states: NDArray[np.float32]) -> None:
        """Keep frames, of the history or live."""

    def current(self) -> list[dict[str, Any]]:
        """Return the observations on which the policy acts, the newest last, as batches of one."""

    def acted(self) -> None:
        """Forget what is no longer needed once the policy has acted."""


class LastObservations:
    """The last few observations; a policy that acted has them in a queue of its own.

    Args:
        cameras: Cameras that the policy reads.
        count: Observations on which the policy acts.
    """

    def __init__(self, cameras: Sequence[str], count: int):
        self._cameras, self._count = cameras, count
        self._recent: deque[dict[str, Any]] = deque(maxlen=count)

    def clear(self) -> None:
        """Forget everything."""
        self._recent.clear()

    def add(self, frames: Mapping[str, NDArray[np.uint8]], states: NDArray[np.float32]) -> None:
        """Keep the last few frames, with images from 0 to 1."""
        for index in range(max(0, len(states) - self._count), len(states)):
            seen: dict[str, Any] = {STATE: torch.from_numpy(np.array(states[index], np.float32))}
            for camera in self._cameras:
                image = torch.from_numpy(frames[camera][index].copy()).permute(2, 0, 1)
                seen[CAMERA_PREFIX + camera] = _from_0_to_1(image).contiguous()
            self._recent.append({name: value[None] for name, value in seen.items()})

    def current(self) -> list[dict[str, Any]]:
        """Return the observations since the policy acted, at most so many."""
        return list(self._recent)

    def acted(self) -> None:
        """Forget them: the policy's queue has them."""
        self._recent.clear()


class ObservationWithMemory:
    """The newest observation, and the memory that a rule keeps of all frames before it.

    Its values are those of an item of `HistoryDataset(layout="lerobot")` at this moment.

    Args:
        cameras: Cameras that the policy reads.
        memory: Rule by which frames are kept.
        image_size: Side of all images in pixels; None for no change of size.
    """

    def __init__(self, cameras: Sequence[str], memory: Memory, image_size: int | None):
        self._cameras, self._memory, self._size = cameras, memory, image_size
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._states: list[NDArray[np.float32]] = []
        self._images: dict[str, list[NDArray[np.uint8]]] = {name: [] for name in self._cameras}

    def add(self, frames: Mapping[str, NDArray[np.uint8]], states: NDArray[np.float32]) -> None:
        """Keep all frames: a rule may select any of them later."""
        self._states.extend(np.array(states, np.float32))
        for camera, images in self._images.items():
            images.extend(resize(frames[camera], self._size))

    def current(self) -> list[dict[str, Any]]:
        """Return the newest observation with its memory of M places.

        M is the same at every step, with padding, unless the memory is `full`.
        """
        live = len(self._states) - 1
        kept = [*self._memory.earlier(live)]
        places = len(kept) if self._memory.rule == "full" else self._memory.frames - 1
        position = torch.zeros(places, dtype=torch.int64)
        position[: len(kept)] = torch.tensor(kept, dtype=torch.int64)
        seen = {
            POSITION: torch.tensor(live),
            MEMORY_POSITION: position,
            MEMORY_PADDING: torch.arange(places) >= len(kept),
            STATE: torch.from_numpy(self._states[live]),
            in_memory(STATE): _padded(self._states, kept, places),
        }
        for camera, images in self._images.items():
            name = CAMERA_PREFIX + camera
            seen[name] = _from_0_to_1(torch.from_numpy(images[live]))
            seen[in_memory(name)] = _from_0_to_1(_padded(images, kept, places))
        return [{name: value[None] for name, value in seen.items()}]

    def acted(self) -> None:
        """Forget nothing: this observation is in the memory of later ones."""


def _padded(values: Sequence[NDArray[Any]], kept: Sequence[int], places: int) -> torch.Tensor:
    """Return some of the values, `(places, …)`, followed by zeros."""
    padded = np.zeros((places, *values[-1].shape), values[-1].dtype)
    for place, index in enumerate(kept):
        padded[place] = values[index]
    return torch.from_numpy(padded)


def _from_0_to_1(pixels: torch.Tensor) -> torch.Tensor:
    return pixels.to(torch.float32) / 255
