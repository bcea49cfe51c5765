"""How fast datasets are built, against the bare video encoder on the same frames.

Recorded demonstrations are encoded by PyAV alone, then by more and more of the build, in turn.
All numbers are per processor core; a frame is one time step with all its cameras.
"""

import argparse
import itertools
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
from common import Times, interleave, positive, print_machine, print_table, run

from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.dataset.frame_selection import select_demonstration
from robomme_interference_data.build_dataset.dataset.lerobot_writer import (
    load_lerobot,
    require_lerobot,
)
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan, PlannedEpisode
from robomme_interference_data.build_dataset.dataset.stage import StageTask
from robomme_interference_data.build_dataset.plan.episodes import choose_episodes
from robomme_interference_data.build_dataset.sources import (
    Frame,
    Recording,
    Source,
    SourceEpisode,
    open_source,
)
from robomme_interference_data.constants import CAMERA_PREFIX, DEMONSTRATIONS, FPS
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Executor, Serial, Worker
from robomme_interference_data.runtime.process import Processes
from robomme_interference_data.storage.arrays import FeatureDigests
from robomme_interference_data.storage.lerobot.statistics import ImageStats
from robomme_interference_data.storage.video.encode import Codec, VideoEncoder, get_codec

RECORDINGS = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
FAMILIES = ("VideoUnmask", "VideoUnmaskSwap", "PatternLock")
AIM = "≥ 0.8"


class Held(Source):
    """A source whose frames are in memory, so that reading costs nothing."""

    def __init__(self, recordings: dict[str, tuple[Recording, list[Frame]]]):
        self.recordings = recordings
        self.provenance = {"kind": "held"}

    def episodes(self) -> list[SourceEpisode]:
        """List nothing: the episodes are given."""
        return []

    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        """Open an episode."""
        recording, frames = self.recordings[str(episode.id)]
        return replace(recording, frames=_each(frames))

    def frames(self, episode: SourceEpisode) -> list[Frame]:
        """Return the frames of an episode."""
        return self.recordings[str(episode.id)][1]


def _each(frames: list[Frame]) -> Generator[Frame]:
    yield from frames


def main() -> None:
    """Measure and print."""
    options = parse_options()
    require_lerobot()
    with tempfile.TemporaryDirectory(prefix="interference-build-") as folder:
        source = open_source(options.source or recordings(Path(folder) / "recordings"))
        print_machine("av", "lerobot")
        measure(source, Path(folder), options)


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--source",
        help="KIND:LOCATION of demonstrations; by default RoboMME's recordings in ../shared/data, "
        "else a sample made now",
    )
    parser.add_argument("--codec", default="av1-lossless", help="as of the build")
    parser.add_argument("--rounds", type=positive, default=3, help="timed repetitions")
    parser.add_argument(
        "--workers", type=positive, default=2, help="processes of the last measurement"
    )
    return parser.parse_args()


def recordings(folder: Path) -> str:
    """Lay out recordings to build from; return them as a source."""
    folder.mkdir()
    if (RECORDINGS / "unpack_h5.py").is_file():
        unpack = [sys.executable, str(RECORDINGS / "unpack_h5.py"), str(folder), *FAMILIES]
        subprocess.run(unpack, check=True, stdout=subprocess.DEVNULL)
        return f"robomme-h5:{folder}"
    return "sample:" + ",".join(FAMILIES)


