"""Stage one episode: cut and encode it while it is read, decode it again, record its hashes.

A staged episode is a folder that appears under its final name only when it is complete and
checked, so an interrupted build goes on from the folders that it finds.
"""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.cut import CUTS, NothingToStore
from robomme_interference_data.build_dataset.image_stats import ImageStats
from robomme_interference_data.build_dataset.sources import Frame, Recording, Source, SourceEpisode
from robomme_interference_data.constants import ACTION, CAMERA_PREFIX, DEMONSTRATIONS, FPS, STATE
from robomme_interference_data.digest import FeatureDigests
from robomme_interference_data.encode import Codec, VideoEncoder
from robomme_interference_data.errors import BuildError, InterferenceError, SourceError
from robomme_interference_data.execution import Worker
from robomme_interference_data.files import canonical_json, write_json
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.rows import read_header, to_dict
from robomme_interference_data.video import iter_frames

__all__ = ["StageTask", "Staged", "StagedEpisode", "read_staged"]

_RECORD = "record.json"
_LAYOUT = 2
"""Version of a staged episode's folder."""

Task = tuple[int, SourceEpisode]
"""The number of its source, and an episode."""


@dataclass(frozen=True)
class Staged:
    """What is known of a staged episode; see `EpisodeRecord` for what is not said here.

    Attributes:
        skipped: Why the episode yields nothing; None if it yields something.
        features: Shape of one value by feature.
        stats: Image statistics by feature.
    """

    episode_id: EpisodeId
    skipped: str | None
    length: int
    goals: tuple[str, ...]
    seed: int | None
    difficulty: str | None
    simulator: str | None
    exec_start_idx: int | None
    exact: bool
    features: dict[str, tuple[int, ...]]
    feature_sha256: dict[str, str]
    lesson_sha256: dict[str, str] | None
    stats: dict[str, dict[str, tuple[float, ...]]]


@dataclass(frozen=True)
class StagedEpisode:
    """A staged episode and the folder that holds its videos and vectors."""

    staged: Staged
    folder: Path

    def video(self, camera: str) -> Path:
        """Return the video file of a camera."""
        return self.folder / f"{camera}.mp4"

    def vectors(self, feature: str) -> NDArray[np.float32]:
        """Read states or actions, `(T, D) float32`."""
        values: NDArray[np.float32] = np.load(self.folder / f"{_file_name(feature)}.npy")
        return values


@dataclass(frozen=True)
class StageTask:
    """Stages one episode after the other, as a task of an executor.

    Attributes:
        kind: `demonstrations` or `distractors`.
        sources: Where to read.
        cameras: Cameras to store; None for all.
        codec: Video settings.
        folder: Where staged episodes appear.
    """

    kind: str
    sources: tuple[Source, ...]
    cameras: tuple[str, ...] | None
    codec: Codec
    folder: Path

    def place(self, task: Task) -> Path:
        """Return the folder of a staged episode: named by a hash of all that decides it."""
        number, episode = task
        content = {
            "kind": self.kind,
            "source": self.sources[number].provenance,
            "episode": [str(episode.id), repr(episode.key)],
            "cameras": self.cameras,
            "codec": [self.codec.vcodec, self.codec.pix_fmt, dict(self.codec.options)],
            "layout": _LAYOUT,
        }
        return self.folder / hashlib.sha256(canonical_json(content).encode()).hexdigest()[:24]

    def __call__(self, task: Task, worker: Worker) -> StagedEpisode:
        """Cut, encode, check and record one episode.

        Raises:
            InvalidOptionError: It has no such camera.
            SourceError: The recording breaks off, or holds what cannot be stored.
            BuildError: A video does not decode to what went in.
        """
        place = self.place(task)
        done = read_staged(place)
        if done is not None:
            return done
        number, episode = task
        place.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(dir=place.parent, prefix=f".{place.name}."))
        try:
            recording = self.sources[number].read(episode, self.cameras)
            with closing(recording.frames):
                staged = self._write(episode.id, recording, partial)
            write_json(partial / _RECORD, to_dict(staged))
            for path in partial.iterdir():  # the data must reach the disk before the name does
                with path.open("rb") as file:
                    os.fsync(file.fileno())
            partial.rename(place)
        except InterferenceError as error:
            raise error.about(episode.id) from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        return StagedEpisode(staged, place)

    def close(self) -> None:
        """Release what sources hold."""
        for source in self.sources:
            source.close()

    def _write(self, episode: EpisodeId, recording: Recording, folder: Path) -> Staged:
        writer = _Writer(self.codec, folder)
        lesson: dict[str, str] | None = None
        skipped = None
        try:
            for frame in CUTS[self.kind](recording.frames):
                if self.kind == DEMONSTRATIONS and not frame.is_demonstration:
                    lesson = writer.digests.current()
                writer.add(frame)
        except NothingToStore as reason:
            skipped = str(reason)
        writer.close()
        start = writer.length - 1 if lesson is not None else None
        digests = writer.digests.current()
        if skipped is None:
            decoded, decoded_lesson = _decode(writer, start)
            if self.codec.exact and any(digests[name] != sha for name, sha in decoded.items()):
                raise BuildError(
                    f"a video does not decode to the frames that were encoded with "
                    f"{self.codec.name}",
                    "Please report this with the versions that robomme-interference doctor prints.",
                )
            # Of a lossy codec, what a reader gets is what is hashed.
            digests |= decoded
            lesson = None if lesson is None else lesson | decoded_lesson
        return Staged(
            episode_id=episode,
            skipped=skipped,
            length=writer.length,
            goals=recording.goals,
            seed=recording.seed,
            difficulty=recording.difficulty,
            simulator=recording.simulator,
            exec_start_idx=start,
            exact=recording.exact and self.codec.exact,
            features=writer.features,
            feature_sha256=digests,
            lesson_sha256=lesson,
            stats={
                CAMERA_PREFIX + camera: {
                    name: tuple(map(float, values)) for name, values in stats.result().items()
                }
                for camera, stats in writer.stats.items()
            },
        )


