"""Stage one episode: encode it beside the build, decode it again, and record its hashes.

A staged episode is a folder that appears under its final name only when it is complete and
checked, so an interrupted build goes on from the folders that it finds.
"""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.encode import Codec, ImageStats, VideoEncoder
from robomme_interference_data.build_dataset.plan import PlannedEpisode
from robomme_interference_data.build_dataset.sources.base import Frame, Source
from robomme_interference_data.constants import ACTION, CAMERA_PREFIX, STATE
from robomme_interference_data.digest import FeatureDigests
from robomme_interference_data.errors import BuildError, SourceError
from robomme_interference_data.files import canonical_json
from robomme_interference_data.video import iter_frames

__all__ = ["StagedEpisode", "read_staged", "stage_episode", "stage_name"]

_RECORD = "record.json"


@dataclass(frozen=True)
class StagedEpisode:
    """A staged episode.

    Attributes:
        folder: Folder with `<camera>.mp4`, `state.npy`, `action.npy` (if there are actions).
        length: Stored frames.
        feature_sha256: Digest over all frames by feature.
        lesson_feature_sha256: Digest over the frames before the query frame; empty in a unit.
        stats: Image statistics by feature.
    """

    folder: Path
    length: int
    feature_sha256: dict[str, str]
    lesson_feature_sha256: dict[str, str]
    stats: dict[str, dict[str, list[float]]]

    def video(self, camera: str) -> Path:
        """Return the video file of a camera."""
        return self.folder / f"{camera}.mp4"

    def vectors(self, feature: str) -> NDArray[np.float32]:
        """Read states or actions, `(T, D) float32`."""
        values: NDArray[np.float32] = np.load(self.folder / f"{_file_name(feature)}.npy")
        return values


def stage_name(planned: PlannedEpisode, cameras: tuple[str, ...], codec: Codec) -> str:
    """Return the folder name of a staged episode: a hash of all that decides its content."""
    episode = asdict(planned.episode)
    content = {
        "episode": {**episode, "id": str(planned.episode.id), "key": repr(planned.episode.key)},
        "indices": [planned.indices.start, planned.indices.stop, planned.indices.step],
        "exec_start_idx": planned.exec_start_idx,
        "cameras": list(cameras),
        "codec": [codec.vcodec, codec.pix_fmt, dict(codec.options)],
        "layout": 1,
    }
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()[:24]


def read_staged(folder: Path) -> StagedEpisode | None:
    """Return the staged episode in a folder; None if there is no such folder."""
    try:
        record = json.loads((folder / _RECORD).read_text())
    except FileNotFoundError:
        return None
    return StagedEpisode(folder=folder, **record)


def stage_episode(
    source: Source,
    planned: PlannedEpisode,
    cameras: tuple[str, ...],
    codec: Codec,
    fps: int,
    folder: Path,
) -> StagedEpisode:
    """Encode, check and record one episode.

    Args:
        source: Source to read from.
        planned: The episode and which of its frames.
        cameras: Cameras to store.
        codec: Video settings.
        fps: Frame rate of the dataset, in Hz.
        folder: Where the staged episode appears when complete; left as it is if it exists.

    Raises:
        SourceError: The recording breaks off or contradicts what its source listed.
        BuildError: A video does not decode to what went in.
    """
    done = read_staged(folder)
    if done is not None:
        return done
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    try:
        record = _write(source, planned, cameras, codec, fps, partial)
        (partial / _RECORD).write_text(json.dumps(record))
        for path in partial.iterdir():  # the data must reach the disk before the name does
            with path.open("rb") as file:
                os.fsync(file.fileno())
        try:
            partial.rename(folder)
        except OSError:  # another process staged the same episode meanwhile
            if read_staged(folder) is None:
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return StagedEpisode(folder=folder, **record)


def _write(
    source: Source,
    planned: PlannedEpisode,
    cameras: tuple[str, ...],
    codec: Codec,
    fps: int,
    folder: Path,
) -> dict[str, Any]:
    writer = _Writer(planned, cameras, codec, fps, folder)
    lesson: dict[str, str] = {}
    for position, frame in enumerate(_chosen(source, planned)):
        if position == planned.exec_start_idx:
            lesson = writer.digests.current()
        _check(planned, position, frame)
        writer.add(frame)
    writer.close()
    written = writer.digests.current()
    decoded, decoded_lesson = _decode(planned, cameras, fps, folder)
    if codec.exact:
        for feature, digest in decoded.items():
            if digest != written[feature]:
                raise BuildError(
                    f"{planned.episode.id}: {feature} does not decode to the frames that were "
                    f"encoded with {codec.name}",
                    "Please report this with the versions that robomme-interference doctor prints.",
                )
    else:  # what a reader gets is what is hashed
        written |= decoded
        lesson |= decoded_lesson
    return {
        "length": len(planned.indices),
        "feature_sha256": written,
        "lesson_feature_sha256": lesson,
        "stats": {
            CAMERA_PREFIX + camera: {name: v.tolist() for name, v in stat.result().items()}
            for camera, stat in writer.stats.items()
        },
    }


