"""Stage one episode: select and encode its frames while it is read, decode them again, hash them.

The build keeps a staged episode in a folder, which gets its final name only when it is complete:
an interrupted build resumes from these folders.
"""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.sources import Frame, Recording, Robot
from robomme_interference_data.constants import ACTION, CAMERA_PREFIX, LESSONS, PAPER_UNIT, STATE
from robomme_interference_data.errors import (
    BuildError,
    InterferenceError,
    InvalidOptionError,
    SourceError,
    named,
    naming_options,
    option_names,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Worker
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.records import EpisodeRecord, SpanDigests, lesson_spans
from robomme_interference_data.storage.arrays import (
    FeatureDigests,
    combine,
    digest_spans,
    write_array,
)
from robomme_interference_data.storage.encode import Codec, VideoEncoder, get_codec
from robomme_interference_data.storage.files import canonical_json, read_header, write_json
from robomme_interference_data.storage.limits import MAX_READ_VALUES
from robomme_interference_data.storage.video import iter_frames

from .frame_checks import check_numbers, check_same_shapes, check_shapes
from .frame_selection import NothingToStore, select_frames
from .lerobot_writer import StoredEpisode
from .plan import DatasetPlan, PlannedEpisode
from .statistics import ImageStats

_RECORD = "record.json"
_LAYOUT = 7
"""Version of a staged episode's folder."""


@dataclass(frozen=True)
class Staged:
    """Metadata of a staged episode; `skipped` is the reason if it yields nothing."""

    episode_id: EpisodeId
    skipped: str | None = None
    record: EpisodeRecord | None = None
    features: dict[str, tuple[int, ...]] = field(default_factory=dict)
    stats: dict[str, dict[str, tuple[float, ...]]] = field(default_factory=dict)
    robot: Robot | None = None

    def stored(self, folder: Path) -> StoredEpisode:
        """Return the episode, which yields something, with its files in `folder`."""
        assert self.record is not None and self.robot is not None
        videos = {feature: folder / f"{feature}.mp4" for feature in self.stats}
        return StoredEpisode(
            self.record,
            self.features,
            videos,
            self.stats,
            lambda name: np.load(folder / f"{name}.npy"),
            self.robot,
        )


def staged_name(plan: DatasetPlan, planned: PlannedEpisode) -> str:
    """Return the name of a staged episode's folder: a hash of all that decides its content."""
    number, episode = planned
    codec = get_codec(plan.codec)
    content: dict[str, object] = {
        "kind": plan.kind,
        "source": plan.sources[number].provenance,
        "episode": [str(episode.id), repr(episode.key)],
        "cameras": plan.cameras,
        "codec": [codec.vcodec, codec.pix_fmt, dict(codec.options)],
        "layout": _LAYOUT,
        "fps": plan.fps,
    }
    if plan.unit != PAPER_UNIT:
        content["unit"] = plan.unit
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()[:24]


@dataclass(frozen=True)
class StageTask:
    """Stages episodes one by one, as a task of an executor.

    Attributes:
        plan: The plan of the dataset.
        option_names: How errors name settings, also in another process.
    """

    plan: DatasetPlan
    option_names: Mapping[str, str] = field(default_factory=option_names)

    def __call__(self, task: PlannedEpisode, worker: Worker) -> Staged:
        """Stage one episode, send its files, and return its metadata."""
        with naming_options(self.option_names):
            return self._stage(task, worker)

    def _stage(self, planned: PlannedEpisode, worker: Worker) -> Staged:
        number, episode = planned
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
        """Close the sources."""
        for source in self.plan.sources:
            source.close()

    def _write(self, episode: EpisodeId, recording: Recording, folder: Path) -> Staged:
        codec = get_codec(self.plan.codec)
        fps = recording.robot.at(self.plan.fps)
        writer = _Writer(codec, folder, fps)
        try:
            for frame in select_frames(self.plan.kind, recording, self.plan.unit):
                writer.add(frame)
        except NothingToStore as reason:
            writer.abandon()
            return Staged(episode, str(reason))
        except BaseException:
            writer.abandon()
            raise
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
        # The hashes are those of the decoded frames, which a lossy codec changes.
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
            scene=None if start is None else recording.scene,
        )
        stats = {
            feature: {name: tuple(map(float, values)) for name, values in images.result().items()}
            for feature, images in writer.stats.items()
        }
        recording.robot.check_names(writer.features)
        robot = replace(recording.robot, fps=fps)
        return Staged(episode, None, record, writer.features, stats, robot)


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


class _Writer:
    """Writes the files of a staged episode; all maps are by feature."""

    def __init__(self, codec: Codec, folder: Path, fps: float):
        self._codec, self._folder, self._fps = codec, folder, fps
        self._encoders: dict[str, VideoEncoder] = {}
        self._vectors: dict[str, list[NDArray[np.float32]]] = {}
        self.features: dict[str, tuple[int, ...]] = {}
        self.stats: dict[str, ImageStats] = {}
        self.digests = FeatureDigests()
        self.length = 0

    def add(self, frame: Frame) -> None:
        """Add the next frame, which must have the first one's shapes and finite numbers."""
        images = {CAMERA_PREFIX + camera: image for camera, image in frame.images.items()}
        vectors = {STATE: frame.state} | ({} if frame.action is None else {ACTION: frame.action})
        if not self.length:
            self._begin(images, vectors)
        shapes = {name: value.shape for name, value in (images | vectors).items()}
        check_same_shapes(shapes, self.features, f"stored frame {self.length}")
        for name, image in images.items():
            self._encoders[name].add(image)
            self.stats[name].add(image)
            self.digests.update(name, image)
        for name, value in vectors.items():
            check_numbers(name, value, f"stored frame {self.length}")
            if (self.length + 1) * value.size > MAX_READ_VALUES:
                raise SourceError(
                    f"{name} has {value.size} values in over {self.length} stored frames; expected "
                    f"at most {MAX_READ_VALUES:,} values in an episode",
                    "Leave the episode out, or record fewer values.",
                )
            self._vectors[name].append(value)
            self.digests.update(name, value)
        self.length += 1

    def abandon(self) -> None:
        """Close the unfinished files."""
        for encoder in self._encoders.values():
            encoder.abandon()

    def close(self) -> None:
        try:
            for encoder in self._encoders.values():
                encoder.close()
        except BaseException:
            self.abandon()
            raise
        for name, values in self._vectors.items():
            write_array(self._folder / f"{name}.npy", np.stack(values))

    def decode(self, spans: Sequence[tuple[int, int]]) -> list[dict[str, str]]:
        """Decode the videos; return digests over spans of frames, vectors among them."""
        videos = {
            name: iter_frames(self._folder / f"{name}.mp4", 0, self.length, self._fps)
            for name in self._encoders
        }
        return digest_spans(spans, [*videos.items(), *self._vectors.items()])

    def _begin(
        self, images: dict[str, NDArray[np.uint8]], vectors: dict[str, NDArray[np.float32]]
    ) -> None:
        check_shapes(images, vectors)
        for name, image in images.items():
            path = self._folder / f"{name}.mp4"
            self._encoders[name] = VideoEncoder(
                path, self._codec, self._fps, len(image), image.shape[1]
            )
            self.stats[name] = ImageStats()
        if not images and not any(value.size for value in vectors.values()):
            raise InvalidOptionError(
                "there is nothing to store: the recording has no states, and no camera is chosen",
                f"Choose {named('cameras')}.",
                option="cameras",
            )
        self._vectors = {name: [] for name in vectors}
        self.features = {name: value.shape for name, value in (images | vectors).items()}
