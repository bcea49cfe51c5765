"""Source `sample`: made-up episodes, to try everything without recordings or a simulator.

A gripper moves over a table with cubes; every family has its own table color and path. Only
integers and exact fractions are used, so that every machine makes the same pixels.
"""

import hashlib
from collections.abc import Generator
from dataclasses import replace
from typing import override

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DIFFICULTIES, FAMILIES
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.simulators.episode import choose_cameras

from .base import Frame, Recording, Source, SourceEpisode
from .robomme_families import ROBOT

_CUBES = ((200, 40, 40), (40, 160, 60), (50, 80, 200))
_EPISODES = {"train": 3, "test": 1}
_FRAMES = 260
_SHORT = 200
"""Frames of the first family's train episode 1: too few for a unit, as some real ones have."""


class SampleSource(Source):
    """Three train episodes and a test episode of each family.

    In a contradicting lesson the gripper goes the other way round. `families` are separated by
    commas, by default the benchmark's; `size` in pixels is a multiple of 16.
    """

    time_limit_s = 300.0

    def __init__(self, families: str = "", size: int = 256):
        self._families = tuple(families.split(",")) if families else FAMILIES
        self._size = size
        self.provenance = {"kind": "sample", "size": size}

    @override
    def episodes(self) -> list[SourceEpisode]:
        ids = [
            EpisodeId(family, split, index)
            for family in self._families
            for split, count in _EPISODES.items()
            for index in range(count)
        ]
        # An episode's look depends on its family's position.
        return [
            SourceEpisode(episode, self._families.index(episode.family)) for episode in sorted(ids)
        ]

    @override
    def contradict(self, episode: SourceEpisode) -> SourceEpisode:
        return replace(episode, id=replace(episode.id, answer=1))

    @override
    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        name = episode.id
        number = episode.key
        scene = _SampleScene(name, number, self._size)
        short = (number, name.split, name.index) == (0, "train", 1)
        chosen = choose_cameras(cameras)
        lesson = 48 + 16 * (name.index % 2)
        frames = scene.frames(_SHORT if short else _FRAMES, lesson, chosen)
        goal = f"watch the video carefully, then do the {name.family} task again"
        difficulty = DIFFICULTIES[name.index % 3]
        evidence = scene.evidence(lesson)
        known = (goal,), scene.seed, difficulty, "sample"
        return Recording(*known, True, frames, evidence, robot=ROBOT)


class _SampleScene:
    """One episode's table, cubes and path, on a grid of 256 × 256."""

    def __init__(self, episode: EpisodeId, family: int, size: int):
        digest = hashlib.sha256(str(episode.scene).encode()).digest()
        self._contradicts, self._mirrored = episode.answer is not None, 0
        self.seed = int.from_bytes(digest[:4])
        self.size = size
        self._periods = (40 + 6 * family, 56 + 4 * family + digest[4] % 8)
        self._cubes = [(40 + digest[5 + i] % 176, 110 + digest[8 + i] % 110) for i in range(3)]
        hue = 37 * family % 120
        rows = np.arange(size, dtype=np.int64)[:, None] * 256 // size
        shade = np.broadcast_to(rows // 4, (size, size))
        table = np.stack([90 + hue + shade // 2, 200 - hue + shade // 8, 150 + shade], axis=2)
        self._table = table.clip(0, 255)

    def frames(self, length: int, lesson: int, cameras: tuple[str, ...]) -> Generator[Frame]:
        """Yield the frames of an episode, `lesson` of them the demonstration."""
        self._mirrored = lesson if self._contradicts else 0
        for step in range(length):
            images = {camera: getattr(self, camera)(step) for camera in cameras}
            yield Frame(images, self.state(step), self.state(step + 1), step < lesson)

    def evidence(self, lesson: int) -> tuple[EvidenceSpan, ...]:
        """Return when the gripper leaves the left edge, and turns at the right one."""
        turn = self._periods[0] // 2
        shown = ("leaves the left edge", 0, 4), ("turns at the right edge", turn - 4, turn + 4)
        spans = (EvidenceSpan(part, *span) for part, span in enumerate(shown))
        return tuple(span for span in spans if span.stop <= lesson)

    def _gripper(self, step: int) -> tuple[int, int]:
        """Column and row of the gripper at a step."""
        across, down = (
            _triangle(step, p, h) for p, h in zip(self._periods, (192, 130), strict=True)
        )
        return 32 + (192 - across if step < self._mirrored else across), 70 + down

    def front(self, step: int) -> NDArray[np.uint8]:
        """Draw the front view, `(size, size, 3) uint8`."""
        image: NDArray[np.uint8] = self._table.astype(np.uint8)
        for place, color in zip(self._cubes, _CUBES, strict=True):
            self._box(image, place, (12, 12), color)
        column, row = self._gripper(step)
        self._box(image, (column, row // 2), (5, row // 2), (235, 235, 235))
        self._box(image, (column, row), (14, 6), (60, 60, 70))
        return image

    def wrist(self, step: int) -> NDArray[np.uint8]:
        """Draw the wrist view, `(size, size, 3) uint8`: the front view around the gripper."""
        column, row = (value * self.size // 256 for value in self._gripper(step))
        return np.roll(self.front(step), (self.size // 2 - row, self.size // 2 - column), (0, 1))

    def state(self, step: int) -> NDArray[np.float32]:
        """Return 7 joint positions and the gripper opening: exact multiples of 1/1024."""
        column, row = self._gripper(step)
        joints = [(column * (i + 1) - row * (7 - i)) / 1024 for i in range(7)]
        opening = 40 / 1024 if step % self._periods[0] < self._periods[0] // 2 else 0.0
        return np.array([*joints, opening], np.float32)

    def _box(
        self,
        image: NDArray[np.uint8],
        center: tuple[int, int],
        half: tuple[int, int],
        color: tuple[int, int, int],
    ) -> None:
        """Fill a box: column and row of its center, and half its width and height."""
        (column, row), (width, height) = center, half
        edges = (row - height, row + height, column - width, column + width)
        top, bottom, left, right = (max(0, edge * self.size // 256) for edge in edges)
        image[top:bottom, left:right] = color


def _triangle(step: int, period: int, height: int) -> int:
    """Return a triangle wave from 0 to `height`."""
    phase = step % period
    half = period // 2
    return height * (phase if phase <= half else period - phase) // max(1, period - half)
