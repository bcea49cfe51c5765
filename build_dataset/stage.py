"""Stage one episode: cut and encode it while it is read, decode it again, record its hashes.

A staged episode is handed to the build, which keeps it in a folder that appears under its final
name only when it is complete: an interrupted build goes on from the folders that it finds.
"""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION, CAMERA_PREFIX, FPS, LESSONS, STATE
from robomme_interference_data.errors import BuildError, InterferenceError, SourceError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Worker
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.records import EpisodeRecord, SpanDigests, lesson_spans
from robomme_interference_data.storage.arrays import (
    FeatureDigests,
    SpanDigester,
    combine,
    write_array,
)
from robomme_interference_data.storage.encode import Codec, VideoEncoder, get_codec
from robomme_interference_data.storage.files import canonical_json, read_header, write_json
from robomme_interference_data.storage.video import iter_frames

from .config import BuildPlan
from .frame_selection import FRAME_SELECTORS, NothingToStore
from .image_stats import STATISTICS, ImageStats
from .lerobot_writer import StoredEpisode
from .sources import Frame, Recording, SourceEpisode

_RECORD = "record.json"
_LAYOUT = 5
"""Version of a staged episode's folder."""

Task = tuple[int, SourceEpisode]
"""The number of its source, and an episode."""


@dataclass(frozen=True)
class Staged:
    """What is known of a staged episode.

    Attributes:
        skipped: Why the episode yields nothing; None if it yields something.
        record: What a dataset says of it, at whatever place; None if it yields nothing.
        features: Shape of one value by feature.
        stats: Image statistics by feature, see `ImageStats`.
    """

    episode_id: EpisodeId
    skipped: str | None
    record: EpisodeRecord | None
    features: dict[str, tuple[int, ...]]
    stats: dict[str, dict[str, tuple[float, ...]]]

    def stored(self, folder: Path) -> StoredEpisode:
        """Return the episode, which yields something, in the folder that it was staged in."""
        assert self.record is not None
        # In this order whether it was staged just now or read again: columns follow it.
        stats = {
            feature: {name: np.array(values[name]) for name in STATISTICS}
            for feature, values in self.stats.items()
        }
        for values in stats.values():
            values["count"] = values["count"].astype(np.int64)
        videos = {feature: folder / f"{feature}.mp4" for feature in stats}
        return StoredEpisode(
            self.record, self.features, videos, stats, lambda name: np.load(folder / f"{name}.npy")
        )


def staged_name(plan: BuildPlan, task: Task) -> str:
    """Return the name of a staged episode's folder: a hash of all that decides it."""
    number, episode = task
    codec = get_codec(plan.codec)
    content = {
        "kind": plan.kind,
        "source": plan.sources[number].provenance,
        "episode": [str(episode.id), repr(episode.key)],
        "cameras": plan.cameras,
        "codec": [codec.vcodec, codec.pix_fmt, dict(codec.options)],
        "layout": _LAYOUT,
    }
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()[:24]


@dataclass(frozen=True)
class StageTask:
    """Stages one episode after the other, as a task of an executor.

    Attributes:
        plan: What to build.
    """

    plan: BuildPlan

    def __call__(self, task: Task, worker: Worker) -> Staged:
        """Cut, encode and check one episode, send its files, and return what is known of it."""
        number, episode = task
        with tempfile.TemporaryDirectory(dir=worker.folder) as name:
            folder = Path(name)
            try:
                recording = self.plan.sources[number].read(episode, self.plan.cameras)
                with closing(recording.frames):
                    staged = self._write(episode.id, recording, folder)
            except InterferenceError as error:
                raise error.about(episode.id) from error
            if staged.skipped is None:
                for path in sorted(folder.iterdir()):
                    worker.send_file(path.name, path.read_bytes())
        return staged

    def close(self) -> None:
        """Release what sources hold."""
        for source in self.plan.sources:
            source.close()

    def _write(self, episode: EpisodeId, recording: Recording, folder: Path) -> Staged:
        codec = get_codec(self.plan.codec)
        writer = _Writer(codec, folder)
        try:
            for frame in FRAME_SELECTORS[self.plan.kind](recording.frames):
                writer.add(frame)
        except NothingToStore as reason:
            writer.close()
            return Staged(episode, str(reason), None, {}, {})
        writer.close()
        start = writer.length - 1 if self.plan.kind in LESSONS else None
        spans = {} if start is None else lesson_spans(start)
        whole, session, *parts = writer.decode(
            [(0, writer.length), (0, writer.length if start is None else start), *spans.values()]
        )
        if codec.exact and whole != writer.digests.current():
            raise BuildError(
                f"a video does not decode to the frames that were encoded with {codec.name}",
                "Please report this with the versions of the libraries.",
                "doctor",
            )
        # Of a lossy codec, what a reader gets is what is hashed.
        record = EpisodeRecord(
            episode_index=0,
            episode_id=episode,
            length=writer.length,
            goals=recording.goals,
            seed=recording.seed,
            difficulty=recording.difficulty,
            simulator=recording.simulator,
            exec_start_idx=start,
            exact=recording.exact and codec.exact,
            feature_sha256=session,
            span_sha256=SpanDigests(*map(combine, parts)) if parts else None,
            evidence=None if start is None else recording.evidence,
        )
        stats = {
            feature: {name: tuple(map(float, values)) for name, values in one.result().items()}
            for feature, one in writer.stats.items()
        }
        return Staged(episode, None, record, writer.features, stats)


