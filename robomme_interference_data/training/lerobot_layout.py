"""Items and batches of a `HistoryDataset` as LeRobot's training loop and processors take them.

LeRobot's processors keep entries below `observation.`, `action`, `task`, `index` and `…_is_pad`,
and drop all others. So what a policy may see is below `observation.`, and what it must not see is
below `label.`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import (
    ACTION,
    STATE,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.ids import EpisodeId

from . import statistics
from .draws import number_from
from .statistics import Statistics

if TYPE_CHECKING:
    import torch

LAYOUTS = ("plain", "lerobot")
"""The names of entries: those of `HistoryDataset`, or those of this module."""

MEMORY = "observation.memory."

_RENAMED = {
    "memory.is_pad": MEMORY + "padding",
    "memory.evidence": "label.evidence",
    "evidence_known": "label.evidence_known",
    "position": "observation.position",
    "question.answer": "label.answer",
    "condition": "label.condition",
    "shift": "label.shift",
    "episode_id": "label.episode_id",
}
_MOVED = ("memory.", "question")
"""Beginnings of the other names that move below `observation.`"""

_SAMPLED_IMAGES = 256
"""Most images of a camera of which the statistics of pixels are taken."""


def renamed(batch: Mapping[str, Any]) -> dict[str, Any]:
    """Return an item or a batch with the names of the layout `lerobot`."""
    return {_renamed(name): values for name, values in batch.items()}


def _renamed(name: str) -> str:
    if name in _RENAMED:
        return _RENAMED[name]
    return f"observation.{name}" if name.startswith(_MOVED) else name


def memory_of(feature: str) -> str:
    """Return the name of the memory of `observation.state`, or of a camera."""
    return MEMORY + feature.removeprefix("observation.")


def transform_images(
    images: "torch.Tensor",
    memory: "torch.Tensor",
    transform: Callable[["torch.Tensor"], "torch.Tensor"],
    *key: int | str,
) -> None:
    """Transform the current image of an item and those in its memory in the same random way.

    They are transformed in one call, as frames of a video, with fractions from 0 to 1 as values:
    some of LeRobot's transforms leave bytes unchanged.

    Args:
        images: The current image, `(3, S, S) uint8`; is changed.
        memory: The images in memory, `(M, 3, S, S) uint8`; is changed.
        transform: From `(M + 1, 3, S, S) float32` to the same.
        key: What the random numbers follow from.
    """
    import torch

    # On CPUs only: items are made there, and other generators belong to the training.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(number_from("transform", *key))
        changed = transform(torch.cat([memory, images[None]]).float() / 255)
    pixels = (changed * 255).round().clamp(0, 255).to(torch.uint8)
    memory.copy_(pixels[:-1])
    images.copy_(pixels[-1])


@dataclass(frozen=True)
class Tasks:
    """The goals, as the index of LeRobot's table of tasks."""

    index: tuple[str, ...]


@dataclass(frozen=True)
class LeRobotMeta:
    """What LeRobot's training reads of a dataset beside its items.

    Attributes:
        repo_id: Name of the buffer set, with the namespace if it is on the Hub.
        fps: Recorded frames per second.
        robot_type: Type of the robot, or None.
        features: Entries that a policy takes by dtype, shape and names of its dimensions. Those of
            the memory have the shape of one frame: `(S, S, 3)`, `(D,)`.
        stats: Their statistics. States in memory and current ones share them, over all stored
            frames of the sessions and executions in use; images too, over at most 256 of them.
        camera_keys: The entries that are images.
        episodes: Columns by name: `episode_index`, `tasks`, `length`, and the indices of each
            episode's first item and of that after its last, `dataset_from_index` and
            `dataset_to_index`.
        tasks: The goals.
    """

    repo_id: str
    fps: float
    robot_type: str | None
    features: dict[str, dict[str, Any]]
    stats: dict[str, Statistics]
    camera_keys: list[str]
    episodes: dict[str, list[Any]]
    tasks: Tasks
    depth_keys: tuple[str, ...] = ()
    has_language_columns: bool = False

    @property
    def total_episodes(self) -> int:
        """Number of query episodes."""
        return len(self.episodes["length"])

    @property
    def total_frames(self) -> int:
        """Number of items."""
        return int(self.episodes["dataset_to_index"][-1])


def describe(
    buffer_set: BufferSet,
    live: Dataset,
    episodes: Sequence[EpisodeId],
    stops: NDArray[np.int64],
    cameras: Sequence[str],
    values: Callable[[str], NDArray[Any]],
    images: Callable[[str, int], NDArray[np.uint8]],
) -> LeRobotMeta:
    """Return what LeRobot's training reads of a dataset.

    Args:
        buffer_set: The buffer set.
        live: Its dataset of live frames.
        episodes: The query episodes.
        stops: The index after the last item of each.
        cameras: Features of the cameras.
        values: From a feature of vectors to all values in use, `(N, D)`.
        images: From a feature of a camera to at most so many images in use, `(N, 3, S, S)`.
    """
    features: dict[str, dict[str, Any]] = {}
    stats: dict[str, Statistics] = {}
    for camera in cameras:
        frames = images(camera, _SAMPLED_IMAGES)
        for name in (camera, memory_of(camera)):
            features[name] = {
                "dtype": "video",
                "shape": (*frames.shape[2:], 3),
                "names": ["height", "width", "channels"],
            }
            # Of their own: LeRobot writes those of ImageNet over them.
            stats[name] = statistics.of_images(frames)
    for feature, names in ((STATE, (STATE, memory_of(STATE))), (ACTION, (ACTION,))):
        vectors = values(feature)
        if vectors.shape[1]:  # recordings may have no states
            declared = live.lerobot.features.get(feature, {}).get("names")
            for name in names:
                features[name] = {
                    "dtype": "float32",
                    "shape": vectors.shape[1:],
                    "names": declared,
                }
                stats[name] = statistics.of_vectors(vectors)
    goals = [buffer_set.query(episode).goal for episode in episodes]
    starts = [0, *stops[:-1].tolist()]
    return LeRobotMeta(
        repo_id=buffer_set.name,
        fps=live.fps,
        robot_type=live.lerobot.info.get("robot_type"),
        features=features,
        stats=stats,
        camera_keys=[name for name in features if "images." in name],
        episodes={
            "episode_index": list(range(len(episodes))),
            "tasks": [[goal] for goal in goals],
            "length": np.diff(stops, prepend=0).tolist(),
            "dataset_from_index": starts,
            "dataset_to_index": stops.tolist(),
        },
        tasks=Tasks(tuple(dict.fromkeys(goals))),
    )

