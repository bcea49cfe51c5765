"""How fast a history buffer loads, and how much memory streaming it takes.

The front frames of one buffer are loaded by Buffer.frames(), by one bare PyAV decode of the same
spans, and by LeRobotDataset[i], in turn; all give the same pixels, which is checked first.
"""

import argparse
import dataclasses
import logging
import os
import statistics
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import av
import numpy as np
from common import (
    add_buffer_set,
    demo_buffers,
    in_fresh_process,
    interleave,
    megabytes,
    peak_memory,
    positive,
    print_machine,
    print_table,
    run,
)
from numpy.typing import NDArray

from robomme_interference_data import Buffer, BufferSet, DecodedCache, load_buffer_set
from robomme_interference_data.build_dataset.dataset.lerobot_writer import require_lerobot
from robomme_interference_data.constants import FRONT
from robomme_interference_data.schema.conditions import parse_condition

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
    require_lerobot()
    buffer_set = options.buffer_set or demo_buffers()
    buffer = choose_buffer(load_buffer_set(buffer_set, threads=1))
    print_machine("av", "lerobot")
    time_loading(buffer_set, buffer, options)
    measure_streaming(buffer_set, buffer, options.chunk)


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_buffer_set(parser)
    parser.add_argument("--rounds", type=positive, default=7, help="timed repetitions")
    parser.add_argument(
        "--threads", type=positive, default=2, help="threads of the second measurement"
    )
    parser.add_argument(
        "--lerobot-frames",
        type=positive,
        default=48,
        help="frames that LeRobotDataset reads in a round; its time is scaled to the whole",
    )
    parser.add_argument("--chunk", type=positive, default=64, help="frames in a chunk of stream()")
    return parser.parse_args()


def choose_buffer(buffer_set: BufferSet) -> Buffer:
    """Return the buffer to measure: the most sessions, and of these the median length."""
    name = max(buffer_set.conditions, key=lambda name: parse_condition(name).k)
    lengths = {m.history_frames: m.episode_id for m in buffer_set.manifests(condition=name)}
    return buffer_set.load(lengths[statistics.median_low(lengths)], name)


def time_loading(folder: Path, buffer: Buffer, options: argparse.Namespace) -> None:
    """Time all ways of loading the front frames; print the table."""
    buffer_set = load_buffer_set(folder, threads=1)
    key, threads = (buffer.episode_id, buffer.condition), options.threads
    spans = spans_of(buffer, buffer_set)
    wanted = buffer.frames("front")

    def bare() -> None:
        for _image in chain.from_iterable(map(decode, spans)):
            pass

    def bare_kept() -> NDArray[np.uint8]:
        kept = np.empty(wanted.shape, np.uint8)
        for position, image in enumerate(chain.from_iterable(map(decode, spans))):
            kept[position] = image
        return kept

    read_item, items = lerobot_reader(buffer_set, buffer)
    # An odd distance: a frame is as likely to be right after a key frame as just before one.
    distance = max(1, len(items) // options.lerobot_frames) | 1
    chosen = range(0, len(items), distance)
    scale = len(items) / len(chosen)
    with tempfile.TemporaryDirectory(prefix="interference-cache-") as cache_folder:
        cache = DecodedCache(Path(cache_folder))
        parallel = load_buffer_set(folder, threads=threads).load(*key)
        cached = load_buffer_set(folder, cache=cache, threads=1).load(*key)
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
        f"Front frames of {buffer.episode_id} under {buffer.condition}: {len(buffer)} frames, "
        f"{len(buffer.sessions)} sessions; medians "
        f"of {options.rounds} rounds; LeRobotDataset timed on {len(chosen)} frames and scaled."
    )
    print_table(title, COLUMNS, rows)


def check_equal(found: list[NDArray[np.uint8]], wanted: list[NDArray[np.uint8]]) -> None:
    """Check that all ways give the same pixels."""
    if not all(map(np.array_equal, found, wanted)):
        sys.exit("The ways of loading give different pixels: their times mean nothing.")


def spans_of(buffer: Buffer, buffer_set: BufferSet, camera: str = FRONT) -> list[Span]:
    """Return where the frames of a camera lie."""
    spans = []
    for session in buffer.sessions:
        entry, lerobot = session.entry, buffer_set.datasets[session.entry.dataset].lerobot
        location = lerobot.locate_video(entry.episode_index, camera)
        start, stop = location.first + entry.start, location.first + entry.stop
        spans.append(Span(lerobot.files.path(location.path), start, stop, lerobot.fps))
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


def open_lerobot(name: str, root: Path) -> Any:
    """Open a dataset with lerobot."""
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    logging.disable(logging.WARNING)
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset(name, root=root, video_backend="pyav", return_uint8=True)


def lerobot_reader(
    buffer_set: BufferSet, buffer: Buffer
) -> tuple[Callable[[int], NDArray[np.uint8]], list[tuple[str, int]]]:
    """Return a function that reads a frame of the buffer through LeRobotDataset, and all frames.

    LeRobotDataset decodes every camera of an item; here it is left with the front camera only.
    """
    opened = {
        name: open_lerobot(name, Path(buffer_set.location) / name) for name in buffer_set.datasets
    }
    for dataset in opened.values():
        for camera in [key for key in dataset.meta.video_keys if key != FRONT]:
            del dataset.meta.info.features[camera]
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


def measure_streaming(folder: Path, buffer: Buffer, chunk: int) -> None:
    """Measure the peak memory of streaming buffers of all lengths; print the table."""
    buffer_set = load_buffer_set(folder)
    names = [
        name
        for name in buffer_set.conditions
        if buffer_set.manifest(buffer.episode_id, name).sessions
    ]
    cases = [(name, 1) for name in names] + [(names[-1], TIMES_LONGER)]
    peaks, rows = [], []
    for name, times in cases:
        frames, decoded, peak = in_fresh_process(
            stream_peak, str(folder), str(buffer.episode_id), name, times, chunk
        )
        peaks.append(peak)
        label = name if times == 1 else f"{name}, {times} times as long"
        rows.append([label, f"{frames:,}", megabytes(decoded), megabytes(peak)])
    title = (
        f"Peak memory of Buffer.stream(chunk={chunk}), front camera, over what the process holds "
        f"before; largest / smallest {max(peaks) / min(peaks):.2f} (aim: flat)."
    )
    print_table(title, ("<buffer", ">frames", ">decoded MB", ">peak MB"), rows)


def stream_peak(
    folder: str, episode: str, condition: str, times: int, chunk: int
) -> tuple[int, int, int]:
    """Stream a buffer, its sessions so many times over; return frames, their bytes, the peak."""
    buffer_set = load_buffer_set(folder)
    manifest = buffer_set.manifest(episode, condition)
    longer = dataclasses.replace(
        manifest, sessions=manifest.sessions * times, history_frames=manifest.history_frames * times
    )
    buffer = Buffer(longer, buffer_set.query(episode), buffer_set.datasets)
    before = peak_memory()
    decoded = sum(part.frames["front"].nbytes for part in buffer.stream(chunk, ("front",)))
    return len(buffer), decoded, peak_memory() - before


if __name__ == "__main__":
    run(main)