def keep_staged(folder: Path, staged: Staged, files: Mapping[str, bytes]) -> None:
    """Write a staged episode and its files into a folder, which appears when it is complete."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    try:
        for name, data in files.items():
            (partial / name).write_bytes(data)
        write_json(partial / _RECORD, to_dict(staged))
        for path in partial.iterdir():  # the data must reach the disk before the name does
            with path.open("rb") as file:
                os.fsync(file.fileno())
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def read_staged(folder: Path) -> Staged | None:
    """Return what is known of the episode that a folder holds; None if there is no such folder."""
    path = folder / _RECORD
    return read_header(path, Staged) if path.is_file() else None


class _Writer:
    """The files of a staged episode while they are written; all maps are by feature."""

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
        """Take the next frame, which must be as the first one and hold finite numbers."""
        images = {CAMERA_PREFIX + camera: image for camera, image in frame.images.items()}
        vectors = {STATE: frame.state} | ({} if frame.action is None else {ACTION: frame.action})
        if not self.length:
            self._begin(images, vectors)
        shapes = {name: value.shape for name, value in (images | vectors).items()}
        if shapes != self.features:
            raise SourceError(
                f"stored frame {self.length} has {shapes}; the first one {self.features}",
                "All frames of an episode must have the same cameras and sizes.",
            )
        for name, image in images.items():
            self._encoders[name].add(image)
            self.stats[name].add(image)
            self.digests.update(name, image)
        for name, value in vectors.items():
            if value.dtype != np.float32 or not np.isfinite(value).all():
                raise SourceError(
                    f"{name} of stored frame {self.length} is {value.tolist()}; expected finite "
                    "float32 numbers",
                    "Mend the recording, or leave the episode out with `episodes`.",
                )
            self._vectors[name].append(value)
            self.digests.update(name, value)
        self.length += 1

    def close(self) -> None:
        for encoder in self._encoders.values():
            encoder.close()
        for name, values in self._vectors.items():
            write_array(self._folder / f"{name}.npy", np.stack(values))

    def decode(self, spans: Sequence[tuple[int, int]]) -> list[dict[str, str]]:
        """Decode the videos; return digests over spans of frames, vectors among them."""
        digests = SpanDigester(spans)
        for name in self._encoders:
            images = iter_frames(self._folder / f"{name}.mp4", 0, self.length, FPS)
            for index, image in enumerate(images):
                digests.update(name, index, image)
        for name, values in self._vectors.items():
            for index, value in enumerate(values):
                digests.update(name, index, value)
        return digests.digests()

    def _begin(
        self, images: dict[str, NDArray[np.uint8]], vectors: dict[str, NDArray[np.float32]]
    ) -> None:
        for name, image in images.items():
            if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
                raise SourceError(
                    f"{name} holds images {image.shape} {image.dtype}; expected (H, W, 3) uint8"
                )
            path = self._folder / f"{name}.mp4"
            self._encoders[name] = VideoEncoder(path, self._codec, FPS, len(image), image.shape[1])
            self.stats[name] = ImageStats()
        self._vectors = {name: [] for name in vectors}
        self.features = {name: value.shape for name, value in (images | vectors).items()}