def measure(source: Source, folder: Path, options: argparse.Namespace) -> None:
    """Time the steps of a build on all demonstrations of a source; print the table."""
    codec, workers = get_codec(options.codec), options.workers
    episodes = tuple(episode for _, episode in choose_episodes([source]))
    held = Held({str(episode.id): read(source, episode) for episode in episodes})
    cameras = tuple(sorted(held.frames(episodes[0])[0].images))
    count = sum(len(held.frames(episode)) for episode in episodes)
    began = time.perf_counter()
    load_lerobot()
    importing = time.perf_counter() - began
    numbers = itertools.count()

    def place() -> Path:
        made = folder / str(next(numbers))
        made.mkdir()
        return made

    def plan(source: Source) -> DatasetPlan:
        tasks = tuple(PlannedEpisode(0, episode) for episode in episodes)
        return DatasetPlan(DEMONSTRATIONS, (source,), tasks, cameras, codec.name)

    def stage(source: Source) -> None:
        task = StageTask(plan(source))
        for episode in episodes:
            task(PlannedEpisode(0, episode), Worker(0))

    def build(executor: Executor) -> None:
        build_dataset(plan(source), place() / "out", executor, WorkProgress(quiet=True))

    times = interleave(
        {
            "bare": lambda: encode_bare(episodes, held, cameras, codec, place()),
            "encode": lambda: encode_hashed(episodes, held, cameras, codec, place()),
            "verify": lambda: stage(held),
            "read": lambda: stage(source),
            "build": lambda: build(Serial()),
            "parallel": lambda: build(Processes(workers)),
        },
        options.rounds,
    )
    rows = [
        row(times, count, *step)
        for step in (
            ("bare", "bare encoder (PyAV)", 1, ""),
            ("encode", "encode, hash, statistics", 1, AIM),
            ("verify", "… and decode again to verify", 1, AIM),
            ("read", "… and read the recording", 1, ""),
            ("build", "whole build, 1 process", 1, AIM),
            ("parallel", f"whole build, {workers} processes", workers, ""),
        )
    ]
    title = (
        f"{len(episodes)} demonstrations, {count:,} frames of {' and '.join(cameras)}, "
        f"{codec.name}; medians of {options.rounds} rounds. Importing lerobot took {importing:.1f} "
        "s, once a build, and is left out."
    )
    columns = ("<step", ">ms a frame", ">frames/s", ">of bare", ">aim")
    print_table(title, columns, rows)


def row(times: Times, count: int, way: str, text: str, cores: int, aim: str) -> list[str]:
    """Return the cells of a step that kept so many cores for itself."""
    each = times.median(way) * cores / count
    share = times.ratio("bare", way) / cores
    return [text, f"{1000 * each:.1f}", f"{1 / each:.1f}", f"{share:.2f}", aim]


def read(source: Source, episode: SourceEpisode) -> tuple[Recording, list[Frame]]:
    """Read the demonstration of an episode into memory."""
    recording = source.read(episode, None)
    return recording, list(select_demonstration(recording.frames))


def path_of(folder: Path, episode: SourceEpisode, camera: str) -> Path:
    """Return where a video goes."""
    return folder / f"{str(episode.id).replace('/', '-')}-{camera}.mp4"


def encode_bare(
    episodes: Sequence[SourceEpisode],
    held: Held,
    cameras: tuple[str, ...],
    codec: Codec,
    folder: Path,
) -> None:
    """Encode all frames with nothing but PyAV, on one thread."""
    for episode in episodes:
        frames = held.frames(episode)
        for camera in cameras:
            with av.open(str(path_of(folder, episode, camera)), "w") as container:
                stream = container.add_stream(codec.vcodec, rate=FPS, options=dict(codec.options))
                stream.pix_fmt = codec.pix_fmt
                stream.height, stream.width = frames[0].images[camera].shape[:2]
                stream.codec_context.thread_count = 1
                for number, frame in enumerate(frames):
                    picture = av.VideoFrame.from_ndarray(frame.images[camera], format="rgb24")
                    picture.pts, picture.time_base = number, Fraction(1, FPS)
                    container.mux(stream.encode(picture))
                container.mux(stream.encode(None))


def encode_hashed(
    episodes: Sequence[SourceEpisode],
    held: Held,
    cameras: tuple[str, ...],
    codec: Codec,
    folder: Path,
) -> None:
    """Encode, hash and count all frames, as staging does before it decodes them again."""
    for episode in episodes:
        frames = held.frames(episode)
        encoders = {
            camera: VideoEncoder(
                path_of(folder, episode, camera), codec, FPS, *frames[0].images[camera].shape[:2]
            )
            for camera in cameras
        }
        stats = {camera: ImageStats() for camera in cameras}
        digests = FeatureDigests()
        for frame in frames:
            for camera, encoder in encoders.items():
                image = frame.images[camera]
                encoder.add(image)
                stats[camera].add(image)
                digests.update(CAMERA_PREFIX + camera, image)
        for encoder in encoders.values():
            encoder.close()
        digests.current()


if __name__ == "__main__":
    run(main)
