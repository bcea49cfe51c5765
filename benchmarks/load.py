"""How fast a history buffer loads, and how much memory streaming it takes.

The front frames of one buffer are loaded by Buffer.frames(), by one bare PyAV decode of the same
spans, and by LeRobotDataset[i], in turn; all give the same pixels, which is checked first.
"""

import argparse
import dataclasses
import logging
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray
from timing import in_fresh_process, interleave, machine, megabytes, peak_memory, positive, table

from robomme_interference_data import Buffer, DecodedCache, Split, load_split
from robomme_interference_data.build_dataset.writer import require_lerobot
from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, FRONT
from robomme_interference_data.errors import InterferenceError

ROOT = Path(__file__).resolve().parent.parent
DEMO_SPLIT = ROOT / "demo" / "split"
TIMES_LONGER = 4
COLUMNS = ("<loading", ">s", "<against", ">s", ">ratio", ">aim")


@dataclass(frozen=True)
class Span:
    """Consecutive frames of a video file, `start` included, `stop` excluded."""

    path: Path
    start: int
    stop: int
    fps: float


def main() -> None:
    """Measure and print."""
    options = parse_options()
    try:
        require_lerobot()
        split = options.split or demo_split()
        buffer, name = choose_buffer(load_split(split, threads=1), options.episode, options.k)
        print(machine("av", "lerobot"), end="\n\n", flush=True)
        print(time_loading(split, buffer, name, options), end="\n\n", flush=True)
        print(measure_streaming(split, buffer, options.chunk))
    except InterferenceError as error:
        sys.exit(str(error))


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--split",
        type=Path,
        help="folder of a split; by default that of make demo, made if need be",
    )
    parser.add_argument(
        "--episode", help="query episode; by default the one with the median lesson length"
    )
    parser.add_argument("--k", type=int, default=7, help="distractor sessions, or the most planned")
    parser.add_argument("--rounds", type=positive, default=7, help="timed repetitions")
    parser.add_argument(
        "--threads", type=positive, default=2, help="threads of the second measurement"
    )
    parser.add_argument(
        "--lerobot-frames",
        type=positive,
        default=48,
        help="frames that LeRobotDataset reads in a round; its time is scaled to the whole buffer",
    )
    parser.add_argument("--chunk", type=positive, default=64, help="frames in a chunk of stream()")
    return parser.parse_args()


def demo_split() -> Path:
    """Return the split of `make demo`, made now if it is not there."""
    if not (DEMO_SPLIT / "manifests" / "manifest.json").is_file():
        demo = [sys.executable, str(ROOT / "scripts" / "demo.py")]
        subprocess.run(demo, check=True, stdout=sys.stderr)
    return DEMO_SPLIT


def choose_buffer(split: Split, episode: str | None, k: int) -> tuple[Buffer, str]:
    """Return the buffer to measure, and its name."""
    k = min(k, max(split.k_values))
    if episode is None:
        lengths = {m.lesson_frames: m.episode_id for m in split.manifests(k=k)}
        episode = str(lengths[statistics.median_low(lengths)])
    return split.load(episode, k), f"{episode} at k{k}"


