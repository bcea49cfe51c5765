"""Items and batches of a `HistoryDataset` as LeRobot's training loop and processors take them.

LeRobot's processors keep entries below `observation.`, `action`, `task`, `index` and `…_is_pad`,
and drop all others. So in the layout `lerobot`, what a policy may see is below `observation.`, and
what it must not see is below `label.`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION, STATE
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.memory_features import MEMORY_PADDING, POSITION, in_memory
from robomme_interference_data.storage.lerobot.statistics import (
    ImageStats,
    Statistics,
    vector_statistics,
)

LAYOUTS = ("plain", "lerobot")
"""The layouts: the names that `HistoryDataset` lists, and those that LeRobot keeps."""

_RENAMED = {
    "memory.is_pad": MEMORY_PADDING,
    "memory.evidence": "label.evidence",
    "evidence_known": "label.evidence_known",
    "position": POSITION,
    "question.answer": "label.answer",
    "condition": "label.condition",
    "shift": "label.shift",
    "episode_id": "label.episode_id",
}
_MOVED = ("memory.", "question")
"""Beginnings of the other names that move below `observation.`"""

_SAMPLED_IMAGES = 256
"""Most images of a camera of which the statistics of pixels are taken."""


def memory_entry(feature: str) -> str:
    """Return the name of a feature's values in memory, in the layout `plain`: `memory.state`."""
    return f"memory.{feature.removeprefix('observation.')}"


def renamed(batch: Mapping[str, Any]) -> dict[str, Any]:
    """Return an item or a batch with the names of the layout `lerobot`."""
    return {_renamed(name): values for name, values in batch.items()}


def _renamed(name: str) -> str:
    if name in _RENAMED:
        return _RENAMED[name]
    return f"observation.{name}" if name.startswith(_MOVED) else name


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
    stats: Statistics
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
    ends: Sequence[int],
    cameras: Sequence[str],
    values: Callable[[str, int | None], NDArray[Any]],
) -> LeRobotMeta:
    """Return what LeRobot's training reads of a dataset.

    Args:
        buffer_set: The buffer set.
        live: Its dataset of live frames.
        episodes: The query episodes.
        ends: The index after the last item of each.
        cameras: Features of the cameras.
        values: From a feature and a number to at most so many stored values, or all: `(N, D)`, of
            cameras `(N, 3, S, S)`.
    """
    features: dict[str, dict[str, Any]] = {}
    stats: Statistics = {}
    for camera in cameras:
        frames = values(camera, _SAMPLED_IMAGES)
        for name in (camera, in_memory(camera)):
            features[name] = {
                "dtype": "video",
                "shape": (*frames.shape[2:], 3),
                "names": ["height", "width", "channels"],
            }
            # Of their own: LeRobot writes those of ImageNet over them.
            stats[name] = _image_statistics(frames)
    for feature, names in ((STATE, (STATE, in_memory(STATE))), (ACTION, (ACTION,))):
        vectors = values(feature, None)
        if vectors.shape[1]:  # recordings may have no states
            declared = live.lerobot.features.get(feature, {}).get("names")
            for name in names:
                features[name] = {"dtype": "float32", "shape": vectors.shape[1:], "names": declared}
                stats[name] = vector_statistics(vectors)
    goals = [buffer_set.query(episode).goal for episode in episodes]
    starts = [0, *ends[:-1]]
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
            "length": [end - start for start, end in zip(starts, ends, strict=True)],
            "dataset_from_index": starts,
            "dataset_to_index": list(ends),
        },
        tasks=Tasks(tuple(dict.fromkeys(goals))),
    )


def _image_statistics(frames: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Return the statistics of images `(N, 3, H, W)`, `(3, 1, 1)` on the scale 0 to 1."""
    counts = ImageStats()
    for frame in frames:
        counts.add(frame.transpose(1, 2, 0))
    return {
        name: values if name == "count" else (values / 255).reshape(3, 1, 1)
        for name, values in counts.result().items()
    }
