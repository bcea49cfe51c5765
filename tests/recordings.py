"""Recorded episodes made up in memory, and how to build datasets of them quickly."""

import hashlib
import os
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data import Dataset
from robomme_interference_data.build_dataset.build import (
    BuildResult,
    Filters,
    Settings,
    build_dataset,
)
from robomme_interference_data.build_dataset.encode import get_codec
from robomme_interference_data.build_dataset.sources.base import Frame, Source, SourceEpisode
from robomme_interference_data.errors import SourceError
from robomme_interference_data.files import LocalFiles
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.progress import BuildProgress
from robomme_interference_data.workers import Outcome

HEIGHT, WIDTH = 16, 24


def listed(
    name: str,
    *,
    length: int = 260,
    lesson: int | None = 5,
    size: tuple[int, int] = (HEIGHT, WIDTH),
    cameras: Iterable[str] = ("front", "wrist"),
    **values: Any,
) -> SourceEpisode:
    """An episode as a source lists it; other fields as keywords."""
    identity = EpisodeId.parse(name)
    defaults = {
        "goals": (f"do {identity.family}", "another wording"),
        "seed": 1000 + identity.index,
        "difficulty": "easy",
        "simulator": "made-up",
        "exact": True,
        "key": ("recording", name),
    }
    return SourceEpisode(
        id=identity,
        raw_length=length,
        demonstration_length=lesson,
        cameras=dict.fromkeys(cameras, size),
        **{**defaults, **values},
    )


EPISODES = [listed(f"{family}/train/{i}") for family in ("MoveCube", "Drawer") for i in range(2)]


def images_of(episode: SourceEpisode, camera: str) -> NDArray[np.uint8]:
    """All raw frames of a camera, `(T, H, W, 3) uint8`: noise, unlike in every episode."""
    shape = (episode.raw_length, *episode.cameras[camera], 3)
    return _random(episode, camera).integers(0, 256, shape, dtype=np.uint8)


def vectors_of(episode: SourceEpisode, what: str, size: int) -> NDArray[np.float32]:
    """All raw states or actions, `(T, size) float32`."""
    return _random(episode, what).standard_normal((episode.raw_length, size), dtype=np.float32)


def frames_of(episode: SourceEpisode) -> Iterator[Frame]:
    """The raw frames of an episode."""
    images = {camera: images_of(episode, camera) for camera in episode.cameras}
    states = vectors_of(episode, "state", episode.state_size)
    actions = None
    if episode.action_size is not None:
        actions = vectors_of(episode, "action", episode.action_size)
    for index in range(episode.raw_length):
        yield Frame(
            images={camera: frames[index] for camera, frames in images.items()},
            state=states[index],
            action=None if actions is None else actions[index],
            is_demonstration=None
            if episode.demonstration_length is None
            else index < episode.demonstration_length,
        )


@dataclass
class MemorySource:
    """A source of made-up episodes.

    Attributes:
        listing: What it lists, in any order.
        breaks: Id of an episode to the raw frame before which its recording breaks off.
        dies: Id of an episode whose reading ends the process.
        alter: Changes a frame, given its raw index; not for worker processes.
        reads: Ids of the episodes that were read, in this process.
    """

    listing: list[SourceEpisode]
    breaks: dict[str, int] = field(default_factory=dict)
    dies: str | None = None
    alter: Callable[[int, Frame], Frame] | None = None
    kind: str = "memory"
    provenance: dict[str, Any] = field(default_factory=lambda: {"kind": "memory"})
    reads: list[str] = field(default_factory=list)

    def episodes(self) -> list[SourceEpisode]:
        return list(self.listing)

    def read(self, episode: SourceEpisode) -> Generator[Frame]:
        name = str(episode.id)
        self.reads.append(name)
        if name == self.dies:
            os._exit(7)
        for index, frame in enumerate(frames_of(episode)):
            if index == self.breaks.get(name):
                raise SourceError(f"{name}: cannot read frame {index}", "Record it again.")
            yield frame if self.alter is None else self.alter(index, frame)


def build(
    kind: str,
    sources: Source | list[Source],
    out: Path,
    *,
    filters: Filters | None = None,
    codec: str = "av1-lossless",
    **settings: Any,
) -> BuildResult:
    """Run a build without showing anything."""
    return build_dataset(
        kind,
        sources if isinstance(sources, list) else [sources],
        out,
        filters or Filters(),
        Settings(codec=get_codec(codec), **settings),
        BuildProgress(quiet=True),
    )


def opened(folder: Path) -> Dataset:
    return Dataset(LocalFiles(folder))


def run_here(
    function: Callable[[Any], Any], tasks: Iterable[Any], **options: Any
) -> Iterator[Outcome]:
    """In place of `run_tasks`, where a test is not about workers: call in this process."""
    for task in tasks:
        try:
            yield Outcome(task, function(task), None, 1)
        except Exception as error:
            yield Outcome(task, None, error, 1)


def contents(folder: Path) -> dict[str, bytes]:
    """All files under a folder, hidden ones too, by relative path."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _random(episode: SourceEpisode, what: str) -> np.random.Generator:
    return np.random.default_rng(int.from_bytes(digest_of(episode, what)[:8], "little"))


def digest_of(episode: SourceEpisode, what: str) -> bytes:
    return hashlib.sha256(f"{episode.id} {what}".encode()).digest()