def read_staged(folder: Path) -> StagedEpisode | None:
    """Return the staged episode in a folder; None if there is no such folder."""
    path = folder / _RECORD
    return StagedEpisode(read_header(path, Staged), folder) if path.is_file() else None


class _Writer:
    """The files of a staged episode while they are written."""

    def __init__(self, codec: Codec, folder: Path):
        self._codec = codec
        self._folder = folder
        self._encoders: dict[str, VideoEncoder] = {}
        self._vectors: dict[str, list[NDArray[np.float32]]] = {}
        self.features: dict[str, tuple[int, ...]] = {}
        self.stats: dict[str, ImageStats] = {}
        self.digests = FeatureDigests()
        self.length = 0

    def add(self, frame: Frame) -> None:
        """Take the next frame.

        Raises:
            SourceError: It is not as the first one, or holds what is no finite number.
        """
        if not self.length:
            self._begin(frame)
        vectors = {STATE: frame.state} | ({} if frame.action is None else {ACTION: frame.action})
        found = {CAMERA_PREFIX + camera: image for camera, image in frame.images.items()} | vectors
        shapes = {name: value.shape for name, value in found.items()}
        if shapes != self.features:
            raise SourceError(
                f"stored frame {self.length} has {shapes}; the first one {self.features}",
                "All frames of an episode must have the same cameras and sizes.",
            )
        for camera, image in frame.images.items():
            self._encoders[camera].add(image)
            self.stats[camera].add(image)
            self.digests.update(CAMERA_PREFIX + camera, image)
        for name, value in vectors.items():
            if value.dtype != np.float32 or not np.isfinite(value).all():
                raise SourceError(
                    f"{name} of stored frame {self.length} is {value.tolist()}; expected finite "
                    "float32 numbers",
                    "Mend the recording, or leave the episode out: --episodes",
                )
            self._vectors[name].append(value)
            self.digests.update(name, value)
        self.length += 1

    def close(self) -> None:
        for encoder in self._encoders.values():
            encoder.close()
        for name, values in self._vectors.items():
            np.save(self._folder / f"{_file_name(name)}.npy", np.stack(values))

    def decoded(self) -> Iterator[tuple[str, Iterator[NDArray[np.uint8]]]]:
        """Yield each camera's feature name, and its frames as they were written."""
        for camera in self._encoders:
            yield CAMERA_PREFIX + camera, iter_frames(self._folder / f"{camera}.mp4", 0, None, FPS)

    def _begin(self, frame: Frame) -> None:
        for camera, image in frame.images.items():
            if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
                raise SourceError(
                    f"an image of camera {camera!r} is {image.shape} {image.dtype}; expected "
                    "(H, W, 3) uint8"
                )
            path = self._folder / f"{camera}.mp4"
            self._encoders[camera] = VideoEncoder(
                path, self._codec, FPS, image.shape[0], image.shape[1]
            )
            self.stats[camera] = ImageStats()
            self.features[CAMERA_PREFIX + camera] = image.shape
        for name, value in ((STATE, frame.state), (ACTION, frame.action)):
            if value is not None:
                self._vectors[name] = []
                self.features[name] = value.shape


def _decode(writer: _Writer, start: int | None) -> tuple[dict[str, str], dict[str, str]]:
    """Decode what was written; return the digests over all frames and over the lesson."""
    digests = FeatureDigests()
    lesson: dict[str, str] = {}
    for feature, frames in writer.decoded():
        count = 0
        for image in frames:
            if count == start:
                lesson[feature] = digests.current()[feature]
            digests.update(feature, image)
            count += 1
        if count != writer.length:
            raise BuildError(f"{feature} decodes to {count} frames; {writer.length} were encoded")
    return digests.current(), lesson


def _file_name(feature: str) -> str:
    return feature.rpartition(".")[2]
