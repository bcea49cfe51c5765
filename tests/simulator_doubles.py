"""Simulators for the tests of worker processes: no physics, and bad behaviour on demand."""

import multiprocessing.connection
import os
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np

from robomme_interference_data.errors import UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.base import (
    Demonstration,
    EpisodeInfo,
    Observation,
    Status,
)

STEPS = 3


class Double:
    """Succeeds after three steps; what 1, 2, 3 and 49 do instead is written at `reset`.

    Args:
        marks: Folder where bad behaviour is marked, so that it happens once only; None: always.
        cameras: What it draws: the front camera all in the episode's index, others in 99.
        actions: Whether it tells the actions of its lessons.
    """

    chance = 0.25

    def __init__(
        self,
        marks: str | None = None,
        render: bool = True,
        cameras: tuple[str, ...] = ("front",),
        actions: bool = True,
    ):
        self.marks = Path(marks) if marks else None
        self.cameras, self.actions = cameras, actions
        self.left = 0

    def reset(
        self, episode_id: str, demonstration: bool = True
    ) -> tuple[Demonstration, Observation, EpisodeInfo]:
        episode = EpisodeId.parse(episode_id)
        if episode.index in (1, 2) and self._first_time(episode.index):
            if episode.index == 1:
                os._exit(7)  # dies
            time.sleep(600)  # hangs
        if episode.index == 49:
            multiprocessing.connection.Connection.send_bytes = _die_in_mid_message
        if episode.index == 3:
            raise UnknownNameError("no such episode", "Take another.")
        self.left = STEPS
        self.image = np.full((4, 4, 3), episode.index, np.uint8)
        lesson = Demonstration(
            {name: np.stack([image] * 5) for name, image in self._images().items()},
            np.zeros((5, 8), np.float32),
            np.ones((5 if self.actions else 0, 8), np.float32),
        )
        info = EpisodeInfo("goal", ("goal",), "easy", episode.index, "double")
        return lesson, self._observe(), info

    def step(self, action: np.ndarray, observe: bool = True) -> tuple[Observation, Status]:
        self.left -= 1
        return self._observe(), Status.ONGOING if self.left else Status.SUCCESS

    def act(self, policy: str) -> np.ndarray:
        assert self.actions
        return np.zeros(8, np.float32)

    def close(self) -> None:
        pass

    def _observe(self) -> Observation:
        return Observation(self._images(), np.full(8, self.left, np.float32))

    def _images(self) -> dict[str, np.ndarray]:
        other = np.full_like(self.image, 99)
        return {name: self.image if name == "front" else other for name in self.cameras}

    def _first_time(self, index: int) -> bool:
        if self.marks is None:
            return True
        mark = self.marks / str(index)
        if mark.exists():
            return False
        mark.touch()
        return True


def _die_in_mid_message(pipe: multiprocessing.connection.Connection, message: Any) -> None:
    """Announce the message's length, as a pipe does, send four bytes of it, and die."""
    os.write(pipe.fileno(), struct.pack("!i", len(message)) + message[:4])
    os._exit(9)


def make(**options: Any) -> Double:
    return Double(**options)


def make_once(**options: Any) -> Double:
    """Make one that behaves badly once for each index; marks go where `DOUBLE_MARKS` says."""
    return Double(os.environ["DOUBLE_MARKS"], **options)
