"""What a dataset that is there keeps when it grows: its episodes are not encoded again."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.image_stats import before_scaling
from robomme_interference_data.constants import EPISODES_DIR, REPORT_PATH
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.files import LocalFiles, read_json
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.parquet import RowSpan
from robomme_interference_data.records import EpisodeRecord


@dataclass(frozen=True)
class EarlierEpisode:
    """An episode of a dataset that grows; see `StoredEpisode`."""

    dataset: Dataset
    record: EpisodeRecord
    features: dict[str, tuple[int, ...]]
    statistics: dict[str, Any]

    def video(self, feature: str) -> Path:
        """See `StoredEpisode`."""
        place = self.dataset.lerobot.place(self.record.episode_index)
        return self.dataset.files.path(place.videos[feature][0])

    def vectors(self, feature: str) -> NDArray[np.float32]:
        """See `StoredEpisode`."""
        return self.dataset.lerobot.vectors(self.record.episode_index, feature)

    def stats(self, feature: str) -> dict[str, NDArray[Any]]:
        """See `StoredEpisode`."""
        prefix = f"stats/{feature}/"
        return {
            name.removeprefix(prefix): before_scaling(name, np.ravel(value))
            for name, value in self.statistics.items()
            if name.startswith(prefix)
        }


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
        kept = {one.record.episode_id for one in self.episodes}
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
    report = read_json(root / REPORT_PATH)
    skipped = {str(one["episode_id"]): str(one["why"]) for one in report["skipped"]}
    episodes = (
        EarlierEpisode(dataset, record, dataset.features, told)
        for record, told in zip(dataset.records(), statistics, strict=True)
    )
    return Earlier(dataset, tuple(episodes), skipped)
