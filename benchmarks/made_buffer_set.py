"""A made-up buffer set of any number of queries and units, with videos of a few hundred bytes.

LeRobot's own writer makes the datasets, so their number of files and their metadata are those of
real ones: only the videos are small.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from manifests import made_up, written
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.dataset.identity import complete_dataset, identity_of
from robomme_interference_data.build_dataset.dataset.lerobot_writer import (
    StoredEpisode,
    write_lerobot,
)
from robomme_interference_data.build_dataset.sources import Robot
from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    FPS,
    FRONT,
    INFO_PATH,
    STATE,
    VALUE_NAMES,
    WRIST,
)
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.lerobot.statistics import STATISTICS
from robomme_interference_data.storage.text import read_json
from robomme_interference_data.storage.video.encode import CODECS, VideoEncoder

SIDE, LESSON = 32, 8
CAMERAS = (FRONT, WRIST)
FEATURES = {FRONT: (SIDE, SIDE, 3), WRIST: (SIDE, SIDE, 3), STATE: (8,)}
ROBOT = Robot(FPS, names={STATE: VALUE_NAMES})
CODEC = CODECS["av1-lossless"]


def write_buffer_set(root: Path, queries: int, units: int, conditions: Sequence[str]) -> None:
    """Write the buffer set: a video and a data file of its own for each camera of each episode."""
    for kind, count in ((DEMONSTRATIONS, queries), (DISTRACTORS, units)):
        _write_dataset(root / kind, kind, count)
    written(root, conditions)


def _write_dataset(root: Path, kind: str, count: int) -> None:
    records = [_record(kind, index) for index in range(count)]
    with tempfile.TemporaryDirectory(prefix="interference-videos-") as name:
        folder = Path(name)
        video = _video(folder / "video.mp4", records[0].length)
        episodes = []
        for record in records:
            videos = {}
            for number, camera in enumerate(CAMERAS):
                videos[camera] = folder / f"{record.episode_index}-{number}.mp4"
                # A box that players skip: no two files are the same, and each is sent for itself.
                mark = (len(CAMERAS) * record.episode_index + number).to_bytes(8)
                videos[camera].write_bytes(video + (16).to_bytes(4) + b"free" + mark)
            random = np.random.default_rng(record.episode_index)
            stats = {camera: _statistics(random, record.length) for camera in CAMERAS}
            vectors = _vectors(random.random((record.length, 8), np.float32))
            episodes.append(StoredEpisode(record, FEATURES, videos, stats, vectors, ROBOT))
        for _ in write_lerobot(root, kind, episodes, FEATURES, CODEC):
            pass
    info = read_json(root / INFO_PATH)
    identity = identity_of(records, info, kind, "1.0.0", CODEC.name, ())
    complete_dataset(root, records, identity, {})


def _record(kind: str, index: int) -> EpisodeRecord:
    record = made_up(kind, index)
    if kind == DISTRACTORS:
        return record
    return replace(record, length=LESSON + 1, exec_start_idx=LESSON)


def _video(path: Path, frames: int) -> bytes:
    encoder = VideoEncoder(path, CODEC, FPS, SIDE, SIDE)
    for number in range(frames):
        encoder.add(np.full((SIDE, SIDE, 3), number, np.uint8))
    encoder.close()
    return path.read_bytes()


def _statistics(random: np.random.Generator, frames: int) -> dict[str, NDArray[Any]]:
    """Return numbers that are as hard to compress as those of real images."""
    made: dict[str, NDArray[Any]] = {
        name: random.integers(0, 256, (3, 1, 1)).astype(np.float64) for name in STATISTICS
    }
    for name in ("mean", "std"):
        made[name] = 255 * random.random((3, 1, 1))
    return made | {"count": np.array([frames])}


def _vectors(values: NDArray[np.float32]) -> Callable[[str], NDArray[np.float32]]:
    return lambda _: values
