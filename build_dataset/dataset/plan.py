"""The plan of one dataset: which episodes of which sources it stores, and how."""

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

from robomme_interference_data.build_dataset.alike import Look, in_buffers
from robomme_interference_data.build_dataset.sources import Source, SourceEpisode
from robomme_interference_data.constants import PAPER_UNIT, Unit
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.schema.shard import Shard

from .lerobot_writer import StoredEpisode
from .resize import Resize


class PlannedEpisode(NamedTuple):
    """An episode to store.

    Attributes:
        source: Index of its source in the plan.
        episode: The episode, as the source lists it.
    """

    source: int
    episode: SourceEpisode


@dataclass(frozen=True)
class DatasetPlan:
    """A dataset to build, with open sources; from a `BuildConfig`, or made directly.

    Attributes:
        kind: Name of the dataset in a buffer set, such as `demonstrations`.
        sources: The sources.
        episodes: The episodes to store.
        cameras: Cameras to store, possibly none of them; None for all.
        codec: Name of the video settings.
        version: Version of the dataset.
        time_limit_s: Limit in seconds for one episode; None for the sources' defaults.
        unit: Size of the units in the distractors, which those of the raw ones follow from.
        fps: Frames per second of recordings that do not state them; None if all do.
        resize: Size of the stored frames; None for the recorded one.
        must_match: What the episodes must look like, those of the demonstrations; None for
            anything.
    """

    kind: str
    sources: tuple[Source, ...]
    episodes: tuple[PlannedEpisode, ...]
    cameras: tuple[str, ...] | None = None
    codec: str = "av1-lossless"
    version: str = "1.0.0"
    time_limit_s: float | None = None
    unit: Unit = PAPER_UNIT
    fps: float | None = None
    resize: Resize | None = None
    must_match: Look | None = None

    def provenance(self, number: int) -> dict[str, Any]:
        """Return what the dataset records about a source, and how its frames are resized."""
        recorded = self.sources[number].provenance
        return recorded if self.resize is None else recorded | {"resize": str(self.resize)}

    @property
    def worker_gb(self) -> float:
        """Memory in GB that a worker takes."""
        return max(source.worker_gb for source in self.sources)

    @property
    def provenances(self) -> list[dict[str, Any]]:
        """What the dataset records about each source."""
        return [self.provenance(number) for number in range(len(self.sources))]

    def share(self, shard: Shard) -> "DatasetPlan":
        """Return the plan of a shard's episodes, in canonical order."""
        episodes = shard.share(self.episodes, lambda planned: planned.episode.id)
        episodes.sort(key=lambda planned: planned.episode.id)
        return dataclasses.replace(self, episodes=tuple(episodes))

    def matching(self, demonstrations: Dataset | StoredEpisode) -> "DatasetPlan":
        """Return the plan with episodes that must look like those of the demonstrations."""
        look = in_buffers(self.kind, demonstrations.features, demonstrations.fps)
        return dataclasses.replace(self, must_match=look)
