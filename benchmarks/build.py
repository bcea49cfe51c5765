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
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
from timing import Times, interleave, machine, positive, table

from robomme_interference_data.build_dataset.build import Filters, Settings, build_dataset
from robomme_interference_data.build_dataset.encode import (
    Codec,
    ImageStats,
    VideoEncoder,
    get_codec,
)
from robomme_interference_data.build_dataset.plan import PlannedEpisode, plan_dataset
from robomme_interference_data.build_dataset.sample import write_sample
from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.build_dataset.sources.base import Frame, Source, SourceEpisode
from robomme_interference_data.build_dataset.stage import stage_episode
from robomme_interference_data.build_dataset.writer import load_lerobot, require_lerobot
from robomme_interference_data.constants import CAMERA_PREFIX, DEMONSTRATIONS, FPS
from robomme_interference_data.digest import FeatureDigests
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.progress import BuildProgress

RECORDINGS = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
FAMILIES = ("VideoUnmask", "VideoUnmaskSwap", "PatternLock")
AIM = "≥ 0.8"


@dataclass
class Held:
    """A source whose frames are in memory, so that reading costs nothing."""

    frames: dict[str, list[Frame]]
    kind: str = "held"
    provenance: dict[str, Any] = field(default_factory=lambda: {"kind": "held"})

    def episodes(self) -> list[SourceEpisode]:
        """List nothing: the planned episodes are given."""
        return []

    def read(self, episode: SourceEpisode) -> Generator[Frame]:
        """Yield the frames of an episode."""
        yield from self.frames[str(episode.id)]


def main() -> None:
    """Measure and print."""
    options = parse_options()
    try:
        require_lerobot()
        with tempfile.TemporaryDirectory(prefix="interference-build-") as folder:
            source = open_source(options.source or recordings(Path(folder) / "recordings"))
            print(machine("av", "lerobot"), end="\n\n", flush=True)
            print(measure(source, Path(folder), options))
    except InterferenceError as error:
        sys.exit(str(error))


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
    for _ in write_sample(folder, families=FAMILIES):
        pass
    return f"frames:{folder}"


def measure(source: Source, folder: Path, options: argparse.Namespace) -> str:
    """Time the steps of a build on all demonstrations of a source; return the table."""
    codec, workers = get_codec(options.codec), options.workers
    planned = plan_dataset(DEMONSTRATIONS, [source.episodes()]).episodes
    held = Held({str(p.episode.id): read(source, p) for p in planned})
    cameras = tuple(sorted(planned[0].episode.cameras))
    count = sum(len(item.indices) for item in planned)
    began = time.perf_counter()
    load_lerobot()
    importing = time.perf_counter() - began
    numbers = itertools.count()

    def place() -> Path:
        made = folder / str(next(numbers))
        made.mkdir()
        return made

    def stage(source: Source) -> None:
        target = place()
        for item in planned:
            stage_episode(source, item, cameras, codec, FPS, target / name_of(item))

    def build(workers: int) -> None:
        settings = Settings(codec, workers=workers)
        quiet = BuildProgress(quiet=True)
        build_dataset(DEMONSTRATIONS, [source], place() / "out", Filters(), settings, quiet)

    times = interleave(
        {
            "bare": lambda: encode_bare(planned, held, cameras, codec, place()),
            "encode": lambda: encode_hashed(planned, held, cameras, codec, place()),
            "verify": lambda: stage(held),
            "read": lambda: stage(source),
            "build": lambda: build(1),
            "parallel": lambda: build(workers),
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
        f"{len(planned)} demonstrations, {count:,} frames of {' and '.join(cameras)}, "
        f"{codec.name}; medians of {options.rounds} rounds. Importing lerobot took {importing:.1f} "
        "s, once a build, and is left out."
    )
    columns = ("<step", ">ms a frame", ">frames/s", ">of bare", ">aim")
    return table(title, columns, rows)


def row(times: Times, count: int, way: str, text: str, cores: int, aim: str) -> list[str]:
    """Return the cells of a step that kept so many cores for itself."""
    each = times.median(way) * cores / count
    share = times.ratio("bare", way) / cores
    return [text, f"{1000 * each:.1f}", f"{1 / each:.1f}", f"{share:.2f}", aim]


def read(source: Source, planned: PlannedEpisode) -> list[Frame]:
    """Read the planned frames of an episode, which are its first ones."""
    return list(itertools.islice(source.read(planned.episode), len(planned.indices)))


def name_of(planned: PlannedEpisode) -> str:
    """Return a file name for an episode."""
    return str(planned.episode.id).replace("/", "-")


def encode_bare(
    planned: Sequence[PlannedEpisode],
    held: Held,
    cameras: tuple[str, ...],
    codec: Codec,
    folder: Path,
) -> None:
    """Encode all frames with nothing but PyAV, on one thread."""
    for item in planned:
        for camera in cameras:
            with av.open(str(folder / f"{name_of(item)}-{camera}.mp4"), "w") as container:
                stream = container.add_stream(codec.vcodec, rate=FPS, options=dict(codec.options))
                stream.pix_fmt = codec.pix_fmt
                stream.height, stream.width = item.episode.cameras[camera]
                stream.codec_context.thread_count = 1
                for number, frame in enumerate(held.read(item.episode)):
                    picture = av.VideoFrame.from_ndarray(frame.images[camera], format="rgb24")
                    picture.pts, picture.time_base = number, Fraction(1, FPS)
                    container.mux(stream.encode(picture))
                container.mux(stream.encode(None))


def encode_hashed(
    planned: Sequence[PlannedEpisode],
    held: Held,
    cameras: tuple[str, ...],
    codec: Codec,
    folder: Path,
) -> None:
    """Encode, hash and count all frames, as staging does before it decodes them again."""
    for item in planned:
        sizes = item.episode.cameras
        encoders = {
            camera: VideoEncoder(
                folder / f"{name_of(item)}-{camera}.mp4", codec, FPS, *sizes[camera]
            )
            for camera in cameras
        }
        stats = {camera: ImageStats() for camera in cameras}
        digests = FeatureDigests()
        for frame in held.read(item.episode):
            for camera, encoder in encoders.items():
                image = frame.images[camera]
                encoder.add(image)
                stats[camera].add(image)
                digests.update(CAMERA_PREFIX + camera, image)
        for encoder in encoders.values():
            encoder.close()
        digests.current()


if __name__ == "__main__":
    main()
