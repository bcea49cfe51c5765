"""A policy for the lamp: it remembers a color that the lamp showed, the first or the last one."""

from typing import Any

import numpy as np
from lamp import COLORS, CORNERS, SIDE, SPEED
from numpy.typing import NDArray

from robomme_interference_data.evaluate import Frames, Observation, Policy, RolloutInfo

_PALETTE = np.array([*COLORS.values()])


class Remember(Policy):
    """Press the button of the remembered color, or the one opposite of it."""

    cameras = ("top",)
    history_cameras = ("top",)

    def __init__(self, keep: str = "last"):
        self.keep = keep

    def reset(self, info: RolloutInfo) -> None:
        """Forget everything."""
        self.seen: list[int] = []

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        """Keep the color in the middle of each frame in which the lamp is lit."""
        colors = [_color(view[SIDE // 2, SIDE // 2]) for view in frames["top"]]
        self.seen += [color for color in colors if color is not None]

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return one step towards the button, `(1, 2) float32`."""
        target = self.seen[0 if self.keep == "first" else -1] if self.seen else 0
        view = observation.images["top"]
        buttons = [_color(view[int(y * SIDE), int(x * SIDE)]) for x, y in CORNERS]
        at = (buttons.index(target) + 2 * ("opposite" in goal)) % 4 if target in buttons else 0
        return np.clip((CORNERS[at] - observation.state) / SPEED, -1, 1)[None]

    def metadata(self) -> dict[str, Any]:
        """Return what identifies it."""
        return {"policy": "remember", "keep": self.keep}


def _color(pixel: NDArray[np.uint8]) -> int | None:
    """Return the number of a pixel's color, None for any other color."""
    same = np.flatnonzero((pixel == _PALETTE).all(axis=1))
    return int(same[0]) if len(same) else None
