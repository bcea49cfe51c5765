"""Check what a simulator returns for a new episode, so that a mistake shows at the first reset."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from robomme_interference_data.errors import SimulatorError

from .episode import Demonstration, EpisodeInfo, Observation

_HINT = (
    "Return (Demonstration, Observation, EpisodeInfo): states (T, S) and (S,) float32, actions "
    "(T, action_size) float32, images (H, W, 3) uint8 of the declared `cameras`."
)


def check_begun(begun: Any, name: str, cameras: Sequence[str], action_size: int) -> None:
    """Compare the beginning of an episode with what a simulator declares.

    Args:
        begun: What `_begin` returned.
        name: Name of the simulator's class, for errors.
        cameras: Its cameras.
        action_size: Length of its actions.
    """
    kinds = (Demonstration, Observation, EpisodeInfo)
    parts = begun if isinstance(begun, tuple) else (begun,)
    if len(parts) != len(kinds) or not all(map(isinstance, parts, kinds)):
        returned = ", ".join(type(part).__name__ for part in parts)
        raise _wrong(name, [f"`_begin` returned {returned}"])
    lesson, first, _ = parts
    state, states, actions = map(np.asarray, (first.state, lesson.states, lesson.actions))
    wrong: list[str] = []
    if state.ndim != 1 or not len(state) or state.dtype != np.float32:
        wrong.append(f"the first live state is {state.dtype} {state.shape}")
    elif states.shape != (len(states), *state.shape) or states.dtype != np.float32:
        wrong.append(
            f"the lesson's states are {states.dtype} {states.shape}, a live one {state.shape}"
        )
    if (
        actions.shape not in ((0, action_size), (len(states), action_size))
        or actions.dtype != np.float32
    ):
        wrong.append(
            f"the lesson's actions are {actions.dtype} {actions.shape}; expected "
            f"{(len(states), action_size)}, or {(0, action_size)} if they are unknown"
        )
    for camera, image in first.images.items():
        if camera not in cameras:
            wrong.append(f"the camera {camera!r} is none of {', '.join(cameras)}")
        elif image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            wrong.append(f"the image of {camera!r} is {image.dtype} {image.shape}")
    if wrong:
        raise _wrong(name, wrong)


def check_drawn(
    lesson: Demonstration, first: Observation, cameras: Iterable[str], frame_step: int = 1
) -> None:
    """Check that a simulator drew these cameras; every n-th frame of the lesson, or none at all."""
    expected = len(range(0, len(lesson), frame_step))
    for camera in cameras:
        frames = len(lesson.images.get(camera, ())) if lesson.images else expected
        if camera not in first.images or frames != expected:
            drawn = ", ".join(first.images) or "no camera"
            raise SimulatorError(
                f"the simulator was to draw {camera}; it drew {drawn}, and {frames} of "
                f"{expected} frames of the lesson",
                "Draw the cameras of the setting `cameras`, and all that are declared without it.",
            )


def _wrong(name: str, wrong: list[str]) -> SimulatorError:
    return SimulatorError(f"simulator {name}: {'; '.join(wrong)}", _HINT)
