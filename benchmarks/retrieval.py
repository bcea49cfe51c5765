"""How fast embeddings are made, looked up, graded and searched, each against the bare work.

    python benchmarks/retrieval.py                  # SigLIP base with random weights; minutes
    python benchmarks/retrieval.py --model so400m   # the paper's architecture: wants a GPU

Frames are those of a split's distractor units. Weights are random, which costs the same time as
trained ones. Histories that are graded and searched are made-up embeddings: no video is needed.
"""

import argparse
import json
import os
import shutil
import sys
import tempfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import patch

import numpy as np
import pyarrow.parquet as pq
from load import demo_split
from manifests import write_episodes
from timing import Times, interleave, machine, megabytes, positive, table

from robomme_interference_data import Dataset, load_split
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    EPISODES_DIR,
    INFO_PATH,
    MANIFESTS,
)
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.files import LocalFiles, read_json, write_json
from robomme_interference_data.progress import BuildProgress
from robomme_interference_data.retrieval.encoders import Encoder, make_encoder
from robomme_interference_data.retrieval.grade import cells, grade, measure
from robomme_interference_data.retrieval.index import build_index
from robomme_interference_data.retrieval.segment import adjacent_cosines, cosines
from robomme_interference_data.retrieval.select import Rule
from robomme_interference_data.retrieval.selector import select

QUIET = BuildProgress(quiet=True)
RULE = Rule("max", "adaptive")
RATES = ("<work", ">frames/s", "<against", ">frames/s", ">ratio", ">aim")
COLUMNS = ("<work", ">ms", "<against", ">ms", ">ratio")

TOWERS: dict[str, dict[str, int]] = {
    "tiny": {"image_size": 32, "patch_size": 16, "hidden_size": 32, "intermediate_size": 64}
    | {"num_attention_heads": 2, "num_hidden_layers": 2},
    "base": {"image_size": 224, "patch_size": 16, "hidden_size": 768, "intermediate_size": 3072}
    | {"num_attention_heads": 12, "num_hidden_layers": 12},
    "so400m": {"image_size": 384, "patch_size": 14, "hidden_size": 1152, "intermediate_size": 4304}
    | {"num_attention_heads": 16, "num_hidden_layers": 27},
}


class MadeUp:
    """An encoder of nothing: every episode gets a direction of its own, every frame some noise."""

    name = "made-up"
    centred = False
    batch = 2**30  # an episode at a time
    computed_in = "numpy"
    fingerprint: ClassVar[dict[str, Any]] = {"name": "made-up"}

    def __init__(self, size: int):
        self._size = size
        self._numbers = np.random.default_rng(0)

    def prepare(self, images: np.ndarray) -> int:
        """Return the number of images."""
        return len(images)

    def features(self, prepared: int) -> np.ndarray:
        """Return made-up features, `(N, D) float32`."""
        noise = self._numbers.standard_normal((prepared, self._size), np.float32)
        return self._numbers.standard_normal(self._size, np.float32) + noise / 4


def main() -> None:
    """Measure and print."""
    options = parse_options()
    try:
        split = options.split or demo_split()
        with tempfile.TemporaryDirectory(prefix="interference-retrieval-") as name:
            folder = Path(name)
            encoders = [
                make_encoder("thumbnail"),
                make_encoder(f"siglip:{save_model(options.model, folder)}", device=options.device),
            ]
            print(machine("torch", "transformers", "numpy"), end="\n\n", flush=True)
            print(index_table(split, encoders, folder, options), end="\n\n", flush=True)
            made = made_up_split(folder / "made-up", options)
            print(lookup_table(made, split, encoders, options), end="\n\n", flush=True)
            print(history_table(folder / "history.npy", options))
    except InterferenceError as error:
        sys.exit(str(error))


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--split", type=Path, help="folder of a split; by default that of make demo"
    )
    parser.add_argument("--model", choices=TOWERS, default="base", help="SigLIP architecture")
    parser.add_argument("--device", help="where it computes; by default a GPU if there is one")
    parser.add_argument("--rounds", type=positive, default=3, help="timed repetitions")
    parser.add_argument("--units", type=positive, default=4, help="units that are embedded")
    parser.add_argument("--queries", type=positive, default=450, help="queries that are graded")
    parser.add_argument("--history", type=positive, default=1_000_000, help="frames searched")
    parser.add_argument("--size", type=positive, default=1152, help="values in an embedding")
    return parser.parse_args()


