"""A simulator without physics."""

import numpy as np

from robomme_interference_data.errors import UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.records import Status
from robomme_interference_data.simulators.base import (
    Begun,
    Demonstration,
    EpisodeInfo,
    Observation,
    Simulator,
)

STEPS = 3

UNKNOWN, ENDLESS = 3, 4
"""Index of an episode that does not exist, and of one that never ends; others do after `STEPS`."""


class Double(Simulator):
    """A simulator of 4×4 pictures, with a lesson of five frames in every episode.

    Args:
        cameras: What it draws: the front camera all in the episode's index, others in 99.
    """

    def __init__(self, cameras: tuple[str, ...] = ("front", "wrist")):
        self.cameras = cameras

    def act(self, policy: str) -> np.ndarray:
        return np.zeros(8, np.float32)

    def _begin(self, episode: EpisodeId, demonstration: bool) -> Begun:
        if episode.index == UNKNOWN:
            raise UnknownNameError("no such episode", "Take another.")
        lesson = Demonstration(
            {name: np.stack([image] * 5) for name, image in self._images(episode).items()},
            np.zeros((5, 8), np.float32),
            np.ones((5, 8), np.float32),
        )
        info = EpisodeInfo(("goal",), "easy", episode.index, "double")
        return lesson, Observation(self._images(episode), np.zeros(8, np.float32)), info

    def _execute(
        self, episode: EpisodeId, action: np.ndarray, observe: bool
    ) -> tuple[Observation, Status]:
        goes_on = episode.index == ENDLESS or self._steps < STEPS
        seen = Observation(self._images(episode), np.full(8, self._steps, np.float32))
        return seen, Status.ONGOING if goes_on else Status.SUCCESS

    def _images(self, episode: EpisodeId) -> dict[str, np.ndarray]:
        return {
            name: np.full((4, 4, 3), episode.index if name == "front" else 99, np.uint8)
            for name in self.cameras
        }


make = Double
