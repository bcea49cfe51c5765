"""Write staged episodes as one LeRobot v3 dataset: the only user of lerobot.

LeRobot's own writer makes the parquet files, the metadata and the concatenated videos. Only its
streaming video encoder is replaced: that one drops frames when its queue is full and spends as
long on image statistics as on encoding; here the staged videos, already decoded and compared,
take its place.
"""

import logging
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from robomme_interference_data.build_dataset.encode import Codec
from robomme_interference_data.build_dataset.features import features_of
from robomme_interference_data.build_dataset.plan import PlannedEpisode
from robomme_interference_data.build_dataset.stage import StagedEpisode
from robomme_interference_data.constants import CAMERA_PREFIX
from robomme_interference_data.errors import MissingExtraError

__all__ = ["load_lerobot", "require_lerobot", "write_dataset"]

_VIDEO_FILE_MB = 64
"""Bound on a video file. LeRobot rewrites the file for every episode that it appends."""

_DATA_FILE_MB = 64


def require_lerobot() -> None:
    """Check that lerobot is installed, before any work is done, without importing it.

    Raises:
        MissingExtraError: It is not.
    """
    from importlib.util import find_spec

    if find_spec("lerobot") is None or find_spec("datasets") is None:
        raise MissingExtraError(
            "writing LeRobot datasets needs lerobot",
            'Install it: pip install "robomme-interference-data[build]"',
        )


def load_lerobot() -> None:
    """Import lerobot now: it takes seconds."""
    with _quiet():
        import lerobot.datasets.lerobot_dataset  # noqa: F401


def write_dataset(
    root: Path,
    name: str,
    episodes: Sequence[tuple[PlannedEpisode, StagedEpisode]],
    cameras: tuple[str, ...],
    codec: Codec,
    fps: int,
) -> Iterator[int]:
    """Write a dataset with LeRobot's writer; yields the number of frames after each episode.

    Every family begins a new data file and new video files, so that one can be had without the
    others.

    Args:
        root: Folder that the dataset is made in; must not exist.
        name: Name that LeRobot gives the dataset.
        episodes: What to write, in order; families follow one another.
        cameras: Cameras to write.
        codec: Settings that the videos were encoded with.
        fps: Frame rate in Hz.
    """
    with _quiet():
        from lerobot.configs.video import RGBEncoderConfig
        from lerobot.datasets.io_utils import write_info
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        dataset = LeRobotDataset.create(
            repo_id=name,
            fps=fps,
            features=features_of(episodes[0][0].episode, cameras),
            root=root,
            rgb_encoder=RGBEncoderConfig(
                vcodec=codec.vcodec, pix_fmt=codec.pix_fmt, **codec.settings
            ),
            streaming_encoding=True,
            video_backend="pyav",
        )
        videos = _StagedVideos()
        dataset.writer._streaming_encoder = videos
        family = None
        for planned, staged in episodes:
            first = planned.episode.id.family != family
            family = planned.episode.id.family
            # A limit of 0 makes LeRobot begin new files with this episode.
            dataset.meta.info.video_files_size_in_mb = 0 if first else _VIDEO_FILE_MB
            dataset.meta.info.data_files_size_in_mb = 0 if first else _DATA_FILE_MB
            videos.next = staged
            _add(dataset, planned, staged, cameras)
            dataset.save_episode()
            yield staged.length
        dataset.finalize()
        dataset.meta.info.video_files_size_in_mb = _VIDEO_FILE_MB
        dataset.meta.info.data_files_size_in_mb = _DATA_FILE_MB
        write_info(dataset.meta.info, root)


def _add(
    dataset: Any, planned: PlannedEpisode, staged: StagedEpisode, cameras: tuple[str, ...]
) -> None:
    vectors = {
        feature: staged.vectors(feature)
        for feature in staged.feature_sha256
        if not feature.startswith(CAMERA_PREFIX)
    }
    # LeRobot checks shape and dtype of each image; the pixels come with the staged videos.
    blank = {
        CAMERA_PREFIX + camera: np.zeros((*planned.episode.cameras[camera], 3), np.uint8)
        for camera in cameras
    }
    for position in range(staged.length):
        values = {feature: array[position] for feature, array in vectors.items()}
        dataset.add_frame({**blank, **values, "task": planned.episode.goals[0]})


class _StagedVideos:
    """Stands where LeRobot's streaming encoder does, and hands over a staged episode's videos."""

    def __init__(self) -> None:
        self.next: StagedEpisode
        self._folder: Path
        self._features: list[str]

    def start_episode(
        self, video_keys: list[str], temp_dir: Path, depth_video_keys: list[str] | None = None
    ) -> None:
        self._folder = temp_dir
        self._features = list(video_keys)

    def feed_frame(self, video_key: str, image: Any) -> None:
        """Take no frame: all are in the staged video."""

    def finish_episode(self) -> dict[str, tuple[Path, dict[str, Any]]]:
        videos = {}
        for feature in self._features:
            # LeRobot moves the file away and removes the folder that it was in.
            folder = Path(tempfile.mkdtemp(dir=self._folder))
            copy = folder / "episode.mp4"
            shutil.copyfile(self.next.video(feature.removeprefix(CAMERA_PREFIX)), copy)
            stats = {name: np.array(value) for name, value in self.next.stats[feature].items()}
            videos[feature] = (copy, stats)
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
