"""A simulator without physics."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from robomme_interference_data.errors import UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.shifts import Shift
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import (
    Demonstration,
    EpisodeInfo,
    EpisodeStart,
    Observation,
)

STEPS = 3

UNKNOWN, ENDLESS = 3, 4
"""Index of an episode that does not exist, and of one that never ends; others end after `STEPS`."""


class Double(Simulator):
    """A simulator of 4×4 images, with a lesson of five frames in every episode.

    Pixels of the front camera are the episode's index, of others 99. States count the frames of the
    lesson, and then the steps from 10 on; actions count the steps. `actions` is whether it returns
    the lesson's actions.
    """

    def __init__(
        self,
        cameras: tuple[str, ...] = ("front", "wrist"),
        name: str = "double",
        actions: bool = True,
        **options: Any,
    ):
        self.cameras, self.name, self.actions, self.options = cameras, name, actions, options
        self.executed, self.closed = 0, False

    def act(self, policy: str) -> np.ndarray:
        return np.full(8, self._steps, np.float32)

    def views(self, shifts: Iterable[Shift]) -> Iterator[Observation]:
        episode = self._running()
        for number, _ in enumerate(shifts, 1):
            images = {name: image + number for name, image in self._images(episode).items()}
            yield Observation(images, np.full(8, 10, np.float32))

    def close(self) -> None:
        super().close()
        self.closed = True

    def _begin(self, episode: EpisodeId, frame_step: int) -> EpisodeStart:
        if episode.index == UNKNOWN:
            raise UnknownNameError("no such episode", "Take another.")
        lesson = Demonstration(
            {
                name: np.stack([image] * 5)[:: frame_step or 1]
                for name, image in self._images(episode).items()
            },
            np.arange(5, dtype=np.float32)[:, None].repeat(8, 1),
            np.ones((5 * self.actions, 8), np.float32),
        )
        info = EpisodeInfo(("goal", "other"), "easy", episode.index, self.name)
        return lesson, Observation(self._images(episode), np.full(8, 10, np.float32)), info

    def _execute(
        self, episode: EpisodeId, action: np.ndarray, observe: bool
    ) -> tuple[Observation, Status]:
        self.executed += 1
        goes_on = episode.index == ENDLESS or self._steps < STEPS
        seen = Observation(self._images(episode), np.full(8, 10 + self._steps, np.float32))
        return seen, Status.ONGOING if goes_on else Status.SUCCESS

    def _images(self, episode: EpisodeId) -> dict[str, np.ndarray]:
        return {
            name: np.full((4, 4, 3), episode.index if name == "front" else 99, np.uint8)
            for name in self.cameras
        }


make = Double
