"""How fast manifests are written, and how that grows with the number of query episodes.

Episode tables are made up, in the columns of real datasets (docs/format.md); no video is needed.
Every run is a process of its own, the sizes take turns.
"""

import argparse
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from timing import in_fresh_process, machine, megabytes, peak_memory, positive, table

from robomme_interference_data import Dataset
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.constants import (
    ACTION,
    CAMERA_PREFIX,
    DEFAULT_K,
    DEMONSTRATIONS,
    DISTRACTORS,
    EPISODES_DIR,
    FAMILIES,
    FORMAT_VERSION,
    FPS,
    FRONT,
    IDENTITY_PATH,
    INFO_PATH,
    MANIFEST_JSON,
    MANIFEST_JSONL,
    MANIFEST_PARQUET,
    STATE,
    UNIT_FRAMES,
    WRIST,
)
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.files import LocalFiles, read_json, write_json

SIZES = (1_000, 10_000, 100_000)
FULL = 1_000_000
BATCH = 25_600
ROW_GROUP = 256  # as in a real meta/episodes
SHAPES = {FRONT: [256, 256, 3], WRIST: [256, 256, 3], STATE: [8], ACTION: [8]}
GOALS = ["watch the video carefully, then do the task again", "do the task again as in the video"]


@dataclass(frozen=True)
class Run:
    """What one run took: seconds, bytes of memory over the start, bytes of files, and rows."""

    seconds: float
    memory: int
    parquet: int
    jsonl: int
    rows: int


def main() -> None:
    """Measure and print."""
    options = parse_options()
    sizes = sorted({*options.queries, *([FULL] if options.full else [])})
    try:
        with tempfile.TemporaryDirectory(prefix="interference-manifests-") as name:
            folder = Path(name)
            units = write_episodes(folder / "units", DISTRACTORS, options.units)
            queries = {
                size: write_episodes(folder / str(size), DEMONSTRATIONS, size) for size in sizes
            }
            in_fresh_process(write, queries[sizes[0]], units, folder / "out")
            runs: dict[int, list[Run]] = {size: [] for size in sizes}
            for number in range(options.rounds):
                for size in sizes:
                    if size < FULL or number == 0:
                        run = in_fresh_process(write, queries[size], units, folder / "out")
                        runs[size].append(run)
    except InterferenceError as error:
        sys.exit(str(error))
    print(machine("pyarrow"), end="\n\n")
    print(report(runs, options.units))


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--queries", type=positive, nargs="+", default=SIZES, help="numbers of query episodes"
    )
    parser.add_argument(
        "--units", type=positive, default=100_000, help="distractor units in the pool"
    )
    parser.add_argument(
        "--full",
        action="store_true",
        help=f"also {FULL:,} queries, once: minutes, and 8 GB in the folder for temporary files",
    )
    parser.add_argument("--rounds", type=positive, default=3, help="repetitions of each size")
    return parser.parse_args()


def report(runs: dict[int, list[Run]], units: int) -> str:
    """Lay out the medians."""
    rows = []
    before: tuple[int, float] | None = None
    for size, found in runs.items():
        seconds = statistics.median(run.seconds for run in found)
        added = "" if before is None else f"{1e6 * (seconds - before[1]) / (size - before[0]):.0f}"
        growth = "" if before is None else f"{seconds / before[1]:.1f}"
        rows.append(
            [
                f"{size:,}",
                f"{seconds:.1f}",
                growth,
                added,
                f"{found[0].rows / seconds:,.0f}",
                megabytes(statistics.median(run.memory for run in found)),
                megabytes(found[0].parquet),
                megabytes(found[0].jsonl),
            ]
        )
        before = size, seconds
    title = (
        f"Manifests for k = {', '.join(map(str, DEFAULT_K))} and a pool of {units:,} units; medians"
        f" of {max(map(len, runs.values()))} runs, {FULL:,} queries once. The time includes reading"
        " the episode tables and preparing the pool; × is against the line above."
    )
    columns = ("s", "×", "µs per further query", "buffers/s", "peak MB", "parquet MB", "JSON MB")
    return table(title, [">" + name for name in ("queries", *columns)], rows)


