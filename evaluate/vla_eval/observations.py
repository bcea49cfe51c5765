"""The names of vla-eval's RoboMME benchmark for frames, states and actions, which its servers read.

Its servers take images by their order, and read the state under `states`, else `state`.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from vla_eval.protocol.image_codec import encode_image
from vla_eval.specs import IMAGE_RGB, LANGUAGE, DimSpec

from robomme_interference_data.evaluate.policies.policy import Frames, Policy, RolloutInfo
from robomme_interference_data.simulators.episode import Observation

CAMERAS = {"front": "agentview", "wrist": "wrist"}
"""Camera to its name in an observation's `images`, and in an observation spec."""

HISTORIES = {"front": "video_history", "wrist": "wrist_video_history"}
"""Camera to the key of its history frames."""

STATE_HISTORY = "state_history"
"""Key of the states of the history frames, `(T, 8) float32`: an addition of this project."""

STATE = DimSpec(
    "state",
    8,
    "raw",  # as vla-eval's RoboMME benchmark and most servers declare it: there, others do not fit
    description="7 joint positions in rad, then the gripper's opening in m, 0 (closed) to 0.04",
)

ACTIONS = DimSpec(
    "actions",
    8,
    "joint_positions",
    accepts=frozenset(
        {"raw", "joint_positions", "joint_pos_abs", "absolute_joint_positions_with_grippers"}
    ),
    description="7 absolute joint targets in rad, then the gripper, -1 (close) to 1 (open)",
)

ACTION_SPEC = {"actions": ACTIONS}
"""What a benchmark of this project takes."""

OBSERVATION_SPEC = {
    **dict.fromkeys(CAMERAS.values(), IMAGE_RGB),
    "state": STATE,
    "language": LANGUAGE,
}
"""What it provides."""


def encoded(image: NDArray[np.uint8]) -> dict[str, Any]:
    """Return a copy of an image for messages, as raw pixels.

    vla-eval's default, PNG, is smaller, but to compress a whole history takes longer than to send
    its pixels.
    """
    return dict(encode_image(image, "raw"))


class ObservingPolicy(Policy):
    """A policy that makes the observations of vla-eval's servers; the first brings the history.

    Attributes:
        sends_state: Whether servers get states, the live ones and those of the history.
    """

    sends_state: bool

    def reset(self, info: RolloutInfo) -> None:
        """Forget the history of the last rollout."""
        self._first, self._states = True, list[NDArray[np.float32]]()
        self._history: dict[str, list[dict[str, Any]]] = {}

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        """Keep frames and states until the first observation."""
        for camera in self.history_cameras:
            self._history.setdefault(camera, []).extend(map(encoded, frames[camera]))
        self._states.append(states.copy())

    def message(self, observation: Observation, goal: str) -> dict[str, Any]:
        """Return an observation as vla-eval's servers read it.

        As in vla-eval, a history without frames has no key at all.
        """
        message: dict[str, Any] = {
            # The order counts: a server that knows no names takes the first image as the main view.
            "images": {CAMERAS[name]: encoded(observation.images[name]) for name in self.cameras},
            "task_description": goal,
        }
        if self.sends_state:
            message["states"] = np.asarray(observation.state, np.float32)
        if self._first:
            message["episode_restart"] = True
        for camera, frames in self._history.items():
            message[HISTORIES[camera]] = frames
            if self.sends_state:
                message[STATE_HISTORY] = np.concatenate(self._states)
        self._first, self._history = False, {}
        return message
