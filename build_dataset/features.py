"""The features of a dataset, as LeRobot declares them."""

from typing import Any

from robomme_interference_data.build_dataset.sources.base import SourceEpisode
from robomme_interference_data.constants import ACTION, CAMERA_PREFIX, STATE

__all__ = ["features_of"]

_PANDA = ("joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6", "joint_7", "gripper")
"""Joint positions in rad; gripper: opening in m in a state, −1 closed to 1 open in an action."""


def features_of(episode: SourceEpisode, cameras: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Return LeRobot's feature table for episodes like the given one."""
    features: dict[str, dict[str, Any]] = {
        CAMERA_PREFIX + camera: {
            "dtype": "video",
            "shape": (*episode.cameras[camera], 3),
            "names": ["height", "width", "channels"],
        }
        for camera in cameras
    }
    for name, size in ((STATE, episode.state_size), (ACTION, episode.action_size)):
        if size is not None:
            names = list(_PANDA) if size == len(_PANDA) else [f"value_{i}" for i in range(size)]
            features[name] = {"dtype": "float32", "shape": (size,), "names": names}
    return features
