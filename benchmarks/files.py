"""What it costs that every episode has files of its own.

The bytes of the files that one buffer needs are compared with what lies in its spans. Then
LeRobotDataset reads items all over the datasets as they are, and over the same datasets as
lerobot's aggregate_datasets concatenates them.
"""

import argparse
import os
import tempfile
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import av
import av.logging
from common import (
    add_buffer_set,
    demo_buffers,
    interleave,
    megabytes,
    positive,
    print_machine,
    print_table,
    run,
)
from load import Span, choose_buffer, open_lerobot, spans_of

from robomme_interference_data import Buffer, BufferSet, load_buffer_set
from robomme_interference_data.build_dataset.dataset.lerobot_writer import require_lerobot
from robomme_interference_data.constants import (
    ACTION,
    CAMERA_PREFIX,
    DEMONSTRATIONS,
    DISTRACTORS,
    STATE,
)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_buffer_set(parser)
    parser.add_argument("--items", type=positive, default=100, help="items read in a round")
    parser.add_argument("--rounds", type=positive, default=5, help="timed repetitions")
    options = parser.parse_args()
    require_lerobot()
    folder = options.buffer_set or demo_buffers()
    buffer_set = load_buffer_set(folder)
    print_machine("av", "lerobot")
    measure_bytes(buffer_set, choose_buffer(buffer_set))
    time_lerobot(folder, options)


def measure_bytes(buffer_set: BufferSet, buffer: Buffer) -> None:
    """Compare the files that a buffer needs with what lies in its spans; print the table."""
    videos = [
        span
        for camera in buffer.cameras
        for span in spans_of(buffer, buffer_set, CAMERA_PREFIX + camera)
    ]
    inside = span_bytes(buffer, buffer_set, videos)
    entries = [session.entry for session in buffer.sessions]
    data = {buffer_set.datasets[e.dataset].lerobot.rows(e.episode_index).path for e in entries}
    sizes = [
        sum(path.stat().st_size for path in files) for files in ({v.path for v in videos}, data)
    ]
    title = (
        f"Bytes of {buffer.episode_id} under {buffer.condition}, all cameras: the files of its "
        "sessions, and the video packets and numbers of its spans in them."
    )
    cells = [megabytes(size) for size in (*sizes, inside)]
    columns = (">video files, MB", ">data files, MB", ">in spans, MB", ">ratio", ">aim")
    print_table(title, columns, [[*cells, f"{sum(sizes) / inside:.3f}", "≤ 1.1"]])


def span_bytes(buffer: Buffer, buffer_set: BufferSet, videos: Iterable[Span]) -> int:
    """Return the bytes of the video packets and the numbers of a buffer's spans."""
    inside = sum(map(packet_bytes, videos))
    for session in buffer.sessions:
        entry, dataset = session.entry, buffer_set.datasets[session.entry.dataset]
        for feature in {STATE, ACTION} & dataset.features.keys():
            numbers = dataset.read_vectors(entry.episode_index, feature, entry.start, entry.stop)
            inside += numbers.nbytes
    return inside


def packet_bytes(span: Span) -> int:
    """Return the bytes of the video packets of a span."""
    with av.open(str(span.path)) as container:
        stream = container.streams.video[0]
        tick = float(stream.time_base) * span.fps
        return sum(
            packet.size
            for packet in container.demux(stream)
            if packet.pts is not None and span.start <= round(packet.pts * tick) < span.stop
        )


def read(dataset: Any, order: list[int]) -> None:
    """Read items of a dataset."""
    for index in order:
        dataset[index]


def time_lerobot(folder: Path, options: argparse.Namespace) -> None:
    """Time LeRobotDataset on the datasets as they are and concatenated; print the table."""
    os.environ["TQDM_DISABLE"] = "1"
    from lerobot.datasets.aggregate import aggregate_datasets

    av.logging.set_libav_level(av.logging.ERROR)
    rows = []
    with tempfile.TemporaryDirectory(prefix="interference-concatenated-") as name:
        for kind in (DEMONSTRATIONS, DISTRACTORS):
            apart, whole = folder / kind, Path(name) / kind
            aggregate_datasets([kind], kind, [apart], whole)
            items, joined = open_lerobot(kind, apart), open_lerobot(kind, whole)
            chosen = range(0, len(items), max(1, len(items) // options.items) | 1)
            scattered = [*chosen][::2] + [*chosen][1::2]

            ways = {
                "apart": partial(read, items, scattered),
                "joined": partial(read, joined, scattered),
            }
            times = interleave(ways, options.rounds)
            milliseconds = [1000 * times.median(way) / len(chosen) for way in ways]
            files = [len(list(root.glob("videos/**/*.mp4"))) for root in (apart, whole)]
            rows.append(
                [
                    f"{kind}, {len(items):,} frames",
                    *(
                        f"{count} files, {ms:.1f} ms"
                        for count, ms in zip(files, milliseconds, strict=True)
                    ),
                    f"{times.ratio('apart', 'joined'):.2f}",
                    "≤ 1",
                ]
            )
    title = (
        f"LeRobotDataset[i], all cameras, of about {options.items} items over the whole "
        f"dataset; medians of {options.rounds} rounds."
    )
    columns = ("<dataset", ">a file an episode", ">concatenated", ">ratio", ">aim")
    print_table(title, columns, rows)


if __name__ == "__main__":
    run(main)