class _Writer:
    """The files of a staged episode while they are written."""

    def __init__(
        self,
        planned: PlannedEpisode,
        cameras: tuple[str, ...],
        codec: Codec,
        fps: int,
        folder: Path,
    ):
        self._folder = folder
        sizes = planned.episode.cameras
        self._encoders = {
            camera: VideoEncoder(folder / f"{camera}.mp4", codec, fps, *sizes[camera])
            for camera in cameras
        }
        self._vectors: dict[str, list[NDArray[np.float32]]] = {STATE: []}
        if planned.episode.action_size is not None:
            self._vectors[ACTION] = []
        self.stats = {camera: ImageStats() for camera in cameras}
        self.digests = FeatureDigests()

    def add(self, frame: Frame) -> None:
        for camera, encoder in self._encoders.items():
            image = frame.images[camera]
            encoder.add(image)
            self.stats[camera].add(image)
            self.digests.update(CAMERA_PREFIX + camera, image)
        for feature, value in ((STATE, frame.state), (ACTION, frame.action)):
            if feature in self._vectors and value is not None:
                self._vectors[feature].append(value)
                self.digests.update(feature, value)

    def close(self) -> None:
        for encoder in self._encoders.values():
            encoder.close()
        for feature, values in self._vectors.items():
            np.save(self._folder / f"{_file_name(feature)}.npy", np.stack(values))


def _chosen(source: Source, planned: PlannedEpisode) -> Iterator[Frame]:
    """Yield the planned frames of an episode, reading no further than the last."""
    count = 0
    frames = source.read(planned.episode)
    with closing(frames):
        for index, frame in enumerate(frames):
            if index in planned.indices:
                yield frame
                count += 1
                if count == len(planned.indices):
                    return
    raise SourceError(
        f"{planned.episode.id}: the recording ends after {count} of the {len(planned.indices)} "
        "frames that are needed",
        "Record or download it again, or leave the episode out: --episodes",
    )


def _check(planned: PlannedEpisode, position: int, frame: Frame) -> None:
    episode = planned.episode
    found: dict[str, NDArray[Any] | None] = {
        camera: frame.images.get(camera) for camera in episode.cameras
    }
    found |= {"state": frame.state, "action": frame.action}
    expected = {camera: f"{(*size, 3)} uint8" for camera, size in episode.cameras.items()}
    expected["state"] = f"({episode.state_size},) float32"
    expected["action"] = (
        "None" if episode.action_size is None else f"({episode.action_size},) float32"
    )
    for name, values in found.items():
        kind = "None" if values is None else f"{values.shape} {values.dtype}"
        if kind != expected[name]:
            raise SourceError(
                f"{episode.id}: {name} of frame {planned.indices[position]} is {kind}; the source "
                f"says {expected[name]}"
            )
    if planned.exec_start_idx is not None and frame.is_demonstration == (
        position >= planned.exec_start_idx
    ):
        raise SourceError(
            f"{episode.id}: frame {position} contradicts the demonstration length of "
            f"{planned.exec_start_idx} that the source gives"
        )


def _decode(
    planned: PlannedEpisode, cameras: tuple[str, ...], fps: int, folder: Path
) -> tuple[dict[str, str], dict[str, str]]:
    """Decode what was written; return the digests over all frames and over the lesson."""
    digests = FeatureDigests()
    lesson: dict[str, str] = {}
    for camera in cameras:
        path = folder / f"{camera}.mp4"
        feature = CAMERA_PREFIX + camera
        for position, image in enumerate(iter_frames(path, 0, None, fps)):
            if position == planned.exec_start_idx:
                lesson[feature] = digests.current()[feature]
            digests.update(feature, image)
        if position + 1 != len(planned.indices):
            raise BuildError(
                f"{planned.episode.id}: {feature} decodes to {position + 1} frames; "
                f"{len(planned.indices)} were encoded"
            )
    return digests.current(), lesson


def _file_name(feature: str) -> str:
    return feature.rpartition(".")[2]