def save_model(name: str, folder: Path) -> Path:
    """Save a SigLIP vision tower of random weights."""
    import torch
    from transformers import SiglipVisionConfig, SiglipVisionModel

    torch.manual_seed(0)
    tower = TOWERS[name]
    path = folder / f"siglip-{name}"
    SiglipVisionModel(SiglipVisionConfig(**tower)).save_pretrained(path)
    side = {"height": tower["image_size"], "width": tower["image_size"]}
    settings = {"image_processor_type": "SiglipImageProcessor", "size": side}
    (path / "preprocessor_config.json").write_text(json.dumps(settings))
    return path


def index_table(
    split: Path, encoders: list[Encoder], folder: Path, options: argparse.Namespace
) -> str:
    """Time the index of the distractor units against decoding, and against the forward pass."""
    root = folder / DISTRACTORS
    shutil.copytree(split / DISTRACTORS, root, ignore=shutil.ignore_patterns("index"))
    (path,) = (root / EPISODES_DIR).rglob("*.parquet")
    few = pq.read_table(path).slice(0, options.units)
    pq.write_table(few, path)
    info = read_json(root / INFO_PATH)
    write_json(root / INFO_PATH, info | {"total_episodes": len(few)})
    dataset = Dataset(LocalFiles(root))
    camera = dataset.cameras[0]
    frames = sum(record.length for record in dataset.records())

    def decode() -> None:
        for episode in dataset.records():
            images = np.empty((episode.length, *dataset.features[camera]), np.uint8)
            dataset.read_frames(episode.episode_index, camera, 0, images)

    rows = []
    for encoder, aim in zip(encoders, ("", "≥ 0.95"), strict=True):
        bare, forward = "bare decoding", decode
        if encoder.name != "thumbnail":
            bare, forward = "bare forward pass", forward_pass(encoder, dataset, camera)
        ways = {
            "index": lambda encoder=encoder: make_index(root, encoder, camera),
            bare: forward,
        }
        times = interleave(ways, options.rounds)
        label = "thumbnail" if encoder.name == "thumbnail" else f"siglip {options.model}"
        ratio = times.ratio(bare, "index")
        rates = [f"{frames / times.median(way):,.1f}" for way in ("index", bare)]
        rows.append([f"index, {label}", rates[0], bare, rates[1], f"{ratio:.2f}", aim])
    title = (
        f"{frames} frames of distractor units, decoded by {os.cpu_count()} threads beside the "
        f"encoder ({encoders[1].computed_in}); medians of {options.rounds} rounds."
    )
    return table(title, RATES, rows)


def make_index(root: Path, encoder: Encoder, camera: str) -> None:
    """Make the index of a dataset from nothing."""
    shutil.rmtree(root / "index", ignore_errors=True)
    build_index([root], encoder, QUIET, camera=camera, threads=os.cpu_count() or 1)


def forward_pass(encoder: Encoder, dataset: Dataset, camera: str) -> Callable[[], None]:
    """Return what runs the encoder over images that were decoded and prepared beforehand."""
    prepared = []
    for episode in dataset.records():
        images = np.empty((episode.length, *dataset.features[camera]), np.uint8)
        dataset.read_frames(episode.episode_index, camera, 0, images)
        for start in range(0, episode.length, encoder.batch):
            prepared.append(encoder.prepare(images[start : start + encoder.batch]))

    def run() -> None:
        for batch in prepared:
            encoder.features(batch)

    return run


