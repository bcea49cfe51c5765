"""Write stored episodes as one LeRobot v3 dataset: the only user of lerobot.

LeRobot's own writer makes the parquet files and the metadata, with files of its own for every
episode. Only its streaming video encoder is replaced: that one drops frames when its queue is full
and spends as long on image statistics as on encoding; here videos that were already encoded,
decoded and compared take its place.
"""

import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION, FPS
from robomme_interference_data.errors import MissingExtraError
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.encode import Codec

_OWN_FILES_MB = 1e-6
"""Bound on the size of a file, a byte: no episode shares one with another."""

_PANDA = ("joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6", "joint_7", "gripper")
"""Joint positions in rad; gripper: opening in m in a state, −1 closed to 1 open in an action."""


@dataclass(frozen=True)
class StoredEpisode:
    """An episode that is encoded and checked, wherever it lies; maps are by feature.

    Attributes:
        record: What the dataset says of it; the writer gives it its number.
        features: Shape of one value: cameras `(H, W, 3)`, vectors `(D,)`.
        videos: The files of the cameras.
        stats: Statistics of the cameras' images, on the scale 0 to 255.
        vectors: Reads states or actions, `(T, D) float32`, of a feature.
    """

    record: EpisodeRecord
    features: dict[str, tuple[int, ...]]
    videos: dict[str, Path]
    stats: dict[str, dict[str, NDArray[Any]]]
    vectors: Callable[[str], NDArray[np.float32]]


def require_lerobot() -> None:
    """Check that lerobot is installed, before any work is done, without importing it."""
    if find_spec("lerobot") is None or find_spec("datasets") is None:
        raise MissingExtraError.needs("writing LeRobot datasets", "lerobot", "build")


def load_lerobot() -> None:
    """Import lerobot now: it takes seconds."""
    with _quiet():
        import lerobot.datasets.lerobot_dataset  # noqa: F401


def write_lerobot(
    root: Path,
    name: str,
    episodes: Sequence[StoredEpisode],
    features: dict[str, tuple[int, ...]],
    codec: Codec,
) -> Iterator[int]:
    """Write a dataset with LeRobot's writer; yields the number of frames after each episode.

    Args:
        root: Folder that the dataset is made in; must not exist.
        name: Name that LeRobot gives the dataset.
        episodes: What to write, in order.
        features: Shape of one value by feature: cameras `(H, W, 3)`, vectors `(D,)`.
        codec: Settings that the videos were encoded with.
    """
    with _quiet():
        from lerobot.configs.video import RGBEncoderConfig
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        dataset = LeRobotDataset.create(
            repo_id=name,
            fps=FPS,
            features=_declared(features),
            root=root,
            rgb_encoder=RGBEncoderConfig(
                vcodec=codec.vcodec, pix_fmt=codec.pix_fmt, **codec.settings
            ),
            streaming_encoding=True,
            video_backend="pyav",
            video_files_size_in_mb=_OWN_FILES_MB,
            data_files_size_in_mb=_OWN_FILES_MB,
        )
        videos = _ReadyVideos()
        dataset.writer._streaming_encoder = videos
        # LeRobot checks shape and dtype of each image; the pixels come with the ready videos.
        blank = {n: np.zeros(s, np.uint8) for n, s in features.items() if len(s) == 3}
        for episode in episodes:
            videos.next = episode
            vectors = {n: episode.vectors(n) for n, s in features.items() if len(s) == 1}
            for position in range(episode.record.length):
                values = {name: array[position] for name, array in vectors.items()}
                dataset.add_frame({**blank, **values, "task": episode.record.goal})
            dataset.save_episode()
            yield episode.record.length
        dataset.finalize()


def _declared(features: dict[str, tuple[int, ...]]) -> dict[str, dict[str, Any]]:
    """Return LeRobot's feature table: cameras first, then state and action."""
    declared: dict[str, dict[str, Any]] = {}
    for name in sorted(features, key=lambda one: (len(features[one]) == 1, one == ACTION, one)):
        shape = features[name]
        kind, names = "video", ["height", "width", "channels"]
        if len(shape) == 1:
            kind, names = "float32", [f"value_{number}" for number in range(*shape)]
            names = list(_PANDA) if len(names) == len(_PANDA) else names
        declared[name] = {"dtype": kind, "shape": shape, "names": names}
    return declared


class _ReadyVideos:
    """Stands where LeRobot's streaming encoder does, and hands over an episode's ready videos."""

    def __init__(self) -> None:
        self.next: StoredEpisode
        self._folder: Path
        self._features: list[str]

    def start_episode(
        self, video_keys: list[str], temp_dir: Path, depth_video_keys: list[str] | None = None
    ) -> None:
        self._folder = temp_dir
        self._features = list(video_keys)

    def feed_frame(self, video_key: str, image: Any) -> None:
        """Take no frame: all are in the ready video."""

    def finish_episode(self) -> dict[str, tuple[Path, dict[str, Any]]]:
        videos = {}
        for feature in self._features:
            # LeRobot moves the file away and removes the folder that it was in.
            copy = Path(tempfile.mkdtemp(dir=self._folder)) / "episode.mp4"
            shutil.copyfile(self.next.videos[feature], copy)
            videos[feature] = (copy, self.next.stats[feature])
        return videos

    def cancel_episode(self) -> None:
        """Nothing runs in the background."""

    def close(self) -> None:
        """Nothing runs in the background."""


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence what LeRobot, datasets and FFmpeg print while writing; errors still come through."""
    import av.logging

    os.environ.setdefault("HF_DATASETS_DISABLE_PROGRESS_BARS", "1")
    loggers = [logging.getLogger(name) for name in ("lerobot", "datasets", "libav")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    av.logging.set_libav_level(av.logging.ERROR)
    try:
        import datasets

        datasets.disable_progress_bars()
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
        av.logging.set_libav_level(av.logging.INFO)  # FFmpeg's own default
        # LeRobot leaves FFmpeg's callback behind, which prints; this puts PyAV's own back.
        av.logging.set_level(av.logging.get_level())
