"""Episodes to be written into a dataset: staged just now, or taken over from an earlier dataset."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.stage import StagedEpisode
from robomme_interference_data.constants import CAMERA_PREFIX, EPISODES_DIR, REPORT_PATH
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.files import LocalFiles, read_json
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.parquet import RowSpan
from robomme_interference_data.records import EpisodeRecord

__all__ = ["Earlier", "EarlierEpisode", "NewEpisode", "read_earlier"]


@dataclass(frozen=True)
class NewEpisode:
    """A staged episode."""

    episode: StagedEpisode

    @property
    def episode_id(self) -> EpisodeId:
        """Id of the episode."""
        return self.episode.staged.episode_id

    @property
    def task(self) -> str:
        """The task's text: the first wording of the goal."""
        return self.episode.staged.goals[0]

    @property
    def length(self) -> int:
        """Stored frames."""
        return self.episode.staged.length

    @property
    def features(self) -> dict[str, tuple[int, ...]]:
        """Shape of one value by feature."""
        return self.episode.staged.features

    def video(self, camera: str) -> Path:
        """Return the video file of a camera."""
        return self.episode.video(camera)

    def vectors(self, feature: str) -> NDArray[np.float32]:
        """Return states or actions, `(T, D) float32`."""
        return self.episode.vectors(feature)

    def stats(self, feature: str) -> dict[str, NDArray[Any]]:
        """Return the statistics of a camera's images, on the scale 0 to 255."""
        found = {name: np.array(v) for name, v in self.episode.staged.stats[feature].items()}
        return {**found, "count": found["count"].astype(np.int64)}

    def record(self, index: int, features: tuple[str, ...]) -> EpisodeRecord:
        """Return the record of the episode at its place in a dataset with these features."""
        staged = self.episode.staged
        return EpisodeRecord(
            episode_index=index,
            episode_id=staged.episode_id,
            length=staged.length,
            goals=staged.goals,
            seed=staged.seed,
            difficulty=staged.difficulty,
            simulator=staged.simulator,
            exec_start_idx=staged.exec_start_idx,
            exact=staged.exact,
            feature_sha256=_only(staged.feature_sha256, features),
            lesson_sha256=staged.lesson_sha256 and _only(staged.lesson_sha256, features),
        )


@dataclass(frozen=True)
class EarlierEpisode:
    """An episode of a dataset that grows: nothing of it is encoded again."""

    dataset: Dataset
    earlier: EpisodeRecord
    statistics: dict[str, Any] = field(repr=False)

    @property
    def episode_id(self) -> EpisodeId:
        """Id of the episode."""
        return self.earlier.episode_id

    @property
    def task(self) -> str:
        """The task's text: the first wording of the goal."""
        return self.earlier.goal

    @property
    def length(self) -> int:
        """Stored frames."""
        return self.earlier.length

    @property
    def features(self) -> dict[str, tuple[int, ...]]:
        """Shape of one value by feature."""
        return self.dataset.features

    def video(self, camera: str) -> Path:
        """Return the video file of a camera."""
        place = self.dataset.lerobot.place(self.earlier.episode_index)
        return self.dataset.files.path(place.videos[CAMERA_PREFIX + camera][0])

    def vectors(self, feature: str) -> NDArray[np.float32]:
        """Return states or actions, `(T, D) float32`."""
        index, length = self.earlier.episode_index, self.earlier.length
        return self.dataset.read_vectors(index, feature, 0, length)

    def stats(self, feature: str) -> dict[str, NDArray[Any]]:
        """Return the statistics of a camera's images, on the scale 0 to 255."""
        prefix = f"stats/{feature}/"
        return {
            name.removeprefix(prefix): _before_scaling(name, np.ravel(value))
            for name, value in self.statistics.items()
            if name.startswith(prefix)
        }

    def record(self, index: int, features: tuple[str, ...]) -> EpisodeRecord:
        """Return the record of the episode at its place in a dataset with these features."""
        known = {name: getattr(self.earlier, name) for name in EpisodeRecord.__dataclass_fields__}
        lesson = self.earlier.lesson_sha256
        known |= {
            "episode_index": index,
            "feature_sha256": _only(self.earlier.feature_sha256, features),
            "lesson_sha256": lesson and _only(lesson, features),
        }
        return EpisodeRecord(**known)


@dataclass(frozen=True)
class Earlier:
    """A dataset that is there and may grow.

    Attributes:
        dataset: The dataset.
        episodes: Its episodes.
        skipped: Ids of episodes that yielded nothing when it was built, and why.
    """

    dataset: Dataset
    episodes: tuple[EarlierEpisode, ...]
    skipped: dict[str, str]

    def ids(self) -> set[EpisodeId]:
        """Return the ids of all episodes that need not be read again."""
        kept = {one.episode_id for one in self.episodes}
        return kept | set(map(EpisodeId.parse, self.skipped))


def read_earlier(root: Path) -> Earlier:
    """Read what a dataset that grows keeps.

    Raises:
        MissingFileError, FormatError: It is damaged.
    """
    dataset = Dataset(LocalFiles(root))
    paths = dataset.files.list(EPISODES_DIR, ".parquet")
    tables = [RowSpan(dataset.files.path(path)).table() for path in paths]
    table = pa.concat_tables(tables).sort_by("episode_index")
    names = [name for name in table.column_names if name.startswith("stats/")]
    statistics = table.select(names).to_pylist()
    episodes = zip(dataset.records(), statistics, strict=True)
    report = read_json(root / REPORT_PATH)
    skipped = {str(one["episode_id"]): str(one["why"]) for one in report["skipped"]}
    return Earlier(dataset, tuple(EarlierEpisode(dataset, *one) for one in episodes), skipped)


def _only(digests: dict[str, str], features: tuple[str, ...]) -> dict[str, str]:
    return {name: digest for name, digest in digests.items() if name in features}


def _before_scaling(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """Return what LeRobot divided by 255 when it stored statistics of images, bit for bit."""
    if name.endswith("/count"):
        return values
    found = []
    for value in values.astype(np.float64):
        near = value * 255
        steps = (near, math.nextafter(near, math.inf), math.nextafter(near, -math.inf))
        found.append(next((one for one in steps if one / 255 == value), near))
    return np.array(found)
