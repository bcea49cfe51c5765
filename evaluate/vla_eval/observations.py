"""The names of vla-eval's RoboMME benchmark for frames, states and actions, which its servers read.

Its servers take images by their order, and read the state under `states`, else `state`.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vla_eval.protocol.image_codec import encode_image
from vla_eval.specs import IMAGE_RGB, LANGUAGE, DimSpec

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


def make_observation(
    images: Mapping[str, Any],
    goal: str,
    *,
    state: Any = None,
    first: bool = False,
    history: Mapping[str, Iterable[Any]] | None = None,
    states: Any = None,
) -> dict[str, Any]:
    """Return an observation as vla-eval's servers read it.

    Args:
        images: Camera (`front`, `wrist`) to its current `(H, W, 3) uint8` RGB image.
        goal: The goal in words.
        state: The current state, `(8,) float32`; None: it is not sent.
        first: Whether it is the first one of its episode.
        history: Camera to its T history frames, `encoded`; None: they are not sent.
            As in vla-eval, a history without frames has no key at all.
        states: The states of the history frames, `(T, 8) float32`, sent only with them; None: they
            are not sent.
    """
    observation: dict[str, Any] = {
        # The order counts: a server that knows no names takes the first image as the main view.
        "images": {
            name: encoded(images[camera]) for camera, name in CAMERAS.items() if camera in images
        },
        "task_description": goal,
    }
    if state is not None:
        observation["states"] = state
    if first:
        observation["episode_restart"] = True
    for camera, frames in (history or {}).items():
        if listed := list(frames):
            observation[HISTORIES[camera]] = listed
            if states is not None:
                observation[STATE_HISTORY] = states
    return observation
