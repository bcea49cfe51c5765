"""Check what a simulator returns for a new episode, so that a mistake shows at the first reset."""

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
    wrong, unknown = [], (0, simulator.action_size)
    if state.ndim != 1 or not len(state):
        wrong.append(f"the first live state has the shape {state.shape}")
    elif states.ndim != 2 or states.shape[1:] != state.shape:
        wrong.append(f"the lesson's states have the shape {states.shape}, a live one {state.shape}")
    if actions.shape not in (unknown, full := (len(states), simulator.action_size)):
        wrong.append(
            f"the lesson's actions have the shape {actions.shape}; expected {full}, or {unknown} "
            "if they are unknown"
        )
    for name, image in first.images.items():
        if name not in simulator.cameras:
            wrong.append(f"the camera {name!r} is none of {', '.join(simulator.cameras)}")
        elif image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            wrong.append(f"the image of {name!r} is {image.dtype} {image.shape}")
    if wrong:
        _refuse(simulator, wrong)


def _refuse(simulator: Simulator, wrong: list[str]) -> None:
    raise SimulatorError(f"simulator {type(simulator).__name__}: {'; '.join(wrong)}", _HINT)
