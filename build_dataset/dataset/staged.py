"""The folder of a staged episode, which gets its final name only when it is complete.

An interrupted build resumes from these folders.
"""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robomme_interference_data.build_dataset.sources import Robot
from robomme_interference_data.constants import PAPER_UNIT
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.files import write_json
from robomme_interference_data.storage.text import canonical_json, read_header
from robomme_interference_data.storage.video.encode import get_codec

from .lerobot_writer import StoredEpisode
from .plan import DatasetPlan, PlannedEpisode

_RECORD = "record.json"
_LAYOUT = 9
"""Version of a staged episode's folder, and of how recordings are decoded."""


@dataclass(frozen=True)
class StagedEpisode:
    """Metadata of an episode that a dataset stores, such as a unit."""

    record: EpisodeRecord
    features: dict[str, tuple[int, ...]]
    stats: dict[str, dict[str, tuple[float, ...]]]
    robot: Robot

    def stored(self, folder: Path) -> StoredEpisode:
        """Return the episode with its files in `folder`."""
        start = self.record.episode_id.start
        return StoredEpisode(
            self.record,
            self.features,
            {feature: folder / staged_file(start, f"{feature}.mp4") for feature in self.stats},
            self.stats,
            lambda name: np.load(folder / staged_file(start, f"{name}.npy")),
            self.robot,
        )


@dataclass(frozen=True)
class Staged:
    """What a recorded episode yields.

    Attributes:
        episode_id: Id of the recorded episode.
        skipped: The reason if it yields nothing.
        episodes: Metadata of the stored episodes: one, or several units.
    """

    episode_id: EpisodeId
    skipped: str | None = None
    episodes: tuple[StagedEpisode, ...] = ()

    def stored(self, folder: Path) -> list[StoredEpisode]:
        """Return the stored episodes with their files in `folder`."""
        return [episode.stored(folder) for episode in self.episodes]


def staged_file(start: int, name: str) -> str:
    """Return the name of a file of the stored episode that begins at a raw frame."""
    return f"{start}.{name}"


def staged_name(plan: DatasetPlan, planned: PlannedEpisode) -> str:
    """Return the name of a staged episode's folder: a hash of all that decides its content."""
    number, episode = planned
    codec = get_codec(plan.codec)
    content: dict[str, object] = {
        "kind": plan.kind,
        "source": plan.provenance(number),
        "episode": [str(episode.id), repr(episode.key)],
        "cameras": plan.cameras,
        "codec": [codec.vcodec, codec.pix_fmt, dict(codec.options)],
        "layout": _LAYOUT,
        "fps": plan.fps,
    }
    if plan.unit != PAPER_UNIT:
        content["unit"] = plan.unit
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()[:24]


def keep_staged(folder: Path, staged: Staged, files: Mapping[str, bytes]) -> None:
    """Write a staged episode and its files into a folder, which appears complete."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    try:
        for name, data in files.items():
            (partial / name).write_bytes(data)
        write_json(partial / _RECORD, to_dict(staged))
        for path in partial.iterdir():  # the data must reach the disk before the name does
            with path.open("rb+") as file:  # Windows flushes only what is open for writing
                os.fsync(file.fileno())
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def read_staged(folder: Path) -> Staged | None:
    """Return the metadata of the episode staged in a folder; None if there is no such folder."""
    path = folder / _RECORD
    return read_header(path, Staged) if path.is_file() else None
