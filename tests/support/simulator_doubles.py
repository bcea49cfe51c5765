"""A simulator without physics, which behaves badly on demand."""

import os
import time
from pathlib import Path

import numpy as np

from robomme_interference_data.errors import UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.records import Status
from robomme_interference_data.simulators.base import (
    Begun,
    Demonstration,
    EpisodeInfo,
    Observation,
    OneAtATime,
)

STEPS = 3

DIES, HANGS, UNKNOWN, ENDLESS = 1, 2, 3, 4
"""Indices of episodes that do so; `UNKNOWN` does not exist. All others succeed after `STEPS`."""


class Double(OneAtATime):
    """A simulator of 4×4 pictures, with a lesson of five frames in every episode.

    Args:
        marks: Folder where bad behaviour is marked, so that it happens once only; None: always.
        cameras: What it draws: the front camera all in the episode's index, others in 99.
        actions: Whether it tells the actions of its lessons.
        render: Taken, and without effect.
    """

    def __init__(
        self,
        marks: str | None = None,
        render: bool = True,
        cameras: tuple[str, ...] = ("front",),
        actions: bool = True,
    ):
        self.marks = Path(marks) if marks else None
        self.cameras, self.actions = cameras, actions

    def act(self, policy: str) -> np.ndarray:
        assert self.actions
        return np.zeros(8, np.float32)

    def _begin(self, episode: EpisodeId, demonstration: bool) -> Begun:
        if episode.index in (DIES, HANGS) and self._first_time(episode.index):
            if episode.index == DIES:
                os._exit(7)
            time.sleep(600)
        if episode.index == UNKNOWN:
            raise UnknownNameError("no such episode", "Take another.")
        lesson = Demonstration(
            {name: np.stack([image] * 5) for name, image in self._images(episode).items()},
            np.zeros((5, 8), np.float32),
            np.ones((5 if self.actions else 0, 8), np.float32),
        )
        info = EpisodeInfo("goal", ("goal",), "easy", episode.index, "double")
        return lesson, self._seen(episode, STEPS), info

    def _execute(
        self, episode: EpisodeId, action: np.ndarray, observe: bool
    ) -> tuple[Observation, Status]:
        left = STEPS - self._steps if episode.index != ENDLESS else 1
        return self._seen(episode, left), Status.ONGOING if left else Status.SUCCESS

    def _seen(self, episode: EpisodeId, left: int) -> Observation:
        return Observation(self._images(episode), np.full(8, left, np.float32))

    def _images(self, episode: EpisodeId) -> dict[str, np.ndarray]:
        return {
            name: np.full((4, 4, 3), episode.index if name == "front" else 99, np.uint8)
            for name in self.cameras
        }

    def _first_time(self, index: int) -> bool:
        if self.marks is None:
            return True
        mark = self.marks / str(index)
        if mark.exists():
            return False
        mark.touch()
        return True


def make(**options: object) -> Double:
    return Double(**options)  # type: ignore[arg-type]


def make_once(**options: object) -> Double:
    """Make one that behaves badly once for each index; marks go where `DOUBLE_MARKS` says."""
    return Double(os.environ["DOUBLE_MARKS"], **options)  # type: ignore[arg-type]
