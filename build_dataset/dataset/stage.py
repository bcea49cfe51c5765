"""Stage one episode: select and encode its frames while it is read, decode them again, hash them.

`staged.py` keeps its files in a folder.
"""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.sources import Frame, Recording
from robomme_interference_data.build_dataset.sources.simulator import SimulatorSource
from robomme_interference_data.constants import ACTION, CAMERA_PREFIX, LESSONS, STATE, UNITS
from robomme_interference_data.errors import (
    BuildError,
    InterferenceError,
    SourceError,
    naming_options,
    option_names,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Worker
from robomme_interference_data.schema.records import Day, EpisodeRecord, SpanDigests, lesson_spans
from robomme_interference_data.simulators.registry import simulator_renderer, simulator_versions
from robomme_interference_data.storage.arrays import (
    FeatureDigests,
    combine,
    digest_spans,
    write_array,
)
from robomme_interference_data.storage.lerobot.statistics import ImageStats
from robomme_interference_data.storage.limits import MAX_READ_VALUES
from robomme_interference_data.storage.video.encode import Codec, VideoEncoder, get_codec
from robomme_interference_data.storage.video.frames import iter_frames

from .frame_checks import check_image, check_numbers, check_same_shapes, check_shapes
from .frame_selection import NothingToStore, select_episodes, too_short, unit_starts
from .plan import DatasetPlan, PlannedEpisode
from .resize import Resize
from .staged import Staged, StagedEpisode, staged_file


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
        episodes = []
        try:
            starts = self._starts(planned)
            recording = self.plan.sources[number].read(episode, self.plan.cameras)
            with closing(recording.frames):
                for start, frames in select_episodes(
                    self.plan.kind, recording, self.plan.unit, starts
                ):
                    with tempfile.TemporaryDirectory(dir=worker.folder) as name:
                        folder, stored = Path(name), replace(episode.id, start=start)
                        made = self._write(stored, recording, frames, folder)
                        record = replace(made.record, ability=episode.ability)
                        episodes.append(replace(made, record=record))
                        for path in sorted(folder.iterdir()):
                            worker.send_file(staged_file(start, path.name), path.read_bytes())
        except NothingToStore as reason:
            if episodes:
                raise SourceError(f"it became shorter while it was read: {reason}") from None
            return Staged(episode.id, str(reason))
        except InterferenceError as error:
            raise error.about(episode.id) from error
        return Staged(episode.id, None, tuple(episodes))

    def _starts(self, planned: PlannedEpisode) -> Sequence[int]:
        """Return the first raw frames of what is stored of an episode."""
        number, episode = planned
        unit = self.plan.unit
        if self.plan.kind not in UNITS or unit.per_episode == 1:
            return (0,)
        # How long it is shows at its end: its frames are counted first, without images.
        counted = self.plan.sources[number].read(episode, ())
        with closing(counted.frames):
            length = sum(1 for _ in counted.frames)
        starts = unit_starts(length, unit)
        if not starts:
            raise too_short(length, unit)
        return starts

    def describe(self) -> dict[str, str]:
        """Return what simulators report on this machine: all nodes of a cluster build alike."""
        described: dict[str, str] = {}
        for source in self.plan.sources:
            if isinstance(source, SimulatorSource):
                simulator, python = source.name, source.python
                described |= simulator_versions(simulator, python)
                described[f"renderer of {simulator}"] = str(simulator_renderer(simulator, python))
        return described

    def close(self) -> None:
        """Close the sources."""
        for source in self.plan.sources:
            source.close()

    def _write(
        self, episode: EpisodeId, recording: Recording, frames: Iterator[Frame], folder: Path
    ) -> StagedEpisode:
        """Write the files of a stored episode; return its metadata."""
        codec = get_codec(self.plan.codec)
        fps = recording.robot.at(self.plan.fps)
        writer = _Writer(codec, folder, fps, self.plan.resize)
        try:
            for frame in frames:
                writer.add(frame)
        except BaseException:
            writer.abandon()
            raise
        writer.close()
        start = writer.length - 1 if self.plan.kind in LESSONS else None
        spans = {} if start is None else lesson_spans(start)
        day = None if recording.day is None else recording.day()
        tasks = () if day is None else day.spans
        whole, session, *parts = writer.decode(
            [
                (0, writer.length),
                (0, writer.length if start is None else start),
                *spans.values(),
                *((span.start, span.stop) for span in tasks),
            ]
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
            exact=recording.exact and codec.exact and not writer.resized,
            feature_sha256=session,
            span_sha256=SpanDigests(*map(combine, parts)) if spans else None,
            evidence=None if start is None else recording.evidence,
            scene=None if start is None else recording.scene,
            day=None if day is None else _with_digests(day, parts),
        )
        stats = {
            feature: {name: tuple(map(float, values)) for name, values in images.result().items()}
            for feature, images in writer.stats.items()
        }
        recording.robot.check_names(writer.features)
        robot = replace(recording.robot, fps=fps)
        return StagedEpisode(record, writer.features, stats, robot)


def _with_digests(day: Day, parts: Sequence[dict[str, str]]) -> Day:
    """Return a day with the digests of its spans."""
    spans = (
        replace(span, sha256=combine(part)) for span, part in zip(day.spans, parts, strict=True)
    )
    return replace(day, spans=tuple(spans))


class _Writer:
    """Writes the files of a staged episode; all maps are by feature.

    Attributes:
        features: Shapes of the stored values.
        stats: Statistics of the stored images.
        digests: Digests of what was stored.
        length: Number of frames.
        resized: Whether a stored image is not the recorded one.
    """

    def __init__(self, codec: Codec, folder: Path, fps: float, resize: Resize | None):
        self._codec, self._folder, self._fps, self._resize = codec, folder, fps, resize
        self._recorded: dict[str, tuple[int, ...]] = {}  # shapes before images are resized
        self._encoders: dict[str, VideoEncoder] = {}
        self._vectors: dict[str, list[NDArray[np.float32]]] = {}
        self.features: dict[str, tuple[int, ...]] = {}
        self.stats: dict[str, ImageStats] = {}
        self.digests = FeatureDigests()
        self.length = 0
        self.resized = False

    def add(self, frame: Frame) -> None:
        """Add the next frame, which must have the first one's shapes and finite numbers."""
        images = {CAMERA_PREFIX + camera: image for camera, image in frame.images.items()}
        vectors = {STATE: frame.state} | ({} if frame.action is None else {ACTION: frame.action})
        shapes = {name: value.shape for name, value in (images | vectors).items()}
        if not self.length:
            for name, image in images.items():
                check_image(name, image)  # before it is resized
            self._recorded = shapes
        check_same_shapes(shapes, self._recorded, f"stored frame {self.length}")
        if self._resize is not None:
            images = {name: self._resize.apply(image) for name, image in images.items()}
        if not self.length:
            self._begin(images, vectors)
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
        self._vectors = {name: [] for name in vectors}
        self.features = {name: value.shape for name, value in (images | vectors).items()}
        self.resized = self.features != self._recorded