def write(demonstrations: Path, distractors: Path, out: Path) -> Run:
    """Write the manifests of two datasets, remove them, and say what it took."""
    before = peak_memory()
    began = time.perf_counter()
    plan = plan_manifests(Dataset(LocalFiles(demonstrations)), Dataset(LocalFiles(distractors)))
    for _ in write_manifests(plan, out):
        pass
    seconds = time.perf_counter() - began
    run = Run(
        seconds,
        peak_memory() - before,
        (out / MANIFEST_PARQUET).stat().st_size,
        (out / MANIFEST_JSONL).stat().st_size,
        read_json(out / MANIFEST_JSON)["counts"]["buffers"],
    )
    shutil.rmtree(out)
    return run


def write_episodes(root: Path, kind: str, count: int) -> Path:
    """Write the metadata of a made-up dataset: so many episodes, the nine families alike."""
    path = root / EPISODES_DIR / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    numbers = np.random.default_rng(0)
    writer = None
    for start in range(0, count, BATCH):
        columns = episode_columns(kind, start, min(start + BATCH, count), count, numbers)
        episodes = pa.table(columns)
        writer = writer or pq.ParquetWriter(path, episodes.schema, compression="zstd")
        writer.write_table(episodes, row_group_size=ROW_GROUP)
    if writer is not None:
        writer.close()
    features = {
        name: {"dtype": "video" if name.startswith(CAMERA_PREFIX) else "float32", "shape": shape}
        for name, shape in SHAPES.items()
    }
    info = {
        "codebase_version": "v3.0",
        "fps": FPS,
        "total_episodes": count,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": features,
    }
    write_json(root / INFO_PATH, info)
    identity = {
        "format_version": FORMAT_VERSION,
        "kind": kind,
        "name": kind,
        "version": "1.0.0",
        "revision": hashes(numbers, 1)[0],
        "exact": True,
        "counts": {"episodes": count},
        "simulators": ["robomme"],
    }
    write_json(root / IDENTITY_PATH, identity)
    return root


def episode_columns(
    kind: str, start: int, stop: int, total: int, numbers: np.random.Generator
) -> dict[str, Any]:
    """Return the columns of episodes `start` to `stop` (excluded) of `total`."""
    count = stop - start
    index = np.arange(start, stop)
    rank, number = np.divmod(index, -(-total // len(FAMILIES)))
    families = [FAMILIES[place] for place in rank]
    queries = kind == DEMONSTRATIONS
    split = "test" if queries else "train"
    lesson = 48 + 7919 * number % 1024  # as long as real lessons are
    length = lesson + 1 if queries else np.full(count, UNIT_FRAMES)
    zeros = np.zeros(count, np.int64)
    columns = {
        "episode_index": index,
        "tasks": [GOALS[:1]] * count,
        "length": length,
        "data/chunk_index": zeros,
        "data/file_index": rank,
        "dataset_from_index": index * UNIT_FRAMES,
        "dataset_to_index": (index + 1) * UNIT_FRAMES,
    }
    for camera in (FRONT, WRIST):
        columns |= {
            f"videos/{camera}/chunk_index": zeros,
            f"videos/{camera}/file_index": rank,
            f"videos/{camera}/from_timestamp": number * float(UNIT_FRAMES) / FPS,
            f"videos/{camera}/to_timestamp": (number + 1) * float(UNIT_FRAMES) / FPS,
        }
    columns |= {
        "meta/episodes/chunk_index": zeros,
        "meta/episodes/file_index": zeros,
        "episode_id": [
            f"{family}/{split}/{place}" for family, place in zip(families, number, strict=True)
        ],
        "family": families,
        "split": [split] * count,
        "source_episode": number,
        "goals": [GOALS] * count,
        "seed": 500_000 + index,
        "difficulty": ["easy"] * count,
        "simulator": ["robomme"] * count,
        "raw_length": length,
        "exec_start_idx": pa.array(lesson if queries else [None] * count, pa.int64()),
        "exact": [True] * count,
        "sha256": hashes(numbers, count),
        "lesson_sha256": pa.array(
            hashes(numbers, count) if queries else [None] * count, pa.string()
        ),
    }
    prefixes: Sequence[str] = ("sha256/", "lesson_sha256/") if queries else ("sha256/",)
    return columns | {
        prefix + name: hashes(numbers, count) for prefix in prefixes for name in SHAPES
    }


def hashes(numbers: np.random.Generator, count: int) -> list[str]:
    """Return made-up SHA-256 in hexadecimal."""
    text = numbers.bytes(32 * count).hex()
    return [text[place : place + 64] for place in range(0, len(text), 64)]


if __name__ == "__main__":
    main()