def time_loading(folder: Path, buffer: Buffer, name: str, options: argparse.Namespace) -> str:
    """Time all ways of loading the front frames; return the table."""
    split = load_split(folder, threads=1)
    episode, k, threads = buffer.episode_id, buffer.k, options.threads
    spans = spans_of(buffer, split)
    wanted = buffer.frames("front")

    def bare() -> None:
        for _image in chain.from_iterable(map(decode, spans)):
            pass

    def bare_kept() -> NDArray[np.uint8]:
        kept = np.empty(wanted.shape, np.uint8)
        for position, image in enumerate(chain.from_iterable(map(decode, spans))):
            kept[position] = image
        return kept

    read_item, items = lerobot_reader(split, buffer)
    # An odd distance: a frame is as likely to be right after a key frame as just before one.
    distance = max(1, len(items) // options.lerobot_frames) | 1
    chosen = range(0, len(items), distance)
    scale = len(items) / len(chosen)
    with tempfile.TemporaryDirectory(prefix="interference-cache-") as cache_folder:
        cache = DecodedCache(Path(cache_folder))
        parallel = load_split(folder, threads=threads).load(episode, k)
        cached = load_split(folder, cache=cache, threads=1).load(episode, k)
        found = [bare_kept(), parallel.frames("front"), cached.frames("front")]
        found += [np.stack([read_item(position) for position in chosen])]
        check_equal(found, [wanted] * 3 + [wanted[chosen]])
        ways: dict[str, Callable[[], object]] = {
            "one": lambda: buffer.frames("front"),
            "bare": bare,
            "several": lambda: parallel.frames("front"),
            "bare, kept": bare_kept,
            "lerobot": lambda: [read_item(position) for position in chosen],
            "cached": lambda: cached.frames("front"),
            "copy": lambda: np.copy(wanted),
        }
        times = interleave(ways, options.rounds)

    ours, plain, item = "Buffer.frames()", "bare PyAV decode", "LeRobotDataset[i], pyav"

    def row(
        way: str, text: str, against: str, other: str, aim: str, factor: float = 1
    ) -> list[str]:
        return [
            text,
            f"{times.median(way) * factor:.3f}",
            other,
            f"{times.median(against):.3f}",
            f"{times.ratio(way, against) * factor:.2f}",
            aim,
        ]

    rows = [
        row("one", f"{ours}, 1 thread", "bare", plain, "≤ 1.1"),
        row("several", f"{ours}, {threads} threads", "bare", plain, "≤ 0.7"),
        row("one", f"{ours}, 1 thread", "bare, kept", f"{plain} into an array", ""),
        row("lerobot", item, "one", f"{ours}, 1 thread", "≥ 15", scale),
        row("lerobot", item, "several", f"{ours}, {threads} threads", "≥ 15", scale),
        row("cached", f"{ours}, cached, 1 thread", "copy", "np.copy", "≤ 3"),
    ]
    title = (
        f"Front frames of {name}: {len(buffer)} frames, {len(buffer.sessions)} sessions; medians "
        f"of {options.rounds} rounds; LeRobotDataset timed on {len(chosen)} frames and scaled."
    )
    return table(title, COLUMNS, rows)


def check_equal(found: list[NDArray[np.uint8]], wanted: list[NDArray[np.uint8]]) -> None:
    """Check that all ways give the same pixels."""
    if not all(map(np.array_equal, found, wanted)):
        sys.exit("The ways of loading give different pixels: their times mean nothing.")


def spans_of(buffer: Buffer, split: Split) -> list[Span]:
    """Return where the front frames of a buffer lie."""
    key = f"videos/{FRONT}/"
    spans = []
    for session in buffer.sessions:
        entry = session.entry
        dataset = split.datasets[entry.dataset]
        row = dataset.episodes.slice(entry.episode_index, 1).to_pylist()[0]
        path = dataset.info["video_path"].format(
            video_key=FRONT,
            chunk_index=row[key + "chunk_index"],
            file_index=row[key + "file_index"],
        )
        fps = dataset.info["fps"]
        first = round(row[key + "from_timestamp"] * fps)
        spans.append(Span(dataset.files.path(path), first + entry.start, first + entry.stop, fps))
    return spans


def decode(span: Span) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames of a span as arrays, as simply and as fast as PyAV can on one thread."""
    with av.open(str(span.path)) as container:
        stream = container.streams.video[0]
        stream.thread_count = 1
        tick = float(stream.time_base) * span.fps
        container.seek(round(span.start / tick), stream=stream)
        for frame in container.decode(stream):
            number = round(frame.pts * tick)
            if number >= span.start:
                yield frame.to_ndarray(format="rgb24")
            if number + 1 >= span.stop:
                return


def lerobot_reader(
    split: Split, buffer: Buffer
) -> tuple[Callable[[int], NDArray[np.uint8]], list[tuple[str, int]]]:
    """Return a function that reads a frame of the buffer through LeRobotDataset, and all frames.

    LeRobotDataset decodes every camera of an item; here it is left with the front camera only.
    """
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    logging.disable(logging.WARNING)
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    opened = {}
    for name in (DEMONSTRATIONS, DISTRACTORS):
        root = split.root / name
        opened[name] = LeRobotDataset(name, root=root, video_backend="pyav", return_uint8=True)
        for camera in [key for key in opened[name].meta.video_keys if key != FRONT]:
            del opened[name].meta.info.features[camera]
    frames = []
    for session in buffer.sessions:
        entry = session.entry
        first = opened[entry.dataset].meta.episodes[entry.episode_index]["dataset_from_index"]
        frames += [(entry.dataset, first + index) for index in range(entry.start, entry.stop)]

    def read(position: int) -> NDArray[np.uint8]:
        name, index = frames[position]
        image: NDArray[np.uint8] = opened[name][index][FRONT].numpy().transpose(1, 2, 0)
        return image

    return read, frames


def measure_streaming(folder: Path, buffer: Buffer, chunk: int) -> str:
    """Measure the peak memory of streaming buffers of all lengths; return the table."""
    split = load_split(folder)
    cases = [(k, 1) for k in split.k_values] + [(max(split.k_values), TIMES_LONGER)]
    peaks, rows = [], []
    for k, times in cases:
        frames, decoded, peak = in_fresh_process(
            stream_peak, str(folder), str(buffer.episode_id), k, times, chunk
        )
        peaks.append(peak)
        label = f"k{k}" if times == 1 else f"k{k}, {times} times as long"
        rows.append([label, f"{frames:,}", megabytes(decoded), megabytes(peak)])
    title = (
        f"Peak memory of Buffer.stream(chunk={chunk}), front camera, over what the process holds "
        f"before; largest / smallest {max(peaks) / min(peaks):.2f} (aim: flat)."
    )
    return table(title, ("<buffer", ">frames", ">decoded MB", ">peak MB"), rows)


def stream_peak(folder: str, episode: str, k: int, times: int, chunk: int) -> tuple[int, int, int]:
    """Stream a buffer, its sessions so many times over; return frames, their bytes, the peak."""
    split = load_split(folder)
    manifest = split.manifest(episode, k)
    longer = dataclasses.replace(
        manifest,
        sessions=manifest.sessions * times,
        history_frames=manifest.history_frames * times,
    )
    buffer = Buffer(longer, split.datasets)
    before = peak_memory()
    decoded = sum(part.frames["front"].nbytes for part in buffer.stream(chunk, ("front",)))
    return len(buffer), decoded, peak_memory() - before


if __name__ == "__main__":
    main()