def made_up_split(folder: Path, options: argparse.Namespace) -> Path:
    """Write a split of tables and embeddings alone: queries, 900 units, k 0, 1, 3, 7."""
    counts = {DEMONSTRATIONS: options.queries, DISTRACTORS: 900}
    roots = [write_episodes(folder / kind, kind, count) for kind, count in counts.items()]
    plan = plan_manifests(*(Dataset(LocalFiles(root)) for root in roots), position_limit=None)
    for _ in write_manifests(plan, folder / MANIFESTS):
        pass
    with patch.object(Dataset, "read_frames", lambda *_: None):
        build_index(roots, MadeUp(options.size), QUIET)
    return folder


def lookup_table(
    made: Path, split: Path, encoders: list[Encoder], options: argparse.Namespace
) -> str:
    """Time one retrieval against one live frame's embedding, and grading against reading."""
    opened = load_split(made)
    buffers = list(opened.buffers())
    middle = sorted((one for one in buffers if one.k == 7), key=len)[options.queries // 2]
    live = next(load_split(split).buffers()).query_frame()
    rows = []
    for encoder in encoders:
        kind = "thumbnail" if encoder.name == "thumbnail" else f"siglip {options.model}"
        ways: dict[str, Callable[[], object]] = {
            "retrieve": lambda: select(middle, MadeUp.name, RULE),
            "embed": lambda encoder=encoder: encoder.features(encoder.prepare(live[None])),
        }
        times = interleave(ways, max(options.rounds, 11))
        rows.append(
            row(
                f"one retrieval, {len(middle):,} frames",
                "retrieve",
                f"its live frame, {kind}",
                "embed",
                times,
            )
        )
    ways = {
        "grade": lambda: list(cells([grade(measure(b, MadeUp.name), RULE) for b in buffers])),
        "read": lambda: [np.array(buffer.embeddings(MadeUp.name)) for buffer in buffers],
    }
    times = interleave(ways, options.rounds)
    rows.append(
        row(f"grading {len(buffers):,} buffers", "grade", "copying their embeddings", "read", times)
    )
    title = (
        f"Embeddings of {options.size} values, {options.queries} queries and 900 units at k 0, 1, "
        "3 and 7; medians."
    )
    return table(title, COLUMNS, rows)


def row(work: str, way: str, against: str, other: str, times: Times) -> list[str]:
    """Lay out one comparison, in milliseconds."""
    shown = [f"{times.median(name) * 1e3:,.1f}" for name in (way, other)]
    return [work, shown[0], against, shown[1], f"{times.ratio(way, other):.2f}"]


def history_table(path: Path, options: argparse.Namespace) -> str:
    """Time the search of a long history, in blocks and as one plain matrix product."""
    numbers = np.random.default_rng(0)
    out = np.lib.format.open_memmap(
        path, mode="w+", dtype=np.float16, shape=(options.history, options.size)
    )
    for start in range(0, options.history, 10_000):
        rows = numbers.standard_normal((min(10_000, options.history - start), options.size))
        out[start : start + len(rows)] = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    out.flush()
    del out
    history = np.load(path, mmap_mode="r")
    query = np.array(history[options.history // 2], np.float32)

    def blocks() -> int:
        return int(np.argmax(cosines(history, query)))

    def plain() -> int:
        return int(np.argmax(history.astype(np.float32) @ query))

    ways = {"in blocks": blocks, "plain": plain, "cut": lambda: adjacent_cosines(history)}
    assert blocks() == plain() == options.history // 2
    times = interleave(ways, options.rounds)
    rows = []
    for way, label in (("in blocks", "cosines with the query"), ("cut", "… of adjacent frames")):
        rows.append(
            [
                label,
                f"{times.median(way):.2f}",
                megabytes(held(ways[way])),
                "plain matrix product",
                f"{times.median('plain'):.2f}",
                megabytes(held(plain)),
                f"{times.ratio(way, 'plain'):.2f}",
            ]
        )
    title = (
        f"A history of {options.history:,} frames, {options.size} values each, in a file of "
        f"{megabytes(path.stat().st_size)} MB; seconds, and MB held beside the file's own pages."
    )
    return table(title, ("<work", ">s", ">MB", "<against", ">s", ">MB", ">ratio"), rows)


def held(way: Callable[[], object]) -> int:
    """Return the most bytes that a way has allocated."""
    tracemalloc.start()
    way()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak


if __name__ == "__main__":
    main()
