"""How many items a processor second gives for training, and how flat memory stays.

An item has 32 frames of the front camera, sampled evenly from a k7 buffer and the first live view.
Batches of 64 from HistoryDataset are compared with those of a loader; with its single items,
collated; with a copy of the images in a batch's memory; with Buffer.stream of the same frames; and
with LeRobotDataset in its default settings, as uint8, whose delta_timestamps take 32 frames from
one episode, the lesson: evenly spread, or one after the other.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from common import (
    add_buffer_set,
    demo_buffers,
    interleave,
    megabytes,
    peak_memory,
    positive,
    print_machine,
    print_table,
    run,
)
from torch.utils.data import DataLoader, default_collate

from robomme_interference_data import load_buffer_set
from robomme_interference_data.constants import DEMONSTRATIONS, FPS, FRONT
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.training import HistoryDataset

MEMORY = Memory("framesamp", 32)
BATCH, FEW = 64, 8
"""Items of a batch of resized images, and of one of full images: about as many bytes."""


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_buffer_set(parser)
    parser.add_argument("--image-size", type=positive, default=96)
    parser.add_argument("--rounds", type=positive, default=3)
    args = parser.parse_args()
    root = args.buffer_set or demo_buffers()
    with tempfile.TemporaryDirectory() as cache:
        buffer_set = load_buffer_set(root)
        options = {"chunk": 0, "cache": cache, "quiet": True}
        # The buffer set of the demonstration has test episodes.
        options |= {"split": buffer_set.episode_ids[0].split}
        data = HistoryDataset(buffer_set, ["k7"], image_size=args.image_size, **options)
        large = HistoryDataset(buffer_set, ["k7"], **options)
        count = len(data)
        buffers = [buffer_set.load(episode, "k7") for episode in data.episode_ids]
        kept = [list(MEMORY.earlier(len(buffer))) for buffer in buffers]

        many, few = (np.resize(np.arange(count), (8, size)).tolist() for size in (BATCH, FEW))

        def batches(of: HistoryDataset, indices: list[list[int]]) -> Callable[[int], object]:
            return lambda number: of[indices[number]]

        def collated(number: int) -> object:
            return default_collate([data[index] for index in many[number]])

        def loaded(number: int) -> object:
            [batch] = DataLoader(data, BATCH, sampler=many[number])
            return batch

        def copying(of: HistoryDataset, indices: list[list[int]]) -> Callable[[int], object]:
            images = of[indices[0]]["memory.images.front"].numpy()
            return lambda number: images.copy()  # several times as fast as torch's clone

        def stream(number: int) -> object:
            return list(buffers[number].stream(64, ["front"], kept[number]))

        def each(calls: int, make: Callable[[int], object]) -> None:
            for number in range(calls):
                make(number)

        side = buffer_set.datasets[DEMONSTRATIONS].shape("front")[0]
        small, full = f"HistoryDataset, {args.image_size} px", f"HistoryDataset, {side} px"
        # Calls a round, items a call, what is called, and what it is compared with.
        ways: dict[str, tuple[int, int, Callable[[int], object], str]] = {
            small: (8, BATCH, batches(data, many), small),
            f"the same in a DataLoader, {args.image_size} px": (8, BATCH, loaded, small),
            f"items and default_collate, {args.image_size} px": (8, BATCH, collated, small),
            f"copy of the same bytes, {args.image_size} px": (8, BATCH, copying(data, many), small),
            full: (8, FEW, batches(large, few), full),
            f"copy of the same bytes, {side} px": (8, FEW, copying(large, few), full),
            f"Buffer.stream(indices=…), {side} px": (min(4, count), 1, stream, full),
            f"LeRobotDataset, 32 spread frames, {side} px": (4, 1, lerobot(root, 31), full),
            f"LeRobotDataset, 32 frames in a row, {side} px": (4, 1, lerobot(root, None), full),
        }

        def epochs(number: int) -> int:
            for _ in range(number):
                for indices in many:
                    data[indices]
            return peak_memory()

        grown = -epochs(1) + epochs(4)
        calls = {name: partial(each, number, way) for name, (number, _, way, _) in ways.items()}
        times = interleave(calls, args.rounds, time.process_time)
    items = {name: number * size for name, (number, size, _, _) in ways.items()}
    rows = []
    for name, (*_, base) in ways.items():
        ratio = times.ratio(name, base) * items[base] / items[name]
        rows.append([name, f"{items[name] / times.median(name):,.1f}", f"{ratio:,.1f}"])
    print_machine("numpy", "torch", "lerobot")
    columns = ("<way", ">items per processor second", ">HistoryDataset is faster by")
    print_table("Items of 32 frames, one process:", columns, rows)
    print(f"\nFour more epochs add {megabytes(grown)} MB to the peak memory.")


def lerobot(root: Path, parts: int | None) -> Callable[[int], object]:
    """Return how LeRobot gives 32 frames of a lesson as one item: spread evenly, or in a row."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    folder = Path(root) / DEMONSTRATIONS
    plain = LeRobotDataset("local/it", root=folder)
    last = int(plain.meta.episodes[0]["length"]) - 1
    frames = range(last - 31, last + 1)
    chosen = frames if parts is None else [step * last // parts for step in range(parts + 1)]
    offsets = {FRONT: [(frame - last) / FPS for frame in chosen]}
    dataset = LeRobotDataset("local/it", root=folder, delta_timestamps=offsets, return_uint8=True)
    return lambda number: dataset[last]


if __name__ == "__main__":
    run(main)
