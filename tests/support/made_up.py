"""Datasets of metadata alone, and sources whose frames are made up."""

from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.dataset.identity import identity_of
from robomme_interference_data.build_dataset.sources import (
    Frame,
    Recording,
    Robot,
    Source,
    SourceEpisode,
)
from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    IDENTITY_PATH,
    INFO_PATH,
    RECORDS_PATH,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import arrow_schema, to_dict, to_table
from robomme_interference_data.schema.records import EpisodeRecord, EvidenceSpan, SpanDigests
from robomme_interference_data.simulators.episode import choose_cameras
from robomme_interference_data.storage.files import LocalFiles, write_json

SHAPES = {"observation.images.front": (4, 6, 3), "observation.state": (8,)}


def record(
    kind: str, episode: str, index: int = 0, *, lesson: int = 20, **changes: Any
) -> EpisodeRecord:
    """The record of an episode that was never recorded; its digests contain its id."""
    unit = kind == "distractors"
    digests = {name: f"{episode} {name}" for name in SHAPES}
    known: dict[str, Any] = {
        "episode_index": index,
        "episode_id": EpisodeId.parse(episode),
        "length": 32 if unit else lesson + 1,
        "goals": (f"do {episode}",),
        "seed": None,
        "difficulty": None,
        "simulator": None,
        "exec_start_idx": None if unit else lesson,
        "exact": True,
        "feature_sha256": digests,
        "span_sha256": None if unit else SpanDigests("1", "2", "l", "q"),
    }
    return EpisodeRecord(**{**known, **changes})


def write_metadata(
    root: Path,
    kind: str,
    records: Iterable[EpisodeRecord],
    shapes: Mapping[str, Sequence[int]] = SHAPES,
) -> Dataset:
    """Write a dataset of so many episodes, with features of these shapes, but no data or videos."""
    listed = [
        EpisodeRecord(**{**vars(one), "episode_index": index}) for index, one in enumerate(records)
    ]
    features = {
        name: {"dtype": "video" if name.startswith(CAMERA_PREFIX) else "float32", "shape": shape}
        for name, shape in shapes.items()
    }
    info = {
        "codebase_version": "v3.0",
        "fps": 10,
        "total_episodes": len(listed),
        "features": features,
        "data_path": "data/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/file-{file_index:03d}.mp4",
    }
    write_json(root / INFO_PATH, info)
    identity = identity_of(listed, info, kind, "1.0.0", "av1-lossless", (), "0" * 64)
    write_json(root / IDENTITY_PATH, to_dict(identity))
    path = root / RECORDS_PATH
    pq.write_table(to_table(listed, arrow_schema(EpisodeRecord, sorted(shapes))), path)
    return Dataset(LocalFiles(root))


@dataclass
class MadeUpSource(Source):
    """A source in memory; what it does wrong is asked for by episode.

    Attributes:
        lengths: Frames of each episode, of them demonstration: `{"MoveCube/test/0": (20, 5)}`.
        wrong: Of an episode, frame number to what is returned in its place, or raised.
        actions: Whether frames have actions.
        evidence: Evidence of every episode.
        values: Values of a state, and of an action.
    """

    lengths: dict[str, tuple[int, int | None]]
    wrong: dict[str, dict[int, Any]] = field(default_factory=dict)
    actions: bool = True
    cameras: tuple[str, ...] = ("front",)
    evidence: tuple[EvidenceSpan, ...] | None = None
    values: int = 8
    robot: Robot = field(default_factory=lambda: Robot(10))
    provenance: dict[str, Any] = field(default_factory=lambda: {"kind": "made-up"})

    def episodes(self) -> list[SourceEpisode]:
        return sorted(
            (SourceEpisode(EpisodeId.parse(name), length) for name, length in self.lengths.items()),
            key=lambda one: one.id,
        )

    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        chosen = choose_cameras(cameras, self.cameras)
        frames = self._frames(str(episode.id), chosen)
        header = (f"do {episode.id}",), 7, "easy", "made-up"
        return Recording(*header, True, frames, self.evidence, self.robot)

    def _frames(self, name: str, cameras: tuple[str, ...]) -> Generator[Frame]:
        length, lesson = self.lengths[name]
        for number in range(length):
            wrong = self.wrong.get(name, {}).get(number)
            if isinstance(wrong, BaseException):
                raise wrong
            yield wrong or self.frame(name, number, lesson, cameras)

    def frame(
        self, name: str, number: int, lesson: int | None, cameras: tuple[str, ...] = ("front",)
    ) -> Frame:
        """Frame `number` of an episode."""
        return Frame(
            {camera: picture(f"{name} {camera}", number) for camera in cameras},
            np.full(self.values, number, np.float32),
            np.full(self.values, -number, np.float32) if self.actions else None,
            None if lesson is None else number < lesson,
        )


def picture(text: str, number: int) -> NDArray[np.uint8]:
    """Return noise that differs by text and number, `(16, 24, 3) uint8`."""
    seed = np.frombuffer(f"{text} {number}".encode(), np.uint8)
    return np.random.default_rng(seed.tolist()).integers(0, 256, (16, 24, 3), np.uint8)
