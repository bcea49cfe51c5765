"""What a dataset that is there keeps when it grows: its episodes are not encoded again."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robomme_interference_data.constants import EPISODES_DIR, REPORT_PATH
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import read_header
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.files import LocalFiles
from robomme_interference_data.storage.parquet import RowSpan

from .image_stats import before_scaling
from .lerobot_writer import StoredEpisode


@dataclass(frozen=True)
class _Skipped:
    episode_id: EpisodeId
    why: str


@dataclass(frozen=True)
class _Report:
    """`meta/build_report.json`."""

    format_version: int
    kind: str
    counts: dict[str, Any]
    skipped: tuple[_Skipped, ...]


@dataclass(frozen=True)
class Earlier:
    """A dataset that is there and may grow.

    Attributes:
        dataset: The dataset.
        episodes: Its episodes.
        skipped: Ids of episodes that yielded nothing when it was built, and why.
    """

    dataset: Dataset
    episodes: tuple[StoredEpisode, ...]
    skipped: dict[str, str]


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
    report = read_header(root / REPORT_PATH, _Report)
    skipped = {str(one.episode_id): one.why for one in report.skipped}
    episodes = (
        _stored(dataset, record, told)
        for record, told in zip(dataset.records(), statistics, strict=True)
    )
    return Earlier(dataset, tuple(episodes), skipped)


def _stored(dataset: Dataset, record: EpisodeRecord, statistics: dict[str, Any]) -> StoredEpisode:
    place = dataset.lerobot.place(record.episode_index)
    stats: dict[str, dict[str, NDArray[Any]]] = {feature: {} for feature in place.videos}
    for column, value in statistics.items():
        _, feature, name = column.split("/")
        if feature in stats:
            stats[feature][name] = before_scaling(name, np.ravel(value))
    return StoredEpisode(
        record,
        dataset.features,
        {feature: dataset.files.path(path) for feature, (path, _) in place.videos.items()},
        stats,
        partial(dataset.lerobot.vectors, record.episode_index),
    )
