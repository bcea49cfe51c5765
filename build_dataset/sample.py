"""Record a small made-up sample in the `frames` layout, to try everything without RoboMME's data.

A gripper moves over a table with cubes; every family has its own table colour and path.
The sample says nothing about any benchmark. Only integers and exact fractions are used, so that
every machine makes the same pixels.
"""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.encode import RECORDING, VideoEncoder
from robomme_interference_data.build_dataset.record import SCHEMA
from robomme_interference_data.constants import FAMILIES, FPS
from robomme_interference_data.errors import BuildError
from robomme_interference_data.files import atomic_path
from robomme_interference_data.ids import EpisodeId

__all__ = ["write_sample"]

_CUBES = ((200, 40, 40), (40, 160, 60), (50, 80, 200))
_DIFFICULTIES = ("easy", "medium", "hard")


def write_sample(
    folder: Path,
    *,
    families: tuple[str, ...] = FAMILIES,
    train: int = 2,
    test: int = 1,
    size: int = 256,
    frames: int = 260,
    demonstration: int = 48,
) -> Iterator[int]:
    """Write a sample; yields the number of frames after each episode.

    Args:
        folder: Where to write; must not exist or be empty.
        families: Families to record.
        train: Train episodes of each family.
        test: Test episodes of each family.
        size: Height and width of the images in pixels, a multiple of 16.
        frames: Frames of an episode. The first family's train episode 1 gets 200, too few for a
            distractor unit, as some real episodes have.
        demonstration: Frames of the demonstration; odd episodes have 16 more.

    Raises:
        BuildError: The folder holds something.
    """
    if folder.exists() and any(folder.iterdir()):
        raise BuildError(f"{folder} is not empty", "Choose another --out, or remove it first.")
    columns: dict[str, list[object]] = {name: [] for name in SCHEMA.names}
    ids = [
        EpisodeId(family, split, index)
        for family in families
        for split, count in (("train", train), ("test", test))
        for index in range(count)
    ]
    for episode in ids:
        length = 200 if (episode.family, str(episode)[-7:]) == (families[0], "train/1") else frames
        lesson = demonstration + 16 * (episode.index % 2)
        scene = _Scene(episode, families.index(episode.family), size)
        for camera, draw in (("front", scene.front), ("wrist", scene.wrist)):
            path = folder / "videos" / camera / f"{episode}.mkv"
            path.parent.mkdir(parents=True, exist_ok=True)
            encoder = VideoEncoder(path, RECORDING, FPS, size, size)
            for step in range(length):
                encoder.add(draw(step))
            encoder.close()
        for step in range(length):
            row = {
                "episode_id": str(episode),
                "frame_index": step,
                "state": scene.state(step),
                "action": scene.state(step + 1),
                "is_demo": step < lesson,
                "goal": f"watch the video carefully, then do the {episode.family} task again",
                "seed": scene.seed,
                "difficulty": _DIFFICULTIES[episode.index % 3],
                "simulator": "sample",
            }
            for name, value in row.items():
                columns[name].append(value)
        yield length
    with atomic_path(folder / "frames.parquet") as partial:
        pq.write_table(pa.table(columns, schema=SCHEMA), partial)


class _Scene:
    """One episode's table, cubes and path, on a grid of 256 × 256."""

    def __init__(self, episode: EpisodeId, family: int, size: int):
        digest = hashlib.sha256(str(episode).encode()).digest()
        self.seed = int.from_bytes(digest[:4])
        self.size = size
        self._periods = (40 + 6 * family, 56 + 4 * family + digest[4] % 8)
        self._cubes = [(40 + digest[5 + i] % 176, 110 + digest[8 + i] % 110) for i in range(3)]
        hue = 37 * family % 120
        rows = np.arange(size, dtype=np.int64)[:, None] * 256 // size
        shade = np.broadcast_to(rows // 4, (size, size))
        table = np.stack([90 + hue + shade // 2, 200 - hue + shade // 8, 150 + shade], axis=2)
        self._table = table.clip(0, 255)

    def _gripper(self, step: int) -> tuple[int, int]:
        """Column and row of the gripper at a step."""
        return (
            32 + _triangle(step, self._periods[0], 192),
            70 + _triangle(step, self._periods[1], 130),
        )

    def front(self, step: int) -> NDArray[np.uint8]:
        """Draw the front view, `(size, size, 3) uint8`."""
        image: NDArray[np.uint8] = self._table.astype(np.uint8)
        for (column, row), colour in zip(self._cubes, _CUBES, strict=True):
            self._box(image, column, row, 12, 12, colour)
        column, row = self._gripper(step)
        self._box(image, column, row // 2, 5, row // 2, (235, 235, 235))
        self._box(image, column, row, 14, 6, (60, 60, 70))
        return image

    def wrist(self, step: int) -> NDArray[np.uint8]:
        """Draw the wrist view, `(size, size, 3) uint8`: the front view around the gripper."""
        column, row = (value * self.size // 256 for value in self._gripper(step))
        return np.roll(self.front(step), (self.size // 2 - row, self.size // 2 - column), (0, 1))

    def state(self, step: int) -> list[float]:
        """Return 7 joint positions and the gripper opening: exact multiples of 1/1024."""
        column, row = self._gripper(step)
        joints = [(column * (i + 1) - row * (7 - i)) / 1024 for i in range(7)]
        return [*joints, 40 / 1024 if step % self._periods[0] < self._periods[0] // 2 else 0.0]

    def _box(
        self,
        image: NDArray[np.uint8],
        column: int,
        row: int,
        half_width: int,
        half_height: int,
        colour: tuple[int, int, int],
    ) -> None:
        top, bottom, left, right = (
            max(0, value * self.size // 256)
            for value in (
                row - half_height,
                row + half_height,
                column - half_width,
                column + half_width,
            )
        )
        image[top:bottom, left:right] = colour


def _triangle(step: int, period: int, height: int) -> int:
    """Return a triangle wave from 0 to `height`."""
    phase = step % period
    half = period // 2
    return height * (phase if phase <= half else period - phase) // max(1, period - half)
