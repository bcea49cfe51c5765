"""How fast embeddings are made, looked up and graded, each against the bare work.

    python benchmarks/retrieval.py                  # SigLIP base with random weights; minutes
    python benchmarks/retrieval.py --model so400m   # the paper's architecture: wants a GPU

Frames are those of a buffer set's distractor units. Weights are random, which takes the same time
as trained ones. Histories that are graded are made-up embeddings: no video is needed.
"""

import argparse
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import patch

import numpy as np
import pyarrow.parquet as pq
from common import (
    Times,
    add_buffer_set,
    demo_buffers,
    interleave,
    positive,
    print_machine,
    print_table,
    run,
)
from manifests import write_dataset, written

from robomme_interference_data import Dataset, load_buffer_set
from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, INFO_PATH, RECORDS_PATH
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.retrieval.encoders import Encoder, make_encoder
from robomme_interference_data.retrieval.grade import cells, grade
from robomme_interference_data.retrieval.index import build_index
from robomme_interference_data.retrieval.measure import measure
from robomme_interference_data.retrieval.select import Rule, choose
from robomme_interference_data.storage.files import LocalFiles, write_json
from robomme_interference_data.storage.text import read_json

QUIET = WorkProgress(quiet=True)
RULE = Rule("max")
CONDITIONS = ("k0", "k1", "k3", "k7")
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
    centered = False
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
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_buffer_set(parser)
    parser.add_argument("--model", choices=TOWERS, default="base", help="SigLIP architecture")
    parser.add_argument("--device", help="where it computes; by default a GPU if there is one")
    parser.add_argument("--rounds", type=positive, default=3, help="timed repetitions")
    parser.add_argument("--units", type=positive, default=4, help="units that are embedded")
    parser.add_argument("--queries", type=positive, default=450, help="queries that are graded")
    parser.add_argument("--size", type=positive, default=1152, help="values in an embedding")
    options = parser.parse_args()
    buffer_set = options.buffer_set or demo_buffers()
    with tempfile.TemporaryDirectory(prefix="interference-retrieval-") as name:
        folder = Path(name)
        encoders = [
            make_encoder("thumbnail"),
            make_encoder(f"siglip:{save_model(options.model, folder)}", device=options.device),
        ]
        print_machine("torch", "transformers", "numpy")
        index_table(buffer_set, encoders, folder, options)
        made = made_up_buffer_set(folder / "made-up", options)
        lookup_table(made, buffer_set, encoders, options)


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
    buffer_set: Path, encoders: list[Encoder], folder: Path, options: argparse.Namespace
) -> None:
    """Time the index of some units against decoding, and against the forward pass."""
    root = folder / DISTRACTORS
    shutil.copytree(buffer_set / DISTRACTORS, root, ignore=shutil.ignore_patterns("index"))
    path = root / RECORDS_PATH
    few = pq.read_table(path).slice(0, options.units)
    pq.write_table(few, path)
    write_json(root / INFO_PATH, read_json(root / INFO_PATH) | {"total_episodes": len(few)})
    dataset, threads = Dataset(LocalFiles(root)), os.cpu_count() or 1
    lengths = [record.length for record in dataset.records()]

    def decode() -> list[np.ndarray]:
        shape = dataset.shape("front")
        units = [np.empty((length, *shape), np.uint8) for length in lengths]
        for unit, images in enumerate(units):
            dataset.read_frames(unit, "front", 0, images)
        return units

    rows = []
    for encoder, aim in zip(encoders, ("", "≥ 0.95"), strict=True):
        bare, forward = "bare decoding", decode
        if encoder.name != "thumbnail":
            bare, forward = "bare forward pass", forward_pass(encoder, decode())
        again = partial(build_index, [root], encoder, QUIET, threads=threads, force=True)
        times = interleave({"index": again, bare: forward}, options.rounds)
        rates = [f"{sum(lengths) / times.median(way):,.1f}" for way in ("index", bare)]
        ratio = f"{times.ratio(bare, 'index'):.2f}"
        rows.append([f"index, {label_of(encoder, options)}", rates[0], bare, rates[1], ratio, aim])
    title = (
        f"{sum(lengths)} frames of distractor units, decoded by {threads} threads beside the "
        f"encoder ({encoders[1].computed_in}); medians of {options.rounds} rounds."
    )
    print_table(title, RATES, rows)


def forward_pass(encoder: Encoder, units: list[np.ndarray]) -> Callable[[], object]:
    """Return what runs the encoder over images that are decoded and prepared."""
    prepared = [
        encoder.prepare(images[start : start + encoder.batch])
        for images in units
        for start in range(0, len(images), encoder.batch)
    ]
    return lambda: [encoder.features(batch) for batch in prepared]


def label_of(encoder: Encoder, options: argparse.Namespace) -> str:
    """Return what an encoder is called in the tables."""
    return "thumbnail" if encoder.name == "thumbnail" else f"siglip {options.model}"


def made_up_buffer_set(root: Path, options: argparse.Namespace) -> Path:
    """Write a buffer set of tables and embeddings alone: queries and 900 units."""
    write_dataset(root / DEMONSTRATIONS, DEMONSTRATIONS, options.queries)
    write_dataset(root / DISTRACTORS, DISTRACTORS, 900)
    written(root, CONDITIONS)
    roots = [root / DEMONSTRATIONS, root / DISTRACTORS]
    with patch.object(Dataset, "read_frames", lambda *_: None):
        build_index(roots, MadeUp(options.size), QUIET)
    return root


def lookup_table(
    made: Path, buffer_set: Path, encoders: list[Encoder], options: argparse.Namespace
) -> None:
    """Time one retrieval against one live frame's embedding, and grading against reading."""
    buffers = list(load_buffer_set(made).buffers())
    longest = sorted((one for one in buffers if one.condition == CONDITIONS[-1]), key=len)
    middle = longest[len(longest) // 2]
    live = next(load_buffer_set(buffer_set).buffers()).query.frame()
    rows = []
    for encoder in encoders:
        ways: dict[str, Callable[[], object]] = {
            "retrieve": lambda: choose(measure(middle, MadeUp.name), RULE),
            "embed": lambda encoder=encoder: encoder.features(encoder.prepare(live[None])),
        }
        times = interleave(ways, max(options.rounds, 11))
        what = f"one retrieval, {len(middle):,} frames"
        against = f"its live frame, {label_of(encoder, options)}"
        rows.append(row(what, "retrieve", against, "embed", times))
    ways = {
        "grade": lambda: list(cells([grade(measure(b, MadeUp.name), RULE) for b in buffers])),
        "read": lambda: [buffer.embeddings(MadeUp.name) for buffer in buffers],
    }
    times = interleave(ways, options.rounds)
    what = f"grading {len(buffers):,} buffers"
    rows.append(row(what, "grade", "reading their embeddings", "read", times))
    title = (
        f"Embeddings of {options.size} values, {options.queries} queries and 900 units under "
        f"{', '.join(CONDITIONS)}; medians."
    )
    print_table(title, COLUMNS, rows)


def row(work: str, way: str, against: str, other: str, times: Times) -> list[str]:
    """Lay out one comparison, in milliseconds."""
    shown = [f"{times.median(name) * 1e3:,.1f}" for name in (way, other)]
    return [work, shown[0], against, shown[1], f"{times.ratio(way, other):.2f}"]


if __name__ == "__main__":
    run(main)
