"""The dataset that a build lets grow: its episodes are not encoded again."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from robomme_interference_data.constants import IDENTITY_PATH, REPORT_PATH
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import BuildError
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.files import LocalFiles, read_header

from .config import BuildPlan
from .identity import BuildReport
from .image_stats import Statistics, before_scaling, episode_statistics, episode_table
from .lerobot_writer import StoredEpisode

_ADVICE = "Choose another `out`, or remove the folder first."


@dataclass(frozen=True)
class ExistingDataset:
    """A dataset that a build lets grow.

    Attributes:
        dataset: The dataset.
        episodes: Its episodes.
        skipped: Ids of episodes that yielded nothing when it was built, and why.
    """

    dataset: Dataset
    episodes: tuple[StoredEpisode, ...]
    skipped: dict[str, str]


def open_existing(out: Path, plan: BuildPlan) -> ExistingDataset | None:
    """Open the dataset that a build lets grow; None if there is none."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return None
    if not (out / IDENTITY_PATH).is_file():
        raise BuildError(f"{out} exists and is not a dataset of this package", _ADVICE)
    dataset = Dataset(LocalFiles(out))
    identity = dataset.identity
    cameras = tuple(sorted(plan.cameras)) if plan.cameras is not None else identity.cameras
    found = (identity.kind, identity.version, identity.codec, identity.cameras)
    wanted = (plan.kind, plan.version, plan.codec, cameras)
    if found != wanted:
        raise BuildError(
            f"{out} exists and was built otherwise: kind, version, codec and cameras are {found}, "
            f"not {wanted}",
            _ADVICE,
        )
    # Of a simulator, the same episode of another version is another one.
    recorded = {one.get("kind"): one for one in identity.sources}
    for source in plan.sources:
        before = recorded.get(source.provenance["kind"], source.provenance)
        if "suite_version" in before and before != source.provenance:
            raise BuildError(
                f"{out} exists and was built from {before}, not from {source.provenance}", _ADVICE
            )
    statistics = episode_statistics(episode_table(dataset))
    episodes = map(partial(_stored, dataset), dataset.records(), statistics)
    report = read_header(out / REPORT_PATH, BuildReport)
    return ExistingDataset(
        dataset, tuple(episodes), {str(one.episode_id): one.why for one in report.skipped}
    )


def _stored(dataset: Dataset, record: EpisodeRecord, statistics: Statistics) -> StoredEpisode:
    place = dataset.lerobot.locate(record.episode_index)
    stats = {
        feature: {name: before_scaling(name, one) for name, one in statistics[feature].items()}
        for feature in place.videos
    }
    return StoredEpisode(
        record,
        dataset.features,
        {feature: dataset.files.path(path) for feature, (path, _) in place.videos.items()},
        stats,
        partial(dataset.lerobot.vectors, record.episode_index),
    )
