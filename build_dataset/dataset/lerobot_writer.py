"""Write stored episodes as one LeRobot v3 dataset: the only user of lerobot.

LeRobot's own writer makes the parquet files and the metadata, with separate files for every
episode. Two parts are replaced. Its streaming video encoder drops frames when its queue is full
and spends as long on image statistics as on encoding; the replacement hands over videos that are
already encoded and checked. Its statistics of vectors overflow where a sensor reports "no reading"
as the largest float32, and take minutes for thousands of values; ours do not.
"""

import json
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

from robomme_interference_data.build_dataset.alike import Look
from robomme_interference_data.build_dataset.sources.base import Robot
from robomme_interference_data.constants import ACTION, INFO_PATH
from robomme_interference_data.errors import MissingExtraError
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.files import write_text
from robomme_interference_data.storage.lerobot.statistics import STATISTICS, vector_statistics
from robomme_interference_data.storage.video.encode import Codec

_ONE_EPISODE_MB = 1e-6
"""Largest size of a file, 1 byte: no two episodes share one."""


@dataclass(frozen=True)
class StoredEpisode:
    """An episode that is encoded and checked, with names of all values; maps are by feature.

    Image statistics are on the scale 0 to 255; `vectors` reads `(T, D) float32`.
    """

    record: EpisodeRecord
    features: dict[str, tuple[int, ...]]
    videos: dict[str, Path]
    stats: dict[str, dict[str, tuple[float, ...]]]
    vectors: Callable[[str], NDArray[np.float32]]
    robot: Robot

    @property
    def fps(self) -> float:
        """Frames per second, which staging makes sure are known."""
        assert self.robot.fps is not None
        return self.robot.fps

    @property
    def look(self) -> Look:
        """What must be alike in the episodes of a dataset."""
        return Look(self.features, self.fps, self.robot.type, self.robot.names)


def require_lerobot() -> None:
    """Check that lerobot is installed, without importing it."""
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

    `root` must not exist; `features` are those of the episodes that the dataset keeps.
    """
    with _quiet(), _own_statistics():
        from lerobot.configs.video import RGBEncoderConfig
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        robot, fps = episodes[0].robot, episodes[0].fps
        # LeRobot has no features of no values: states that were not recorded are left out.
        stored = {feature: shape for feature, shape in features.items() if shape != (0,)}
        dataset = LeRobotDataset.create(
            repo_id=name,
            fps=int(fps) if fps.is_integer() else fps,  # type: ignore[arg-type]
            features=_declared(stored, robot),
            root=root,
            robot_type=robot.type,
            rgb_encoder=RGBEncoderConfig(
                vcodec=codec.vcodec, pix_fmt=codec.pix_fmt, **codec.settings
            ),
            streaming_encoding=True,
            video_backend="pyav",
            video_files_size_in_mb=_ONE_EPISODE_MB,
            data_files_size_in_mb=_ONE_EPISODE_MB,
        )
        videos = _EncodedVideos()
        dataset.writer._streaming_encoder = videos
        # LeRobot checks shape and dtype of each image; the pixels are in the encoded videos.
        blank = {n: np.zeros(s, np.uint8) for n, s in stored.items() if len(s) == 3}
        for episode in episodes:
            videos.next = episode
            vectors = {n: episode.vectors(n) for n, s in stored.items() if len(s) == 1}
            for position in range(episode.record.length):
                values = {name: array[position] for name, array in vectors.items()}
                dataset.add_frame({**blank, **values, "task": episode.record.goal})
            dataset.save_episode()
            yield episode.record.length
        dataset.finalize()
    if not fps.is_integer():
        _state_rate(root / INFO_PATH, fps)


def _state_rate(path: Path, fps: float) -> None:
    """Write the rate of the videos to LeRobot's description of them, which it rounds down."""
    info = json.loads(path.read_text(encoding="utf-8"))
    for feature in info["features"].values():
        if feature["dtype"] == "video":
            feature["info"]["video.fps"] = fps
    write_text(path, json.dumps(info, indent=4, ensure_ascii=False) + "\n")


def _declared(features: dict[str, tuple[int, ...]], robot: Robot) -> dict[str, dict[str, Any]]:
    """Return LeRobot's feature table: cameras first, then state and action."""
    declared: dict[str, dict[str, Any]] = {}
    for name in sorted(
        features, key=lambda feature: (len(features[feature]) == 1, feature == ACTION, feature)
    ):
        shape = features[name]
        if len(shape) == 1:
            # None is LeRobot's own way to state that names are unknown.
            names = list(robot.names[name]) if name in robot.names else None
            declared[name] = {"dtype": "float32", "shape": shape, "names": names}
        else:
            names = ["height", "width", "channels"]
            declared[name] = {"dtype": "video", "shape": shape, "names": names}
    return declared


class _EncodedVideos:
    """Takes the place of LeRobot's streaming encoder, with an episode's encoded videos."""

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
        """Ignore a frame: it is in the encoded video."""

    def finish_episode(self) -> dict[str, tuple[Path, dict[str, Any]]]:
        videos = {}
        for feature in self._features:
            # LeRobot moves the file away and removes its folder.
            copy = Path(tempfile.mkdtemp(dir=self._folder)) / "episode.mp4"
            shutil.copyfile(self.next.videos[feature], copy)
            values = self.next.stats[feature]
            stats = {name: np.array(values[name]) for name in STATISTICS}  # in LeRobot's order
            stats["count"] = stats["count"].astype(np.int64)
            videos[feature] = (copy, stats)
        return videos

    def cancel_episode(self) -> None:
        """Do nothing: no encoder runs in the background."""

    close = cancel_episode


@contextmanager
def _own_statistics() -> Iterator[None]:
    """Let LeRobot's writer store our statistics of vectors."""
    from lerobot.datasets import dataset_writer

    def statistics(values: dict[str, NDArray[Any]], features: Any) -> dict[str, Any]:
        return {name: vector_statistics(array) for name, array in values.items()}

    theirs = dataset_writer.compute_episode_stats
    dataset_writer.compute_episode_stats = statistics
    try:
        yield
    finally:
        dataset_writer.compute_episode_stats = theirs


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence what LeRobot, datasets and FFmpeg print; errors still come through."""
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
        # LeRobot leaves FFmpeg's callback behind, which prints; this restores PyAV's own.
        av.logging.set_level(av.logging.get_level())
