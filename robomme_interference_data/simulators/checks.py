"""Check what a simulator returns for a new episode, so that a mistake shows at the first reset."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from robomme_interference_data.errors import SimulatorError

from .base import Demonstration, EpisodeInfo, Observation, Simulator

_HINT = (
    "Return (Demonstration, Observation, EpisodeInfo): states (T, S) and (S,) float32, actions "
    "(T, action_size) float32, images (H, W, 3) uint8 of the declared `cameras`."
)


def check_begun(simulator: Simulator, begun: Any) -> None:
    """Compare the beginning of an episode with what the simulator's class declares."""
    kinds = (Demonstration, Observation, EpisodeInfo)
    parts = begun if isinstance(begun, tuple) else (begun,)
    if len(parts) != len(kinds) or not all(map(isinstance, parts, kinds)):
        _refuse(simulator, [f"`_begin` returned {', '.join(type(one).__name__ for one in parts)}"])
    lesson, first, _ = parts
    state, states, actions = map(np.asarray, (first.state, lesson.states, lesson.actions))
    wrong, size = [], simulator.action_size
    if state.ndim != 1 or not len(state) or state.dtype != np.float32:
        wrong.append(f"the first live state is {state.dtype} {state.shape}")
    elif states.shape != (len(states), *state.shape) or states.dtype != np.float32:
        wrong.append(
            f"the lesson's states are {states.dtype} {states.shape}, a live one {state.shape}"
        )
    if actions.shape not in ((0, size), (len(states), size)) or actions.dtype != np.float32:
        wrong.append(
            f"the lesson's actions are {actions.dtype} {actions.shape}; expected "
            f"{(len(states), size)}, or {(0, size)} if they are unknown"
        )
    for name, image in first.images.items():
        if name not in simulator.cameras:
            wrong.append(f"the camera {name!r} is none of {', '.join(simulator.cameras)}")
        elif image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            wrong.append(f"the image of {name!r} is {image.dtype} {image.shape}")
    if wrong:
        _refuse(simulator, wrong)


def check_drawn(
    lesson: Demonstration, first: Observation, cameras: Iterable[str], every: int = 1
) -> None:
    """Check that a simulator drew these cameras; every n-th frame of the lesson, or none at all."""
    expected = len(range(0, len(lesson), every))
    for camera in cameras:
        frames = len(lesson.images.get(camera, ())) if lesson.images else expected
        if camera not in first.images or frames != expected:
            drawn = ", ".join(first.images) or "no camera"
            raise SimulatorError(
                f"the simulator was to draw {camera}; it drew {drawn}, and {frames} of "
                f"{expected} frames of the lesson",
                "Draw the cameras of the setting `cameras`, and all that are declared without it.",
            )


def _refuse(simulator: Simulator, wrong: list[str]) -> None:
    raise SimulatorError(f"simulator {type(simulator).__name__}: {'; '.join(wrong)}", _HINT)
